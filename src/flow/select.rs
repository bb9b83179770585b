//! Which rows of the two clouds take part: finite, in range, off the ground; and which are drawn.
//!
//! Points that are left out keep their row in the result. Knows nothing of what comes after.

use super::data::{MIN_POINTS, Point, Random};
use super::error::FlowError;
use super::ground;
use super::motion::MotionField;
use super::options::{Ego, Ground, Options};
use super::registration::NeighborSweep;

/// Two clouds, as they came.
#[derive(Clone, Copy, Debug)]
pub struct Problem<'a> {
    /// N points of the earlier sweep, metres, in its sensor's frame.
    pub source: &'a [Point],
    /// M points of the later sweep, metres, in its sensor's frame.
    pub target: &'a [Point],
    /// N and M flags: which points are ground. Needed by [`Ground::Mask`]; [`Ground::Auto`] finds
    /// them where they are not given.
    pub ground: Option<[&'a [bool]; 2]>,
    /// The motion of the pair before, from the sweep before the source to the source: where a fit
    /// may start, and the vehicle's motion be sought. None for a pair on its own.
    pub before: Option<&'a MotionField>,
    /// Other sweeps of the sequence, in any order; none for a pair on its own. Looked at where
    /// [`super::ObjectOptions::frames`] asks for more than the pair.
    pub around: &'a [NeighborSweep<'a>],
}

/// The points that take part.
#[derive(Clone, Debug)]
pub(crate) struct Selection {
    /// Rows of the source, one for each of `source`.
    pub(crate) rows: Vec<usize>,
    pub(crate) source: Vec<Point>,
    pub(crate) target: Vec<Point>,
    /// Places in `rows` that get a flow: all, but where movers are found and some points are drawn.
    pub(crate) output_rows: Vec<usize>,
    /// Rows of the source that move with the ego motion without taking part: ground that was found.
    pub(crate) ego_only_rows: Vec<usize>,
    /// Source and target for the ego motion, where it is to be found: all that is finite and in
    /// range, the ground too, which holds pitch, roll and height.
    pub(crate) registration_clouds: Option<[Vec<Point>; 2]>,
}

/// Which points of sweeps are ground, all of them finite and in range.
pub(crate) type FindGround<'a> = &'a dyn Fn(&[&[Point]]) -> Vec<Vec<bool>>;

/// Finds the ground on this thread, and remembers nothing.
pub(crate) fn find_ground(sweeps: &[&[Point]]) -> Vec<Vec<bool>> {
    sweeps.iter().map(|points| ground::mask(points)).collect()
}

