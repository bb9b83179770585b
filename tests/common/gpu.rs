//! The rule for tests that need a GPU, shared by unit tests and integration tests.

/// Whether a test that needs a GPU runs, given the number of GPUs found, software ones included.
/// Without a GPU the test is skipped with a message, unless `FNSF_REQUIRE_GPU=1` makes it fail.
///
/// # Panics
/// If a GPU is required and none is found.
#[expect(clippy::print_stderr, reason = "a test says what it leaves out")]
pub(crate) fn is_there(cards: usize) -> bool {
    let required = std::env::var_os("FNSF_REQUIRE_GPU").is_some_and(|value| value == "1");
    assert!(
        cards > 0 || !required,
        "FNSF_REQUIRE_GPU is set and no GPU is found: fnsf doctor says how to mend it"
    );
    if cards == 0 {
        eprintln!("there is no GPU: what needs one is not tested");
    }
    cards > 0
}
