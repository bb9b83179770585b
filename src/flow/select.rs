//! Selection of the points that take part, by crop, ground and sampling.
//!
//! Points that are excluded keep their row in the result.

use std::borrow::Cow;

use super::data::{MIN_POINTS, Point, Random, square_distance, stride_sample};
use super::error::FlowError;
use super::ground;
use super::options::{Ego, Ground, MAX_SPREAD_M, Method, Options};
use super::problem::{NeighborSweep, Problem};

/// The selected points of a pair.
#[derive(Clone, Debug)]
pub(crate) struct Selection<'a> {
    /// Source row of each point of `source`.
    pub(crate) rows: Vec<usize>,
    /// Target row of each point of `target`.
    pub(crate) target_rows: Vec<usize>,
    pub(crate) source: Vec<Point>,
    pub(crate) target: Vec<Point>,
    /// Indices into `rows` of the points that get a flow. All of them, except where an object
    /// search samples its output.
    pub(crate) output_indices: Vec<usize>,
    /// Source rows of ground points that are excluded from the method and get the ego-motion flow.
    pub(crate) ego_only_rows: Vec<usize>,
    /// Source and target clouds for the registration, where the ego motion is estimated: all points
    /// that are finite, within the crop and not too near. Ground is included, because it determines
    /// pitch, roll and height.
    pub(crate) registration_clouds: Option<[Cow<'a, [Point]>; 2]>,
    /// All points of the two clouds that `source` and `target` were sampled from; none where they
    /// were not sampled.
    pub(crate) unsampled: Option<[Vec<Point>; 2]>,
    /// Whether the ground is among the selected points.
    pub(crate) has_ground: bool,
    /// Whether the source lies far from the origin of its frame, where the sensor should be.
    pub(crate) is_off_origin: bool,
}

/// Ground segmentation of several sweeps: one mask per sweep. All points are finite and within the
/// crop.
pub(crate) type FindGround<'a> = &'a dyn Fn(&[&[Point]]) -> Vec<Vec<bool>>;

/// Segments the ground on the calling thread, without a cache.
pub(crate) fn find_ground(sweeps: &[&[Point]]) -> Vec<Vec<bool>> {
    sweeps.iter().map(|points| ground::mask(points)).collect()
}

