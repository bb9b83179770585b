//! Whether what needs a GPU is tested here: one rule for all tests, inside the crate and outside.

/// Whether to go on where so many cards were found, software included. Where there is none, a test
/// leaves it at that and says so, unless `FNSF_REQUIRE_GPU=1` makes it a failure.
///
/// # Panics
/// Where a card is required and there is none.
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