/// Selects by `options`; refuses clouds of which too little is left.
pub(crate) fn select(
    problem: &Problem,
    options: &Options,
    find: FindGround<'_>,
) -> Result<Selection, FlowError> {
    let mut found = match (options.ground, problem.ground) {
        (Ground::Auto, Some(known)) => Some(known.map(<[bool]>::to_vec)),
        (Ground::Auto, None) => Some(ground_of([problem.source, problem.target], options, find)),
        (Ground::Keep | Ground::Mask, _) => None,
    };
    let [source_mask, target_mask] = match (options.ground, problem.ground, &found) {
        (Ground::Mask, None, _) => return Err(FlowError::NoGroundMask),
        (Ground::Mask, Some([source, target]), _) => [Some(source), Some(target)],
        (_, _, Some([source, target])) => [Some(source.as_slice()), Some(target.as_slice())],
        (_, _, None) => [None, None],
    };
    let mut rows = kept("source", problem.source, source_mask, options)?;
    let mut target_rows = kept("target", problem.target, target_mask, options)?;
    if found.is_some() && rows.len().min(target_rows.len()) < MIN_POINTS {
        // Nothing but ground: it is what there is to fit.
        found = None;
        rows = kept("source", problem.source, None, options)?;
        target_rows = kept("target", problem.target, None, options)?;
    }
    let ego_only_rows = match &found {
        Some([ground, _]) if options.max_points.is_none() => {
            let rows = 0..ground.len();
            rows.filter(|&row| ground[row] && is_in_range(problem.source[row], options))
                .collect()
        }
        _ => Vec::new(),
    };
    let mut output_rows: Vec<usize> = (0..rows.len()).collect();
    if let Some(max_points) = options.max_points {
        // One permutation for both clouds, as the published code draws it; but each cloud is drawn
        // from all of its rows, which lie in the order of the scan.
        let mut order: Vec<usize> = (0..rows.len().max(target_rows.len())).collect();
        Random::stream(options.seed, 1).shuffle(&mut order);
        let drawn = |count: usize| -> Vec<usize> {
            let places = order.iter().copied().filter(|&place| place < count);
            places.take(max_points).collect()
        };
        if options.label.is_some() {
            // Few points have no clusters: objects are found in all of them.
            output_rows = drawn(rows.len());
        } else {
            for rows in [&mut rows, &mut target_rows] {
                *rows = drawn(rows.len()).iter().map(|&place| rows[place]).collect();
            }
            output_rows.truncate(rows.len());
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
    Ok(Selection {
        source: rows.iter().map(|&row| problem.source[row]).collect(),
        target: target_rows.iter().map(|&row| problem.target[row]).collect(),
        registration_clouds: (options.ego == Ego::Auto)
            .then(|| [problem.source, problem.target].map(|points| in_range(points, options))),
        rows,
        output_rows,
        ego_only_rows,
    })
}

/// The points of a sweep around a pair that `options` let take part.
pub(crate) fn off_ground(
    sweep: &NeighborSweep,
    options: &Options,
    find: FindGround<'_>,
) -> Result<Vec<Point>, FlowError> {
    let found = match (options.ground, sweep.ground) {
        (Ground::Auto, None) => {
            let [found] = ground_of([sweep.points], options, find);
            Some(found)
        }
        (Ground::Mask, None) => return Err(FlowError::NoGroundMask),
        _ => None,
    };
    let known = sweep.ground.filter(|_| options.ground != Ground::Keep);
    let rows = kept(
        "sweep around",
        sweep.points,
        found.as_deref().or(known),
        options,
    )?;
    Ok(rows.into_iter().map(|row| sweep.points[row]).collect())
}

/// Which points of each sweep are ground, of those that are finite and in range.
pub(crate) fn ground_of<const SWEEPS: usize>(
    sweeps: [&[Point]; SWEEPS],
    options: &Options,
    find: FindGround<'_>,
) -> [Vec<bool>; SWEEPS] {
    let in_range = sweeps.map(|points| in_range(points, options));
    let found = find(&in_range.each_ref().map(Vec::as_slice));
    let mut found = found.into_iter();
    sweeps.map(|points| {
        let mut found = found.next().unwrap_or_default().into_iter();
        let is_ground = |&point: &Point| is_in_range(point, options) && found.next() == Some(true);
        points.iter().map(is_ground).collect()
    })
}

/// All points that are finite and in range.
pub(crate) fn in_range(points: &[Point], options: &Options) -> Vec<Point> {
    let kept = points.iter().filter(|&&point| is_in_range(point, options));
    kept.copied().collect()
}

/// The rows of `points` that are finite, in range and not masked.
fn kept(
    cloud: &'static str,
    points: &[Point],
    ground: Option<&[bool]>,
    options: &Options,
) -> Result<Vec<usize>, FlowError> {
    if let Some(flags) = ground.map(<[bool]>::len)
        && flags != points.len()
    {
        return Err(FlowError::GroundMaskLength {
            cloud,
            flags,
            points: points.len(),
        });
    }
    Ok((0..points.len())
        .filter(|&row| {
            is_in_range(points[row], options) && !ground.is_some_and(|ground| ground[row])
        })
        .collect())
}

pub(crate) fn is_in_range([x, y, z]: Point, options: &Options) -> bool {
    let range = options.range_m.unwrap_or(f32::INFINITY);
    let finite = x.is_finite() && y.is_finite() && z.is_finite();
    finite && x.abs() <= range && y.abs() <= range
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
            before: None,
            around: &[],
        };
        select(&problem, options, &find_ground)
            .expect("enough points")
            .rows
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
        options.range_m = Some(51.2);
        options.ground = Ground::Keep;
        assert_eq!(rows(&options, &source, Some(&ground)), [0, 2, 5, 6]);
        for leaves_out in [Ground::Mask, Ground::Auto] {
            options.ground = leaves_out;
            assert_eq!(rows(&options, &source, Some(&ground)), [0, 2, 5]);
        }
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
            before: None,
            around: &[],
        };
        let mut options = Preset::Neural.options(Some(10));
        options.ground = Ground::Mask;
        options.range_m = Some(60.0);
        let selection = select(&problem, &options, &find_ground).expect("enough points");
        assert_eq!(selection.source.len(), 10);
        assert_eq!(
            selection.registration_clouds,
            Some([(); 2].map(|()| source[..=60].to_vec()))
        );
        options.ego = Ego::Off;
        let selection = select(&problem, &options, &find_ground).expect("enough points");
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
        let problem = Problem {
            source: &source,
            target: &source,
            ground: None,
            before: None,
            around: &[],
        };
        let fitted = select(&problem, &fitted, &find_ground).expect("enough points");
        let objects = select(&problem, &objects, &find_ground).expect("enough points");
        assert_eq!((objects.rows.len(), objects.target.len()), (100, 100));
        let output_rows = |selection: &Selection| -> Vec<usize> {
            let places = selection.output_rows.iter();
            places.map(|&place| selection.rows[place]).collect()
        };
        assert_eq!(output_rows(&objects), output_rows(&fitted));
        assert_eq!(output_rows(&fitted), fitted.rows);
    }

    #[test]
    fn each_cloud_is_sampled_from_all_of_its_rows() {
        let line = |count: usize| {
            (0..count)
                .map(|i| [i as f32, 0.0, 0.0])
                .collect::<Vec<Point>>()
        };
        let (source, target) = (line(50), line(4000));
        let problem = Problem {
            source: &source,
            target: &target,
            ground: None,
            before: None,
            around: &[],
        };
        let selection =
            select(&problem, &Preset::Neural.options(Some(300)), &find_ground).expect("points");
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
            before: None,
            around: &[],
        };
        let mut options = Preset::Neural.options(None);
        let error = select(&problem, &options, &find_ground).expect_err("one point");
        assert!(matches!(
            error,
            FlowError::TooFewPoints {
                cloud: "source",
                points: 1
            }
        ));
        options.ground = Ground::Mask;
        let error = select(&problem, &options, &find_ground).expect_err("no mask");
        assert!(matches!(error, FlowError::NoGroundMask));
    }
}
