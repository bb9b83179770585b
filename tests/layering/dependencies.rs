//! The tests' dependencies, read from `cargo tree`.

use std::collections::BTreeSet;
use std::process::Command;

/// The packages that are built for these kinds of dependencies: name, version, features.
fn packages(edges: &str) -> BTreeSet<String> {
    let listed = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--offline", "--prefix", "none"])
        .args(["--format", "{p} {f}", "--edges", edges])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo starts");
    let error = String::from_utf8_lossy(&listed.stderr);
    assert!(listed.status.success(), "{error}");
    let lines = String::from_utf8(listed.stdout).expect("text");
    let without_mark = |line: &str| line.trim_end_matches(" (*)").to_owned();
    lines.lines().map(without_mark).collect()
}

/// Otherwise all that depends on one with more features would be compiled twice: for the tests, and
/// for the program.
#[test]
fn no_dependency_of_the_tests_adds_a_feature_to_one_of_the_program() {
    let program = packages("normal,build");
    let tests = packages("normal,build,dev");
    let named = |line: &str| line.split(' ').take(2).collect::<Vec<_>>().join(" ");
    let known: BTreeSet<String> = program.iter().map(|line| named(line)).collect();
    assert!(known.len() > 200, "{} packages are listed", known.len());
    let more: Vec<&String> = tests
        .difference(&program)
        .filter(|line| known.contains(&named(line)))
        .collect();
    assert!(
        more.is_empty(),
        "the tests ask for more features, put them into [dependencies]: {more:#?}"
    );
}
