//! The docs name all that a user can meet: configuration keys, metrics, alerts, errors and job
//! options; and their links resolve.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

pub(super) fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).expect("a file of the repository is readable")
}

/// The names that `line` gives for the lines of a file and that a page does not hold in backticks
/// or as a heading.
fn missing(file: &str, page: &str, name: impl Fn(&str) -> Option<String>) -> Vec<String> {
    let page = read(page);
    let source = read(file);
    let names: BTreeSet<String> = source.lines().filter_map(name).collect();
    assert!(!names.is_empty(), "{file} names nothing");
    let is_there = |name: &String| {
        page.contains(&format!("`{name}`")) || page.contains(&format!("### {name}\n"))
    };
    names.into_iter().filter(|name| !is_there(name)).collect()
}

/// The text between two marks.
fn between<'a>(line: &'a str, from: &str, to: &str) -> Option<&'a str> {
    let (_, rest) = line.split_once(from)?;
    rest.split_once(to).map(|(found, _)| found)
}

#[test]
fn every_configuration_key_is_described() {
    let key = |line: &str| {
        let line = line.trim_start_matches('#').trim();
        let (key, value) = line.split_once(" = ")?;
        let is_key = key.chars().all(|c| c.is_ascii_lowercase() || c == '_');
        (is_key && !value.is_empty()).then(|| key.to_owned())
    };
    let file = "deploy/fnsf.example.toml";
    assert_eq!(missing(file, "docs/configuration.md", key), [""; 0]);
}

#[test]
fn every_alert_has_a_runbook() {
    let alert = |line: &str| Some(line.trim().strip_prefix("- alert: ")?.to_owned());
    let file = "deploy/prometheus/rules/fnsf.yml";
    assert_eq!(missing(file, "docs/operations.md", alert), [""; 0]);
}

#[test]
fn every_metric_is_described() {
    let page = read("docs/operations.md");
    let source = read("src/metrics/register.rs");
    let calls = source.split("registry.register").skip(1);
    let names: Vec<&str> = calls.filter_map(|call| between(call, "\"", "\"")).collect();
    assert!(names.len() > 20, "{names:?}");
    let is_missing = |name: &&str| !page.contains(&format!("`fnsf_{name}"));
    let gone: Vec<_> = names.into_iter().filter(is_missing).collect();
    assert_eq!(gone, [""; 0]);
}

#[test]
fn every_error_code_is_in_the_table_of_errors() {
    let source = read("src/api/error.rs");
    let table = between(&source, "const ERRORS: ", "];").expect("the table of errors");
    let page = read("docs/api.md");
    let rows = table.split("row(").skip(1);
    let codes: Vec<&str> = rows.filter_map(|row| between(row, "\"", "\"")).collect();
    assert!(codes.len() > 20, "{codes:?}");
    let is_missing = |code: &&str| !page.contains(&format!("`{code}`"));
    let gone: Vec<_> = codes.into_iter().filter(is_missing).collect();
    assert_eq!(gone, [""; 0]);
}

#[test]
fn every_job_option_is_described() {
    let source = read("src/job/options.rs");
    let options = between(&source, "pub struct JobOptions {", "\n}").expect("the options");
    let page = read("docs/api.md");
    let names = options
        .lines()
        .filter_map(|line| between(line, "    pub ", ":"));
    let gone: Vec<&str> = names
        .filter(|name| !page.contains(&format!("`{name}`")))
        .collect();
    assert_eq!(gone, [""; 0]);
}

#[test]
fn the_image_is_built_from_every_folder_that_the_program_includes() {
    let mut files = Vec::new();
    crate::collect(&root().join("src"), &mut files);
    let recipe = read("Dockerfile");
    let mut folders = Vec::new();
    for file in files {
        let text = fs::read_to_string(&file).expect("a source is readable");
        let included = text.split("include_bytes!(").skip(1);
        let paths = included.filter_map(|rest| between(rest, "\"", "\""));
        // A path that leaves the folder of sources: "../../../console/".
        let outside = paths.filter(|path| path.starts_with("../"));
        folders.extend(outside.map(|path| path.trim_start_matches("../").to_owned()));
    }
    assert!(folders.contains(&"console/".to_owned()), "{folders:?}");
    let is_left_out = |folder: &String| {
        let folder = folder.split('/').next().unwrap_or_default();
        !recipe.contains(&format!("COPY {folder} "))
    };
    folders.retain(is_left_out);
    assert_eq!(folders, [""; 0]);
}

/// All pages of the repository but those of its dependencies and outputs.
fn pages(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("a folder is readable") {
        let path = entry.expect("an entry is readable").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if path.is_dir() {
            if !name.starts_with('.') && name != "target" {
                pages(&path, found);
            }
        } else if name.ends_with(".md") {
            found.push(path);
        }
    }
}

/// The anchor of a heading, as forges make it.
fn anchor(heading: &str) -> String {
    let letters = heading.trim_start_matches('#').trim().chars();
    letters
        .filter_map(|letter| match letter {
            ' ' => Some('-'),
            '-' | '_' => Some(letter),
            letter => letter
                .is_alphanumeric()
                .then(|| letter.to_ascii_lowercase()),
        })
        .collect()
}

#[test]
fn every_link_between_pages_resolves() {
    let mut all = Vec::new();
    pages(root(), &mut all);
    let mut broken = Vec::new();
    for page in &all {
        let text = fs::read_to_string(page).expect("a page is readable");
        for link in text.split("](").skip(1) {
            let link = link.split([')', ' ']).next().unwrap_or_default();
            if link.contains("://") || link.is_empty() {
                continue;
            }
            let (file, wanted) = link.split_once('#').unwrap_or((link, ""));
            let target = match file {
                "" => page.clone(),
                file => page.parent().expect("a page lies in a folder").join(file),
            };
            let has_anchor = || {
                let text = fs::read_to_string(&target).unwrap_or_default();
                let headings = text.lines().filter(|line| line.starts_with('#'));
                headings.map(anchor).any(|anchor| anchor == wanted)
            };
            if !target.exists() || (!wanted.is_empty() && !has_anchor()) {
                broken.push(format!("{}: {link}", page.display()));
            }
        }
    }
    assert!(all.len() > 20, "{all:?}");
    assert_eq!(broken, [""; 0]);
}

/// A path in the repository that stands in backticks, if `quoted` is one. Names in capitals stand for others.
fn named_path(quoted: &str) -> Option<&str> {
    const FOLDERS: [&str; 9] = [
        "src", "tests", "docs", "benches", "deploy", "clients", "console", "fuzz", "proto",
    ];
    let (folder, rest) = quoted.split_once('/')?;
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "._-/".contains(c);
    let is_path = FOLDERS.contains(&folder) && !rest.is_empty() && rest.chars().all(is_plain);
    (is_path && !rest.contains("NAME")).then_some(quoted)
}

#[test]
fn every_file_that_a_page_names_is_there() {
    let mut all = Vec::new();
    pages(root(), &mut all);
    let (mut named, mut missing) = (0, Vec::new());
    for page in &all {
        let text = fs::read_to_string(page).expect("a page is readable");
        for path in text.split('`').filter_map(named_path) {
            named += 1;
            if !root().join(path).exists() {
                missing.push(format!("{}: {path}", page.display()));
            }
        }
    }
    assert!(named > 200, "{named}");
    assert_eq!(missing, [""; 0]);
}
