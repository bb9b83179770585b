//! The camera of the examples.

use fnsf::flow::RigidTransform;
use fnsf::flow::depth::{Camera, DepthImage, Intrinsics};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

/// A camera similar to KITTI's: 1242 x 375 pixels, 6 cm beside, 8 cm below and 27 cm in front of
/// the lidar.
pub(crate) fn camera() -> anyhow::Result<Camera> {
    let intrinsics = Intrinsics {
        fx: 721.5,
        fy: 721.5,
        cx: 609.6,
        cy: 172.9,
    };
    let turn = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    let mount = RigidTransform::from_parts([0.06, -0.08, -0.27].into(), turn);
    Ok(Camera::new(intrinsics, mount, [1242, 375])?)
}

/// A row of a table of depth: the share of known pixels, the mean error and the RMSE, metres, and
/// the share of pixels within 5 % of the true depth.
pub(crate) fn depth_row(image: &DepthImage, truth: &DepthImage) -> anyhow::Result<[f64; 4]> {
    let errors = image.errors(truth)?;
    Ok([
        image.density(),
        errors.mean_m,
        errors.rmse_m,
        errors.within_5_percent,
    ])
}
