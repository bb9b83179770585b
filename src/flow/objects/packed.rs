//! The scene of an object search as 32-bit words and records, for the kernel that searches its
//! clusters on a GPU. The kernel's records mirror those here.

use bytemuck::{Pod, Zeroable};

use super::clouds::TargetCloud;
use super::cluster_cost::{Cost, JUDGED};
use super::evidence::NeighborEvidence;
use super::hough::{self, TranslationVotes};
use super::hypothesis::Hypothesis;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::IndexRecord;

/// Words of a bin of the votes.
const BIN_WORDS: usize = 2;
/// Limits of the kernel: sweeps that clusters are matched to, points of one, initial guesses, and bins
/// of the votes on each side.
const MOST_VIEWS: usize = 8;
const MOST_POINTS: usize = 32 * 4096;
const MOST_GUESSES: usize = 16;
const MOST_BINS: i32 = 120;

/// A sweep that clusters are matched to.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ViewRecord {
    pub(crate) free: IndexRecord,
    pub(crate) taken: IndexRecord,
    pub(crate) targets: u32,
    pub(crate) normals: u32,
    pub(crate) at: i32,
    pub(crate) weight: f32,
}

/// The source cloud, the options, and what all clusters share.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct SceneRecord {
    pub(crate) source: IndexRecord,
    pub(crate) positions: u32,
    pub(crate) rows: u32,
    pub(crate) statics: u32,
    pub(crate) static_words: u32,
    pub(crate) voted: IndexRecord,
    pub(crate) views: u32,
    pub(crate) scratch_words: u32,
    pub(crate) half_bins: i32,
    pub(crate) bin_m: f32,
    pub(crate) vote_within_m: f32,
    pub(crate) cluster_min_points: u32,
    pub(crate) initial_guesses: u32,
    pub(crate) height_weight: f32,
    pub(crate) match_m: f32,
    pub(crate) normal_base_m: f32,
    pub(crate) normal_slope: f32,
    pub(crate) tangential_weight: f32,
    pub(crate) truncation_m: f32,
    pub(crate) close_fit_m: f32,
    pub(crate) displacement_penalty: f32,
    pub(crate) static_fit_m: f32,
    pub(crate) min_motion_m: f32,
    pub(crate) min_gain_m: f32,
    pub(crate) max_cost_ratio: f32,
    pub(crate) min_evidence_m: f32,
    pub(crate) min_evidence_slope: f32,
    pub(crate) max_residual_m: f32,
    pub(crate) min_normal_motion_m: f32,
    pub(crate) neighbor_cost_ratio: f32,
    pub(crate) neighbor_gain_m: f32,
    pub(crate) slow_cost_ratio: f32,
    pub(crate) slow_gain_m: f32,
}

/// A cluster to be searched.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ClusterRecord {
    pub(crate) label: u32,
    pub(crate) members: u32,
    pub(crate) count: u32,
    pub(crate) center_x: f32,
    pub(crate) center_y: f32,
}

/// What the search of a cluster found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct FoundRecord {
    pub(crate) still_forward: f32,
    pub(crate) still_backward: f32,
    pub(crate) is_found: u32,
    pub(crate) shift_x: f32,
    pub(crate) shift_y: f32,
    pub(crate) turn: f32,
    pub(crate) forward: f32,
    pub(crate) backward: f32,
    pub(crate) observability: f32,
    pub(crate) normal_motion: f32,
    pub(crate) weight: f32,
    pub(crate) still: f32,
    pub(crate) moved: f32,
    pub(crate) nearest_still: f32,
    pub(crate) nearest_moved: f32,
    pub(crate) forward_still: f32,
    pub(crate) forward_moved: f32,
    pub(crate) agree: u32,
}

impl FoundRecord {
    /// The cost at rest, and the hypothesis of a cluster.
    pub(super) fn unpacked(&self, cluster: &ClusterRecord) -> (Cost, Option<Hypothesis>) {
        let cost = |forward_m, backward_m| Cost {
            forward_m,
            backward_m,
        };
        let still = cost(self.still_forward, self.still_backward);
        let found = (self.is_found == 1).then(|| Hypothesis {
            motion: PlanarMotion {
                shift_m: [self.shift_x, self.shift_y],
                turn: self.turn,
                center: [cluster.center_x, cluster.center_y],
            },
            cost: cost(self.forward, self.backward),
            still,
            observability: self.observability,
            normal_motion_m: self.normal_motion,
            neighbors: NeighborEvidence {
                weight: self.weight,
                still_m: self.still,
                moved_m: self.moved,
                nearest_m: [self.nearest_still, self.nearest_moved],
                forward_m: [self.forward_still, self.forward_moved],
                agree: self.agree == 1,
            },
        });
        (still, found)
    }
}

