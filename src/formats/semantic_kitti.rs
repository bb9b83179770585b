//! Labels of SemanticKITTI: a little-endian 32-bit number for each point of a sweep, whose lower half is
//! the class and whose upper half an instance, here none.

use super::flow_file::FlowTable;

/// A point without an estimate, which evaluations leave out.
const UNLABELED: u32 = 0;
/// A class of the static world in the benchmark of moving object segmentation.
const STATIC: u32 = 9;
/// A class of what moves there.
const MOVING: u32 = 251;

/// The labels of N points for the segmentation of moving objects: 251 for a point that moves, 9 for one
/// that does not, and 0 for one without a flow. 4 N bytes.
pub fn moving_labels(table: &FlowTable<'_>) -> Vec<u8> {
    let moves = |row: usize| table.dynamic.is_some_and(|dynamic| dynamic[row]);
    let labels = table.valid.iter().enumerate();
    let labels = labels.map(|(row, is_valid)| match (is_valid, moves(row)) {
        (false, _) => UNLABELED,
        (true, false) => STATIC,
        (true, true) => MOVING,
    });
    labels.flat_map(u32::to_le_bytes).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_moving_static_or_without_label() {
        let table = FlowTable {
            source: &[[0.0; 3]; 4],
            flow: &[[0.0; 3]; 4],
            valid: &[true, true, false, true],
            dynamic: Some(&[true, false, true, true]),
            objects: None,
            ego: None,
        };
        let bytes = moving_labels(&table);
        assert_eq!(bytes[..4], [0xfb, 0, 0, 0]);
        let labels: Vec<u8> = bytes.chunks(4).map(|label| label[0]).collect();
        assert_eq!(labels, [251, 9, 0, 251]);
        let unknown = FlowTable {
            dynamic: None,
            ..table
        };
        assert_eq!(moving_labels(&unknown)[..4], [9, 0, 0, 0]);
    }
}
