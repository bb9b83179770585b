//! The folder of real sweeps that tests read.

use std::path::PathBuf;

/// The folder that `FNSF_REAL_DATA` names; none, with a message, where it is not set.
///
/// # Panics
/// Where `FNSF_REQUIRE_REAL_DATA` is `1` and there is no folder.
pub(crate) fn real_data() -> Option<PathBuf> {
    let folder = std::env::var_os("FNSF_REAL_DATA").map(PathBuf::from);
    let is_required = std::env::var_os("FNSF_REQUIRE_REAL_DATA").is_some_and(|value| value == "1");
    assert!(
        folder.is_some() || !is_required,
        "FNSF_REQUIRE_REAL_DATA=1 and FNSF_REAL_DATA is not set"
    );
    if folder.is_none() {
        eprintln!("FNSF_REAL_DATA is not set: nothing is tested on real data");
    }
    folder
}