/// What the search of a scene found.
#[derive(Clone, Debug, Default)]
pub struct FoundInScene {
    /// What was found of the first clusters.
    pub(crate) clusters: Vec<FoundRecord>,
    /// Unit normals of the target points, in the order of the views and of their points; zero where
    /// the surface is not flat.
    pub(crate) normals: Vec<[f32; 4]>,
}

/// The scene of an object search, packed for the kernel.
#[derive(Clone, Debug)]
#[cfg_attr(
    not(feature = "gpu"),
    expect(dead_code, reason = "only the kernel of a GPU reads it")
)]
pub struct PackedScene {
    /// Tiles, columns and rows; records hold offsets into them.
    pub(crate) words: Vec<u32>,
    /// Points; records hold offsets into them.
    pub(crate) points: Vec<[f32; 4]>,
    pub(crate) scene: SceneRecord,
    pub(crate) views: Vec<ViewRecord>,
    /// The clusters, large ones first.
    pub(crate) clusters: Vec<ClusterRecord>,
}

impl PackedScene {
    /// Whether the options and the target with the neighbor sweeps are within the limits of the kernel.
    pub(super) fn fits(sweeps: &[TargetCloud], options: &ObjectOptions) -> bool {
        sweeps.len() <= MOST_VIEWS
            && sweeps.iter().all(|sweep| sweep.points.len() <= MOST_POINTS)
            && options.initial_guesses <= MOST_GUESSES
            && hough::half_bins(options) <= MOST_BINS
    }

