//! Stored bytes, with a right checksum: what is read is written again as it was.

use fnsf::flow::{MotionField, Snapshot};
use fnsf::payload::{StoredCloud, StoredDense, StoredFlow};
use libfuzzer_sys::Corpus;

/// Bytes of the checksum of a stored cloud, flow or dense cloud.
const SUM: usize = 16;

/// Stored clouds, flows and dense clouds.
pub(crate) fn stored(bytes: &[u8]) -> Corpus {
    let mut sealed = bytes.to_vec();
    sealed.extend(&blake3::hash(bytes).as_bytes()[..SUM]);
    let written = match bytes.get(..7) {
        Some(b"fnsfcld") => StoredCloud::from_bytes(&sealed).map(|cloud| cloud.to_bytes()),
        Some(b"fnsfflw") => StoredFlow::from_bytes(&sealed).map(|flow| flow.to_bytes()),
        Some(b"fnsfdns") => StoredDense::from_bytes(&sealed).map(|dense| dense.to_bytes()),
        _ => return Corpus::Reject,
    };
    if let Ok(written) = written {
        // Flags are any number but 0.
        assert_eq!(written.len(), sealed.len());
    }
    Corpus::Keep
}

/// Snapshots of fits and motion fields.
pub(crate) fn numeric(bytes: &[u8]) -> Corpus {
    let fold = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    let sum = bytes.iter().fold(0xcbf2_9ce4_8422_2325, fold);
    let mut sealed = bytes.to_vec();
    sealed.extend(sum.to_le_bytes());
    match bytes.get(..8) {
        Some(b"FNSFSNAP") => {
            if let Ok(snapshot) = Snapshot::from_bytes(&sealed) {
                let _iterations = snapshot.iterations();
                let again = Snapshot::from_bytes(&snapshot.to_bytes());
                assert!(again.is_ok_and(|again| again.iterations() == snapshot.iterations()));
            }
        }
        Some(b"FNSFFILD") => {
            if let Ok(field) = MotionField::from_bytes(&sealed) {
                let again = MotionField::from_bytes(&field.to_bytes());
                assert!(again.is_ok(), "what was written is not read");
            }
        }
        _ => return Corpus::Reject,
    }
    Corpus::Keep
}
