//! Clouds for the benchmarks: a simulated street, and real pairs if `FNSF_REAL_DATA` is set.

use std::path::PathBuf;

use fnsf::flow::Point;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::formats::read_pair;

/// The two clouds of a pair, metres, and its name.
pub(crate) struct Scene {
    pub(crate) name: String,
    pub(crate) source: Vec<Point>,
    pub(crate) target: Vec<Point>,
}

/// The simulated street and the real pairs in the folder `FNSF_REAL_DATA`, if it is set. The clouds
/// are uncropped and include the ground.
pub(crate) fn scenes() -> Result<Vec<Scene>, String> {
    let StreetOptions {
        beams,
        azimuth_steps,
        ..
    } = StreetOptions::default();
    let mut scenes = vec![Scene {
        name: "simulated street".to_owned(),
        ..street(beams, azimuth_steps)?
    }];
    if let Some(folder) = std::env::var_os("FNSF_REAL_DATA") {
        for name in ["av2_7fab", "kitti_0000", "small_gicp"] {
            let path = PathBuf::from(&folder).join(name).join("pair.npz");
            let bytes = std::fs::read(&path).map_err(|e| format!("{}: {e}", path.display()))?;
            let pair = read_pair(&bytes).map_err(|e| format!("{}: {e}", path.display()))?;
            scenes.push(Scene {
                name: name.to_owned(),
                source: pair.source,
                target: pair.target,
            });
        }
    }
    Ok(scenes)
}

/// The first pair of the default street with another lidar.
pub(crate) fn street(beams: usize, azimuth_steps: usize) -> Result<Scene, String> {
    let options = StreetOptions {
        beams,
        azimuth_steps,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).and_then(|street| street.pair(0));
    let pair = pair.map_err(|e| e.to_string())?;
    Ok(Scene {
        name: format!("street, {beams} beams"),
        source: pair.source,
        target: pair.target,
    })
}

/// The upper median of the values.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