/// Selects the points of `problem` by `options`. The two clouds are selected in parallel. `given` are
/// the source and the target as they were measured, before any deskewing: a point is within the crop
/// and far enough from the sensor where both of its positions are.
///
/// # Errors
/// [`FlowError`] where coordinates are not metres, a mask is missing or has another length, or fewer
/// than [`MIN_POINTS`] points of a cloud remain.
pub(crate) fn select<'a>(
    problem: &Problem<'a>,
    given: [&[Point]; 2],
    options: &Options,
    find: FindGround<'_>,
) -> Result<Selection<'a>, FlowError> {
    check_metres("source", problem.source, options)?;
    check_metres("target", problem.target, options)?;
    let known = problem.ground.map_or([None; 2], |masks| masks.map(Some));
    let sweeps = [(problem.source, known[0]), (problem.target, known[1])];
    let mut masks = ground_masks(sweeps, options, find)?;
    let [mut rows, mut target_rows] = rows_of_pair(problem, given, &masks, options)?;
    if options.ground == Ground::Auto && rows.len().min(target_rows.len()) < MIN_POINTS {
        // Clouds that are nearly all ground keep their ground points.
        masks = [None, None];
        [rows, target_rows] = rows_of_pair(problem, given, &masks, options)?;
    }
    let has_ground = masks.iter().any(Option::is_none);
    let ego_only_rows = || match &masks {
        [Some(ground), _] if options.ground == Ground::Auto && options.max_points.is_none() => {
            let is_in_crop = rows_in_crop([problem.source, given[0]], options);
            let rows = (0..ground.len()).filter(|&row| ground[row] && is_in_crop(row));
            rows.collect()
        }
        _ => Vec::new(),
    };
    let mut output_indices: Vec<usize> = (0..rows.len()).collect();
    let mut unsampled = None;
    if let Some(max_points) = options.max_points {
        // One permutation for both clouds, as in the published code. Each cloud draws from all of
        // its rows, because rows are in scan order.
        let mut order: Vec<usize> = (0..rows.len().max(target_rows.len())).collect();
        Random::stream(options.seed, 1).shuffle(&mut order);
        let drawn = |count: usize| -> Vec<usize> {
            let indices = order.iter().copied().filter(|&index| index < count);
            indices.take(max_points).collect()
        };
        match options.method {
            // A sparse sample has no clusters, so the object search uses all points.
            Method::Objects(_) => output_indices = drawn(rows.len()),
            Method::Field(_) => {
                unsampled = Some([
                    points_at(&rows, problem.source),
                    points_at(&target_rows, problem.target),
                ]);
                for rows in [&mut rows, &mut target_rows] {
                    *rows = drawn(rows.len()).iter().map(|&index| rows[index]).collect();
                }
                output_indices.truncate(rows.len());
            }
        }
    }
    for (cloud, rows) in [("source", &rows), ("target", &target_rows)] {
        if rows.len() < MIN_POINTS {
            return Err(FlowError::TooFewPoints {
                cloud,
                points: rows.len(),
            });
        }
    }
    let chosen = |rows: &[usize], points: &'a [Point]| {
        let registered = (options.ego == Ego::Auto).then(|| cropped(points, options));
        (points_at(rows, points), registered)
    };
    let ((source, registered), ((target, registered_target), ego_only_rows)) = rayon::join(
        || chosen(&rows, problem.source),
        || rayon::join(|| chosen(&target_rows, problem.target), ego_only_rows),
    );
    Ok(Selection {
        source,
        target,
        registration_clouds: registered.zip(registered_target).map(<[_; 2]>::from),
        unsampled,
        has_ground,
        is_off_origin: is_off_origin(problem.source),
        rows,
        target_rows,
        output_indices,
        ego_only_rows,
    })
}

fn points_at(rows: &[usize], points: &[Point]) -> Vec<Point> {
    rows.iter().map(|&row| points[row]).collect()
}

/// Refuses points that lie too far apart for metres.
///
/// # Errors
/// [`FlowError::NotMetres`].
fn check_metres(cloud: &'static str, points: &[Point], options: &Options) -> Result<(), FlowError> {
    if options.force {
        return Ok(());
    }
    let (_, spread_m) = middle(points);
    if spread_m > MAX_SPREAD_M {
        return Err(FlowError::NotMetres { cloud, spread_m });
    }
    Ok(())
}

/// Whether a cloud lies so far from the origin of its frame that this is not the sensor's: its middle is
/// farther away than three times its spread and 50 m more.
fn is_off_origin(points: &[Point]) -> bool {
    const SPREADS: f32 = 3.0;
    const AWAY_M: f32 = 50.0;
    let ([x, y, _], spread_m) = middle(points);
    x.hypot(y) > SPREADS * spread_m + AWAY_M
}

/// The middle of a cloud, the median of each coordinate, and the median distance of its points from it,
/// metres. Points that are not finite are ignored.
fn middle(points: &[Point]) -> (Point, f32) {
    /// Points that are looked at.
    const SAMPLED: usize = 1024;
    let sampled = stride_sample(points, SAMPLED);
    let finite = |point: &&Point| point.iter().all(|c| c.is_finite());
    let axis = |a: usize| {
        median(
            sampled
                .iter()
                .filter(finite)
                .map(|point| point[a])
                .collect(),
        )
    };
    let middle: Point = core::array::from_fn(axis);
    let from_middle = sampled.iter().filter(finite);
    let from_middle = from_middle.map(|&point| square_distance(point, middle).sqrt());
    let spread_m = median(from_middle.collect());
    (middle, spread_m)
}

