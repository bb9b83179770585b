//! The truth of a scene's pairs.

use super::arrays::KIND;
use super::sweeps::{Scene, SceneSweep, flags, per_point, vectors};
use crate::flow::rigid_motion_between;
use crate::formats::error::FormatError;
use crate::formats::limits::check_category;
use crate::formats::pair::{Ground, Pair, PairTruth, check_count, of_some_category};

/// Points of no object whose true flow has to be that of one motion.
const LEAST_STATIC: usize = 100;
/// The most by which their flow may deviate from it, root mean square, metres.
const MOST_APART_M: f64 = 0.01;

impl Scene {
    /// The pair of a sweep and the one after it, with its truth: `flow` (N x 3, metres), `flow_is_valid`
    /// and `flow_category_indices` (N). None where the sweep has no flow.
    ///
    /// The ego motion is the rigid motion of the true flow of the valid points of no category. None where
    /// there are fewer than 100 of them, or where they do not move as one. The file's own `ego_motion` and
    /// `pose` are not read: in files of Argoverse 2 they are the vehicle's, and the points are in the
    /// sensor's frame.
    ///
    /// # Errors
    /// As for [`Self::sweep`], and `Malformed` for a category that is not 0 to 255.
    ///
    /// # Panics
    /// There is no sweep of this index, or none after it.
    pub fn pair(
        &self,
        index: usize,
        [source, target]: [&SceneSweep; 2],
    ) -> Result<Option<Pair>, FormatError> {
        let group = self.group(index)?;
        let count = source.points.len();
        let Some(flow) = vectors(&group, "flow", 3..=3)? else {
            return Ok(None);
        };
        check_count("flow", flow.len(), count)?;
        let valid = flags(&group, "flow_is_valid", count)?;
        let valid = valid.unwrap_or_else(|| vec![true; count]);
        let mut category = None;
        if let Some(array) = per_point(&group, "flow_category_indices", count)? {
            let of = |row| {
                let [value] = array.row(row);
                check_category(KIND, row, "flow_category_indices", value)
            };
            category = Some((0..count).map(of).collect::<Result<Vec<u8>, _>>()?);
        }
        let ego = category.as_ref().and_then(|category| {
            let is_static = |row: &usize| valid[*row] && category[*row] == 0;
            let rows: Vec<usize> = (0..count).filter(is_static).collect();
            let moves = rows.iter().map(|&row| (source.points[row], flow[row]));
            let (motion, apart_m) = rigid_motion_between(moves)?;
            (rows.len() >= LEAST_STATIC && apart_m <= MOST_APART_M).then_some(motion)
        });
        let ground = source.ground.clone().zip(target.ground.clone());
        Ok(Some(Pair {
            source: source.points.clone(),
            target: target.points.clone(),
            truth: Some(PairTruth {
                flow,
                valid,
                dynamic: None,
                foreground: category.as_deref().map(of_some_category),
                category,
            }),
            ground: ground.map(|(source, target)| Ground { source, target }),
            ego,
        }))
    }
}
