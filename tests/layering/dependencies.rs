//! The dependencies of the tests and of the Python package, read from `cargo tree`.

use std::collections::BTreeSet;
use std::process::Command;

/// The packages that are built for these kinds of dependencies of a package: name, version, features.
fn packages(of: &str, edges: &str) -> BTreeSet<String> {
    let listed = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--offline", "--prefix", "none"])
        .args(["--package", of, "--format", "{p} {f}", "--edges", edges])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo starts");
    let error = String::from_utf8_lossy(&listed.stderr);
    assert!(listed.status.success(), "{error}");
    let lines = String::from_utf8(listed.stdout).expect("text");
    let without_mark = |line: &str| line.trim_end_matches(" (*)").to_owned();
    lines.lines().map(without_mark).collect()
}

/// The packages of `others` that the program has, too, but with other features. All that depends on
/// one would be compiled twice.
fn with_other_features(others: BTreeSet<String>) -> Vec<String> {
    let program = packages("fnsf", "normal,build");
    let named = |line: &str| line.split(' ').take(2).collect::<Vec<_>>().join(" ");
    let known: BTreeSet<String> = program.iter().map(|line| named(line)).collect();
    assert!(known.len() > 200, "{} packages are listed", known.len());
    let differ = others.into_iter();
    let differ = differ.filter(|line| known.contains(&named(line)) && !program.contains(line));
    differ.collect()
}

#[test]
fn no_dependency_of_the_tests_adds_a_feature_to_one_of_the_program() {
    let more = with_other_features(packages("fnsf", "normal,build,dev"));
    assert!(
        more.is_empty(),
        "the tests ask for more features, put them into [dependencies]: {more:#?}"
    );
}

#[test]
fn the_python_package_is_built_from_the_dependencies_of_the_program() {
    /// `cargo tree` shows what build scripts need of tempfile as if the program needed it.
    const BELOW_TEMPFILE: [&str; 3] = ["linux-raw-sys ", "once_cell ", "rustix "];
    let mut differ = with_other_features(packages("fnsf-python", "normal,build"));
    differ.retain(|line| !BELOW_TEMPFILE.iter().any(|name| line.starts_with(name)));
    differ.extend(with_other_features(packages("fnsf-python", "normal")));
    // It is the library without the service.
    differ.retain(|line| !line.starts_with("fnsf v"));
    assert!(
        differ.is_empty(),
        "these have other features than in the program, see clients/python/Cargo.toml: {differ:#?}"
    );
}
