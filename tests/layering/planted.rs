//! The planted bugs of `tests/planted` fit the sources, and each of them is looked for.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/planted")
}

/// The name and the text of each patch.
fn patches() -> Vec<(String, String)> {
    let entries = fs::read_dir(folder()).expect("a folder of patches");
    let paths = entries.map(|entry| entry.expect("an entry is readable").path());
    let patches = paths.filter(|path| path.extension().is_some_and(|kind| kind == "patch"));
    let named = patches.map(|path| {
        let name = path.file_stem().expect("a name").to_string_lossy();
        let text = fs::read_to_string(&path).expect("a patch is readable");
        (name.into_owned(), text)
    });
    named.collect()
}

/// The hunks of a patch in unified format: the file, and the lines that have to be in it.
fn hunks(patch: &str) -> Vec<(String, String)> {
    let mut hunks: Vec<(String, String)> = Vec::new();
    let mut file = "";
    for line in patch.lines() {
        if let Some(path) = line.strip_prefix("--- a/") {
            file = path;
        } else if line.starts_with("@@ ") {
            hunks.push((file.to_owned(), String::new()));
        } else if let Some(old) = line.strip_prefix([' ', '-']) {
            let (_, lines) = hunks.last_mut().expect("lines follow a hunk's header");
            lines.push_str(old);
            lines.push('\n');
        }
    }
    hunks
}

#[test]
fn every_planted_bug_fits_the_sources() {
    for (name, patch) in patches() {
        let hunks = hunks(&patch);
        assert!(!hunks.is_empty(), "{name} changes nothing");
        for (file, lines) in hunks {
            let root = Path::new(env!("CARGO_MANIFEST_DIR"));
            let source = fs::read_to_string(root.join(&file)).expect("a source is readable");
            assert_eq!(
                source.matches(&lines).count(),
                1,
                "{name}, {file}:\n{lines}"
            );
        }
    }
}

#[test]
fn every_planted_bug_is_looked_for_and_described() {
    let read = |file: &str| fs::read_to_string(folder().join(file)).expect("a text is readable");
    let expected = read("expected");
    let lines = expected.lines().filter(|line| !line.starts_with('#'));
    let looked_for: BTreeSet<&str> = lines.filter_map(|line| line.split(' ').next()).collect();
    let patches = patches();
    let planted: BTreeSet<&str> = patches.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(looked_for, planted);
    let page = read("README.md");
    assert!(
        planted
            .iter()
            .all(|name| page.contains(&format!("| `{name}` |")))
    );
}
