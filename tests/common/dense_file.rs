//! Files of dense clouds, for tests of LAS and LAZ.

use fnsf::flow::{DenseCloud, Point};
use fnsf::formats::{DenseFormat, write_dense};

/// A file with these points, all of sweep 0.
pub(crate) fn dense_file(format: DenseFormat, points: &[Point]) -> Vec<u8> {
    let count = points.len();
    let cloud = DenseCloud {
        points: points.to_vec(),
        sweep: vec![0; count],
        age: vec![0.5; count],
        dynamic: vec![false; count],
        converged: vec![true; count],
    };
    let mut bytes = Vec::new();
    write_dense(format, &cloud, None, &mut bytes).expect("written");
    bytes
}
