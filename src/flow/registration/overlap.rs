//! Overlap of two aligned clouds: whether they show one scene. Registration always returns a
//! motion, and it minimizes another measure.

use rayon::prelude::*;

use crate::flow::data::{Point, stride_sample};
use crate::flow::options::LEAST_OVERLAP;
use crate::flow::spatial::{ColumnIndex, voxel_first};

/// Largest distance of a matched point, metres: more than the spacing of the rings of a 32-beam
/// lidar at 25 m, and less than the gaps between objects.
const WITHIN_M: f32 = 0.3;
/// Side of the voxels that points are sampled from, metres, so that near surfaces weigh no more
/// than far ones.
const VOXEL_M: f32 = 0.5;
/// Largest number of sampled points: a share is then exact to 0.01.
const SAMPLED: usize = 4096;
/// Least number of voxels for a result. A single vehicle has fewer.
const LEAST_VOXELS: usize = 200;

/// The share, 0 to 1, of the volume of `source` that `target` shows as well. Both are finite
/// points without the ground, metres, in one frame. The ground is left out because any two scenes
/// share it.
///
/// Below [`LEAST_OVERLAP`] it is the larger of the shares of the two clouds: one cloud may be a
/// section of the other. None where a cloud is too small for a result.
pub(crate) fn overlap(source: &[Point], target: &[Point]) -> Option<f32> {
    let of_source = shown(source, target)?;
    if of_source >= LEAST_OVERLAP {
        return Some(of_source);
    }
    Some(of_source.max(shown(target, source)?))
}

/// The share of the voxels of `cloud` whose first point is near a point of `other`.
fn shown(cloud: &[Point], other: &[Point]) -> Option<f32> {
    let (sampled, near) = rayon::join(
        || stride_sample(&voxel_first(cloud, VOXEL_M), SAMPLED),
        || ColumnIndex::new(other, WITHIN_M),
    );
    if sampled.len() < LEAST_VOXELS {
        return None;
    }
    let is_shown = |&&row: &&u32| {
        let point = cloud[row as usize];
        near.nearest(point, WITHIN_M).is_some()
    };
    let shown = sampled.par_iter().filter(is_shown).count();
    Some(shown as f32 / sampled.len() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    /// Points on `count` posts of 3 m, 60 m around.
    fn posts(count: usize, seed: u64) -> Vec<Point> {
        let mut random = Random::new(seed);
        let mut place = || random.uniform(-60.0, 60.0) as f32;
        let feet: Vec<[f32; 2]> = (0..count).map(|_| [place(), place()]).collect();
        let post = |&[x, y]: &[f32; 2]| (0..30).map(move |i| [x, y, i as f32 * 0.1]);
        feet.iter().flat_map(post).collect()
    }

    #[test]
    fn a_scene_overlaps_itself_and_no_other() {
        let [here, there] = [posts(200, 1), posts(200, 2)];
        assert_eq!(overlap(&here, &here), Some(1.0));
        assert!(overlap(&here, &there).expect("a result") < LEAST_OVERLAP);
    }

    #[test]
    fn a_section_of_a_scene_overlaps_the_whole_in_either_order() {
        let whole = posts(400, 3);
        let section = &whole[..whole.len() / 5];
        assert_eq!(overlap(section, &whole), Some(1.0));
        assert_eq!(overlap(&whole, section), Some(1.0));
    }

    #[test]
    fn small_clouds_have_no_result() {
        assert_eq!(overlap(&posts(3, 4), &posts(200, 5)), None);
        assert_eq!(overlap(&posts(200, 4), &[]), None);
    }
}