/// The median; zero of no values.
fn median(mut values: Vec<f32>) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// The selected points of a neighbor sweep.
///
/// # Errors
/// As [`select`], except for the number of points and the unit of the coordinates.
pub(crate) fn select_neighbor(
    sweep: &NeighborSweep,
    options: &Options,
    find: FindGround<'_>,
) -> Result<Vec<Point>, FlowError> {
    let [mask] = ground_masks([(sweep.points, sweep.ground)], options, find)?;
    let points = [sweep.points; 2];
    let rows = selected_rows("neighbor sweep", points, mask.as_deref(), options)?;
    Ok(rows.into_iter().map(|row| sweep.points[row]).collect())
}

/// The ground masks of several sweeps: the given mask, or the segmentation of a sweep that has
/// none. None with [`Ground::Keep`].
///
/// # Errors
/// [`FlowError::NoGroundMask`] where [`Ground::Mask`] is set and a mask is missing.
pub(crate) fn ground_masks<'a, const SWEEPS: usize>(
    sweeps: [(&'a [Point], Option<&'a [bool]>); SWEEPS],
    options: &Options,
    find: FindGround<'_>,
) -> Result<[Option<Cow<'a, [bool]>>; SWEEPS], FlowError> {
    let is_missing = sweeps.iter().any(|(_, mask)| mask.is_none());
    match options.ground {
        Ground::Keep => return Ok([const { None }; SWEEPS]),
        Ground::Mask if is_missing => return Err(FlowError::NoGroundMask),
        Ground::Mask | Ground::Auto => {}
    }
    let unmasked = sweeps.iter().filter(|(_, mask)| mask.is_none());
    let clouds: Vec<Cow<'_, [Point]>> = unmasked
        .map(|(points, _)| cropped(points, options))
        .collect();
    let found = if clouds.is_empty() {
        Vec::new()
    } else {
        find(&clouds.iter().map(|cloud| &cloud[..]).collect::<Vec<_>>())
    };
    let mut found = found.into_iter();
    Ok(sweeps.map(|(points, mask)| {
        Some(mask.map_or_else(
            || {
                let found = found.next().unwrap_or_default();
                if found.len() == points.len() {
                    return Cow::Owned(found);
                }
                let mut found = found.into_iter();
                let is_ground =
                    |&point: &Point| is_in_crop(point, options) && found.next() == Some(true);
                Cow::Owned(points.iter().map(is_ground).collect())
            },
            Cow::Borrowed,
        ))
    }))
}

/// All points that are finite, within the crop and not too near.
pub(crate) fn cropped<'a>(points: &'a [Point], options: &Options) -> Cow<'a, [Point]> {
    let is_kept = |point: &Point| is_in_crop(*point, options);
    if points.iter().all(is_kept) {
        return Cow::Borrowed(points);
    }
    Cow::Owned(points.iter().copied().filter(is_kept).collect())
}

/// Whether a point is finite, within the crop and not too near.
pub(crate) fn is_in_crop([x, y, z]: Point, options: &Options) -> bool {
    let crop = options.crop_m.unwrap_or(f32::INFINITY);
    let finite = x.is_finite() && y.is_finite() && z.is_finite();
    let is_far = options.min_range_m.is_none_or(|least| x.hypot(y) >= least);
    finite && x.abs() <= crop && y.abs() <= crop && is_far
}

/// Whether the point of a row is within the crop where it is and where it was `given`, see
/// [`is_in_crop`].
fn rows_in_crop([points, given]: [&[Point]; 2], options: &Options) -> impl Fn(usize) -> bool {
    let is_moved = !std::ptr::eq(points, given);
    move |row| is_in_crop(points[row], options) && (!is_moved || is_in_crop(given[row], options))
}

