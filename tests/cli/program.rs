//! Runs the program and captures its output.

use std::path::Path;
use std::process::Command;

/// Exit code and output of a run.
pub(crate) struct Ended {
    pub(crate) code: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

/// Runs `fnsf` in `folder`.
pub(crate) fn fnsf(folder: &Path, arguments: &[&str]) -> Ended {
    let output = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(arguments)
        .current_dir(folder)
        .env_remove("FNSF_ALLOW_SOFTWARE_GPU")
        .output()
        .expect("the program starts");
    Ended {
        code: output.status.code().expect("no signal ended it"),
        stdout: String::from_utf8(output.stdout).expect("text"),
        stderr: String::from_utf8(output.stderr).expect("text"),
    }
}

/// Runs `fnsf`, expects success, and parses its JSON output.
pub(crate) fn json(folder: &Path, arguments: &[&str]) -> serde_json::Value {
    let ended = fnsf(folder, arguments);
    assert_eq!(ended.code, 0, "{arguments:?}: {}", ended.stderr);
    serde_json::from_str(&ended.stdout).expect("one JSON object")
}

/// Simulates a street of so many sweeps in the folder `street` of `folder`.
pub(crate) fn street(folder: &Path, sweeps: &str) {
    let arguments = ["synth", "-o", "street", "--beams", "16", "--sweeps", sweeps];
    let ended = fnsf(folder, &arguments);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
}