    /// Packs the target `scene`, the `neighbors` and the clusters in the given `order`.
    pub(super) fn new(
        scene: &Scene<'_>,
        neighbors: &[NeighborView<'_>],
        votes: &TranslationVotes,
        order: &[u32],
    ) -> Self {
        let options = scene.options;
        let (mut words, mut points) = (Vec::new(), Vec::new());
        let source = scene.source;
        let rows = source.near.rows();
        let labels = rows.iter().map(|&row| source.labels[row as usize]);
        let mut record = scene_record(options, votes);
        record.source = source.near.write_words(labels, &mut words, &mut points);
        record.rows = words.len() as u32;
        words.extend_from_slice(rows);
        record.positions = write_points(&mut points, &source.points);
        let unlabelled = std::iter::repeat(0);
        record.voted = votes
            .near()
            .write_words(unlabelled, &mut words, &mut points);
        let neighbors_of = |moment: &NeighborView<'_>| (i32::from(moment.at), moment.weight);
        let views = std::iter::once((scene, (1, 1.0)))
            .chain(neighbors.iter().map(|n| (&n.scene, neighbors_of(n))));
        let views: Vec<(&Scene<'_>, (i32, f32))> = views.collect();
        record.views = views.len() as u32;
        record.static_words = source.members.len().div_ceil(32) as u32;
        record.statics = words.len() as u32;
        for (scene, _) in &views {
            words.extend(bits(scene.statics()));
        }
        let mut targets = 0;
        let view_records = views.iter().map(|&(scene, (at, weight))| {
            let [free, taken] = scene.indices();
            let normals = targets as u32;
            targets += scene.target.len();
            let unlabelled = std::iter::repeat(0);
            ViewRecord {
                free: free.write_words(unlabelled, &mut words, &mut points),
                taken: taken.write_words(scene.owners(), &mut words, &mut points),
                targets: write_points(&mut points, &scene.target),
                normals,
                at,
                weight,
            }
        });
        let view_records: Vec<ViewRecord> = view_records.collect();
        let side = 2 * record.half_bins as usize + 1;
        let scratch_words = views.len() * JUDGED + BIN_WORDS * side * side;
        record.scratch_words = scratch_words as u32;
        let clusters = order.iter().map(|&label| {
            let members = &source.members[label as usize];
            let [center_x, center_y] = source.center(members);
            let record = ClusterRecord {
                label,
                members: words.len() as u32,
                count: members.len() as u32,
                center_x,
                center_y,
            };
            words.extend_from_slice(members);
            record
        });
        let clusters = clusters.collect();
        Self {
            words,
            points,
            scene: record,
            views: view_records,
            clusters,
        }
    }
}

/// The record of what the options say; the rest is zero.
fn scene_record(options: &ObjectOptions, votes: &TranslationVotes) -> SceneRecord {
    SceneRecord {
        half_bins: votes.half(),
        bin_m: options.bin_m,
        vote_within_m: votes.within_m(),
        cluster_min_points: u32::try_from(options.cluster_min_points).unwrap_or(u32::MAX),
        initial_guesses: options.initial_guesses as u32,
        height_weight: options.height_weight,
        match_m: options.match_m,
        normal_base_m: options.normal_m[0],
        normal_slope: options.normal_m[1],
        tangential_weight: options.tangential_weight,
        truncation_m: options.truncation_m,
        close_fit_m: options.close_fit_m,
        displacement_penalty: options.displacement_penalty,
        static_fit_m: options.static_fit_m,
        min_motion_m: options.min_motion_m,
        min_gain_m: options.min_gain_m,
        max_cost_ratio: options.max_cost_ratio,
        min_evidence_m: options.min_evidence_m,
        min_evidence_slope: options.min_evidence_slope,
        max_residual_m: options.max_residual_m,
        min_normal_motion_m: options.min_normal_motion_m,
        neighbor_cost_ratio: options.neighbor_cost_ratio,
        neighbor_gain_m: options.neighbor_gain_m,
        slow_cost_ratio: options.slow_cost_ratio,
        slow_gain_m: options.slow_gain_m,
        ..SceneRecord::default()
    }
}

/// Appends `all` to `points` and returns the offset of the first.
fn write_points(points: &mut Vec<[f32; 4]>, all: &[Point]) -> u32 {
    let offset = points.len() as u32;
    points.extend(all.iter().map(|&[x, y, z]| [x, y, z, 0.0]));
    offset
}

/// One bit a flag, in words.
fn bits(flags: &[bool]) -> impl Iterator<Item = u32> {
    flags.chunks(32).map(|flags| {
        let bits = flags
            .iter()
            .zip(0..)
            .map(|(&flag, bit)| u32::from(flag) << bit);
        bits.sum()
    })
}

/// The constants that the kernel has as well: its name of each, and the value here.
#[cfg(test)]
pub(crate) fn shared_constants() -> Vec<(&'static str, f32)> {
    use super::{gauss_newton, hypothesis};
    let [guess_steps, last_steps] = hypothesis::STEPS;
    let [coarse_m, fine_m] = gauss_newton::SCALES_M;
    let [shift_damping, turn_damping] = gauss_newton::DAMPING;
    let [left_by_fit, left_by_search] = hypothesis::LEAST_LEFT;
    let sizes = hypothesis::SHIFTS_M;
    assert!(sizes.windows(2).all(|pair| pair[1] == 0.5 * pair[0]));
    vec![
        ("JUDGED", JUDGED as f32),
        ("MOST_VIEWS", MOST_VIEWS as f32),
        ("MARK_WORDS", (MOST_POINTS / 32) as f32),
        ("MOST_PEAKS", MOST_GUESSES as f32),
        ("PEAKS_APART", hough::PEAKS_APART as f32),
        ("VOTERS", hypothesis::VOTERS as f32),
        ("MOST_FITTED", hypothesis::MAX_FIT_POINTS as f32),
        ("PROMISING", hypothesis::PROMISING as f32),
        ("TRIES", hypothesis::TRIES as f32),
        ("TURNED", hypothesis::TURNED as f32),
        ("SHORTENED_M", hypothesis::SHORTENED_M),
        ("HOLD_OF_A_POINT", hypothesis::HOLD_OF_A_POINT),
        ("GUESS_STEPS", guess_steps as f32),
        ("LAST_STEPS", last_steps as f32),
        ("FIRST_SHIFT_M", sizes[0]),
        ("SHIFT_SIZES", sizes.len() as f32),
        ("LEFT_BY_FIT", left_by_fit),
        ("LEFT_BY_SEARCH", left_by_search),
        ("TOO_COSTLY", hypothesis::TOO_COSTLY),
        (
            "STEPS_BETWEEN_LOOKS",
            gauss_newton::STEPS_BETWEEN_LOOKS as f32,
        ),
        ("COARSE_M", coarse_m),
        ("FINE_M", fine_m),
        ("SHIFT_DAMPING", shift_damping as f32),
        ("TURN_DAMPING", turn_damping as f32),
        ("LEAST_WEIGHT", gauss_newton::LEAST_WEIGHT as f32),
        ("SHORT_STEP_M", gauss_newton::SHORT_STEP_M as f32),
    ]
}