fn rows_of_pair(
    problem: &Problem,
    given: [&[Point]; 2],
    [source, target]: &[Option<Cow<'_, [bool]>>; 2],
    options: &Options,
) -> Result<[Vec<usize>; 2], FlowError> {
    let (source, target) = rayon::join(
        || {
            let points = [problem.source, given[0]];
            selected_rows("source", points, source.as_deref(), options)
        },
        || {
            let points = [problem.target, given[1]];
            selected_rows("target", points, target.as_deref(), options)
        },
    );
    Ok([source?, target?])
}

/// Rows of `points` that are finite, within the crop and not masked. `given` are the points as they
/// were measured.
fn selected_rows(
    cloud: &'static str,
    [points, given]: [&[Point]; 2],
    mask: Option<&[bool]>,
    options: &Options,
) -> Result<Vec<usize>, FlowError> {
    if let Some(flags) = mask.map(<[bool]>::len)
        && flags != points.len()
    {
        return Err(FlowError::GroundMaskLength {
            cloud,
            flags,
            points: points.len(),
        });
    }
    let is_in_crop = rows_in_crop([points, given], options);
    let is_masked = |row: usize| mask.is_some_and(|mask| mask[row]);
    let rows = 0..points.len();
    Ok(rows
        .filter(|&row| !is_masked(row) && is_in_crop(row))
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::options::Preset;

    fn rows(options: &Options, source: &[Point], ground: Option<&[bool]>) -> Vec<usize> {
        let problem = Problem {
            source,
            target: source,
            ground: ground.map(|flags| [flags, flags]),
            times: None,
            before: None,
            neighbors: &[],
        };
        selected(&problem, options).rows
    }

    fn selected<'a>(problem: &Problem<'a>, options: &Options) -> Selection<'a> {
        let given = [problem.source, problem.target];
        select(problem, given, options, &find_ground).expect("enough points")
    }

    #[test]
    fn points_that_are_not_finite_out_of_range_or_ground_are_left_out() {
        let source = [
            [0.0; 3],
            [f32::NAN, 0.0, 0.0],
            [1.0, 2.0, 3.0],
            [0.0, f32::INFINITY, 0.0],
            [-60.0, 0.0, 0.0],
            [5.0, 5.0, 90.0],
            [6.0, 6.0, 0.0],
        ];
        let ground = [false, false, false, false, false, false, true];
        let mut options = Preset::Neural.options(None);
        options.crop_m = Some(51.2);
        options.ground = Ground::Keep;
        assert_eq!(rows(&options, &source, Some(&ground)), [0, 2, 5, 6]);
        for leaves_out in [Ground::Mask, Ground::Auto] {
            options.ground = leaves_out;
            assert_eq!(rows(&options, &source, Some(&ground)), [0, 2, 5]);
        }
    }

    #[test]
    fn a_point_is_within_the_crop_where_it_was_measured_and_where_it_is_now() {
        let [measured, deskewed] = [[1.5, 3.0, 60.0, 10.0, 10.0], [3.0, 1.5, 40.0, 60.0, 11.0]]
            .map(|along| along.map(|x| [x, 0.0, 0.0]));
        let mut options = Preset::Default.options(None);
        (options.ground, options.ego) = (Ground::Keep, Ego::Off);
        (options.crop_m, options.min_range_m) = (Some(50.0), Some(2.0));
        let all = [measured.as_slice(), &deskewed].concat();
        let given = [deskewed.as_slice(), &measured].concat();
        let problem = Problem::pair(&all, &all);
        let selection = select(&problem, [&given, &all], &options, &find_ground);
        assert!(matches!(
            selection,
            Err(FlowError::TooFewPoints { points: 2, .. })
        ));
    }

    #[test]
    fn clouds_of_nothing_but_ground_keep_it() {
        let source: Vec<Point> = (0..9).map(|i| [i as f32, 0.0, 0.0]).collect();
        let options = Preset::Neural.options(None);
        assert_eq!(options.ground, Ground::Auto);
        assert_eq!(rows(&options, &source, Some(&[true; 9])).len(), 9);
    }

    #[test]
    fn the_ego_motion_sees_the_ground_and_what_was_not_drawn() {
        let mut source: Vec<Point> = (0..100).map(|i| [i as f32, 0.0, 0.0]).collect();
        source.push([f32::NAN; 3]);
        let ground: Vec<bool> = (0..source.len()).map(|i| i % 2 == 0).collect();
        let problem = Problem {
            source: &source,
            target: &source,
            ground: Some([&ground, &ground]),
            times: None,
            before: None,
            neighbors: &[],
        };
        let mut options = Preset::Neural.options(Some(10));
        options.ground = Ground::Mask;
        options.crop_m = Some(60.0);
        let selection = selected(&problem, &options);
        assert_eq!(selection.source.len(), 10);
        assert_eq!(
            selection.registration_clouds,
            Some([(); 2].map(|()| Cow::Borrowed(&source[..=60])))
        );
        options.ego = Ego::Off;
        let selection = selected(&problem, &options);
        assert_eq!(selection.registration_clouds, None);
    }

    #[test]
    fn sampling_takes_distinct_rows_and_depends_on_the_seed() {
        let source: Vec<Point> = (0..100).map(|i| [i as f32, 0.0, 0.0]).collect();
        let mut options = Preset::Paper.options(Some(40));
        let first = rows(&options, &source, None);
        options.seed = 1;
        let second = rows(&options, &source, None);
        let mut unique = first.clone();
        unique.sort_unstable();
        unique.dedup();
        assert_eq!(unique.len(), 40);
        assert_ne!(first, second);
    }

    #[test]
    fn objects_are_looked_for_in_all_rows_and_those_that_a_field_would_be_fitted_to_are_answered() {
        let source: Vec<Point> = (0..100).map(|i| [i as f32, 0.0, 0.0]).collect();
        let mut fitted = Preset::Neural.options(Some(40));
        let mut objects = Preset::Default.options(Some(40));
        (fitted.ground, objects.ground) = (Ground::Keep, Ground::Keep);
        let problem = Problem::pair(&source, &source);
        let fitted = selected(&problem, &fitted);
        let objects = selected(&problem, &objects);
        assert_eq!((objects.rows.len(), objects.target.len()), (100, 100));
        let output_indices = |selection: &Selection| -> Vec<usize> {
            let places = selection.output_indices.iter();
            places.map(|&place| selection.rows[place]).collect()
        };
        assert_eq!(output_indices(&objects), output_indices(&fitted));
        assert_eq!(output_indices(&fitted), fitted.rows);
    }

    #[test]
    fn each_cloud_is_sampled_from_all_of_its_rows() {
        let line = |count: usize| {
            (0..count)
                .map(|i| [i as f32, 0.0, 0.0])
                .collect::<Vec<Point>>()
        };
        let (source, target) = (line(50), line(4000));
        let problem = Problem::pair(&source, &target);
        let selection = selected(&problem, &Preset::Neural.options(Some(300)));
        assert_eq!(selection.source.len(), 50);
        assert_eq!(selection.target.len(), 300);
        let last = selection.target.iter().map(|p| p[0]).fold(0.0, f32::max);
        assert!(last > 3000.0, "{last}");
    }

    #[test]
    fn too_few_points_and_missing_masks_are_named() {
        let problem = Problem {
            source: &[[0.0; 3]],
            target: &[[0.0; 3]],
            ground: None,
            times: None,
            before: None,
            neighbors: &[],
        };
        let mut options = Preset::Neural.options(None);
        let given = [problem.source, problem.target];
        let error = select(&problem, given, &options, &find_ground).expect_err("one point");
        assert!(matches!(
            error,
            FlowError::TooFewPoints {
                cloud: "source",
                points: 1
            }
        ));
        options.ground = Ground::Mask;
        let error = select(&problem, given, &options, &find_ground).expect_err("no mask");
        assert!(matches!(error, FlowError::NoGroundMask));
    }
}
