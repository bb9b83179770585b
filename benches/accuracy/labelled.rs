//! Pairs with ground truth: labelled real pairs in the folder `FNSF_REAL_DATA`, and simulated
//! streets.

use std::path::Path;

use fnsf::flow::Point;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::formats::read_pair;

/// Folder names of the labelled real pairs.
pub(crate) const PAIRS: [&str; 3] = ["av2_7fab", "kitti_0000", "small_gicp"];

/// A pair with ground truth. Points and flow are in metres.
pub(crate) struct LabelledPair {
    pub(crate) name: String,
    pub(crate) source: Vec<Point>,
    pub(crate) target: Vec<Point>,
    /// Ground masks of the source and of the target.
    pub(crate) ground: [Vec<bool>; 2],
    pub(crate) flow: Vec<Point>,
    pub(crate) valid: Vec<bool>,
    pub(crate) dynamic: Option<Vec<bool>>,
}

/// The labelled real pairs; none if `FNSF_REAL_DATA` is not set.
pub(crate) fn real_pairs() -> Result<Vec<LabelledPair>, String> {
    let Some(folder) = std::env::var_os("FNSF_REAL_DATA") else {
        return Ok(Vec::new());
    };
    let pairs = PAIRS.iter().map(|name| real(name, Path::new(&folder)));
    pairs.collect()
}

fn real(name: &str, folder: &Path) -> Result<LabelledPair, String> {
    let path = folder.join(name).join("pair.npz");
    let bytes = std::fs::read(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    let pair = read_pair(&bytes).map_err(|e| format!("{}: {e}", path.display()))?;
    let truth = pair.truth.ok_or("the pair has no truth")?;
    let ground = pair.ground.ok_or("the pair has no ground masks")?;
    Ok(LabelledPair {
        name: name.to_owned(),
        source: pair.source,
        target: pair.target,
        ground: [ground.source, ground.target],
        flow: truth.flow,
        valid: truth.valid,
        dynamic: truth.dynamic,
    })
}

/// The first pair of a simulated street.
pub(crate) fn street(seed: u64, beams: usize) -> Result<LabelledPair, String> {
    let options = StreetOptions {
        seed,
        beams,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).and_then(|street| street.pair(0));
    let pair = pair.map_err(|e| e.to_string())?;
    Ok(LabelledPair {
        name: format!("street {seed}, {beams} beams"),
        valid: vec![true; pair.source.len()],
        source: pair.source,
        target: pair.target,
        ground: [pair.ground_source, pair.ground_target],
        flow: pair.flow,
        dynamic: Some(pair.dynamic),
    })
}
