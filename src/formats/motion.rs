//! Rigid motions as 4 x 4 matrices: in pairs, in flow files, and as text of 16 numbers.

use nalgebra::{Matrix3, Matrix4, Rotation3, Translation3, UnitQuaternion};

use super::error::FormatError;
use super::limits::MAX_COORDINATE_M;
use crate::flow::RigidTransform;

/// Tolerance of a stored rotation from orthonormal. float32 matrices are within 1e-6. A scale or a
/// shear that would move a point 100 m away by a decimetre is refused.
const RIGID_TOLERANCE: f64 = 1e-3;

/// Longest text that is parsed as 16 numbers, bytes.
const MAX_TEXT: usize = 4096;

/// Reads a rigid motion from text: the 16 numbers of a 4 x 4 matrix, row by row, separated by white
/// space or commas. The translation is in metres.
///
/// # Errors
/// [`FormatError::Motion`] where the text is longer than 4,096 bytes or is not 16 numbers, or
/// [`ego_motion`] refuses the matrix.
pub fn read_motion(bytes: &[u8]) -> Result<RigidTransform, FormatError> {
    let text = core::str::from_utf8(bytes).ok();
    let Some(text) = text.filter(|text| text.len() <= MAX_TEXT) else {
        return Err(FormatError::Motion("16 numbers as text are needed"));
    };
    let words = text.split(|c: char| c.is_whitespace() || c == ',');
    let numbers: Result<Vec<f64>, _> = words.filter(|w| !w.is_empty()).map(str::parse).collect();
    let Some(numbers) = numbers.ok().filter(|numbers| numbers.len() == 16) else {
        return Err(FormatError::Motion("16 numbers as text are needed"));
    };
    ego_motion(&core::array::from_fn(|row| {
        core::array::from_fn(|column| numbers[4 * row + column])
    }))
}

/// The rigid motion between two sweeps, from its 4 x 4 matrix, row by row, translation in metres.
///
/// The matrix is checked and its rotation normalized as by [`rigid_motion`]. In addition, each
/// component of the translation is limited to [`MAX_COORDINATE_M`] in magnitude. A pose in a city's
/// frame may exceed that limit: use [`rigid_motion`] for it.
///
/// # Errors
/// [`FormatError::Motion`] where [`rigid_motion`] refuses the matrix, or a component of its
/// translation is larger in magnitude than [`MAX_COORDINATE_M`].
pub fn ego_motion(rows: &[[f64; 4]; 4]) -> Result<RigidTransform, FormatError> {
    let motion = rigid_motion(rows)?;
    if motion.translation.vector.amax() > MAX_COORDINATE_M {
        return Err(FormatError::Motion("the motion is longer than 1e6 m"));
    }
    Ok(motion)
}

/// The rigid transform given by a 4 x 4 matrix, row by row, translation in metres. The rotation R
/// of the result is normalized.
///
/// # Errors
/// [`FormatError::Motion`] where a number is not finite, the last row is not 0 0 0 1, an entry of
/// R^T R differs from the identity by more than 1e-3 (scale or shear), or R mirrors.
pub fn rigid_motion(rows: &[[f64; 4]; 4]) -> Result<RigidTransform, FormatError> {
    let matrix = Matrix4::from_fn(|row, column| rows[row][column]);
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let departure = (rotation.transpose() * rotation - Matrix3::identity())
        .abs()
        .max();
    let last_row_is_plain = rows[3] == [0.0, 0.0, 0.0, 1.0];
    let finite = matrix.iter().all(|value| value.is_finite());
    if !finite || !last_row_is_plain || departure > RIGID_TOLERANCE || rotation.determinant() < 0.0
    {
        return Err(FormatError::Motion("the matrix is not a rigid transform"));
    }
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    // The quaternion of a rounded matrix does not have unit length, and would scale points.
    let rotation = UnitQuaternion::new_normalize(rotation.into_inner());
    let translation = Translation3::new(rows[0][3], rows[1][3], rows[2][3]);
    Ok(RigidTransform::from_parts(translation, rotation))
}

/// The 4 x 4 matrix of a rigid transform, row by row. The first three rows end with the
/// translation, in the transform's unit; the last row is 0 0 0 1.
pub fn matrix_rows(transform: &RigidTransform) -> [[f64; 4]; 4] {
    let matrix = transform.to_homogeneous();
    core::array::from_fn(|row| core::array::from_fn(|column| matrix[(row, column)]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_comes_back_from_its_text() {
        let motion = RigidTransform::new([1.0, -2.0, 0.5].into(), [0.1, 0.0, -0.3].into());
        let text = matrix_rows(&motion)
            .map(|row| row.map(|x| x.to_string()).join(" "))
            .join("\n");
        let read = read_motion(text.as_bytes()).expect("a rigid motion");
        assert!(
            (read.to_homogeneous() - motion.to_homogeneous())
                .abs()
                .max()
                < 1e-12
        );
    }

    #[test]
    fn a_matrix_printed_with_few_digits_is_still_a_rotation() {
        let text = "0.866 -0.5 0 1  0.5 0.866 0 2  0 0 1 3  0 0 0 1";
        let read = read_motion(text.as_bytes()).expect("rounded to a thousandth");
        assert!((read.rotation.quaternion().norm() - 1.0).abs() < 1e-15);
        let turned = read.rotation * nalgebra::Vector3::x();
        assert!((turned.norm() - 1.0).abs() < 1e-15);
    }

    #[test]
    fn what_is_no_rigid_motion_is_refused() {
        let scaled = "2 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1";
        let mirrored = "-1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1";
        let short = "1 0 0 0";
        let wild = "nan 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1";
        let far = "1 0 0 1e7  0 1 0 0  0 0 1 0  0 0 0 1";
        for text in [scaled, mirrored, short, wild, far, "", "\u{fffd}"] {
            assert!(read_motion(text.as_bytes()).is_err(), "{text}");
        }
    }
}
