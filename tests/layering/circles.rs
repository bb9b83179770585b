//! No import circle between the files of a folder, everywhere in `src`: each part can be read, and
//! changed, after those that it imports.
//!
//! The nodes of a folder are its files and its subfolders. A name that the folder's `mod.rs`
//! re-exports belongs to the file that it comes from.

use std::collections::{BTreeMap, BTreeSet};

use super::{Source, sources};

pub(super) type Module = Vec<String>;

/// What imports what, by folder: from the node to the nodes that it names.
pub(super) type Edges = BTreeMap<Module, BTreeMap<String, BTreeSet<String>>>;

/// The module of a file: `flow/data/mod.rs` and `flow/data.rs` are both `flow::data`.
fn module(path: &str) -> Module {
    let path = path.strip_suffix(".rs").unwrap_or(path);
    let parts = path.split('/').map(str::to_owned);
    let mut parts: Module = parts.collect();
    if ["mod", "lib", "main"].contains(&parts.last().map_or("", String::as_str)) {
        parts.pop();
    }
    parts
}

/// The paths of a use tree, without aliases: `a::{b, c::d}` is `a::b` and `a::c::d`.
fn expand(prefix: &[String], tree: &str, paths: &mut Vec<Module>) {
    let tree = tree.trim();
    let segments = |text: &str| -> Module {
        let names = text.split("::").map(str::trim);
        let names = names.filter(|name| !name.is_empty() && *name != "self");
        prefix
            .iter()
            .cloned()
            .chain(names.map(str::to_owned))
            .collect()
    };
    let Some((head, rest)) = tree.split_once('{') else {
        let path = tree.split(" as ").next().unwrap_or_default();
        if !path.trim().is_empty() {
            paths.push(segments(path));
        }
        return;
    };
    let (head, rest) = (segments(head), rest.trim_end().trim_end_matches('}'));
    let (mut depth, mut first) = (0, 0);
    for (at, letter) in rest.char_indices().chain([(rest.len(), ',')]) {
        match letter {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                expand(&head, &rest[first..at], paths);
                first = at + 1;
            }
            _ => {}
        }
    }
}

/// All paths that the code names: those of its use statements, and those that begin with `crate` or
/// `super` elsewhere.
fn paths(code: &str) -> Vec<Module> {
    let mut paths = Vec::new();
    let mut rest = String::new();
    for statement in code.split_inclusive(';') {
        let start = statement.rfind("use ").filter(|&at| {
            let before = statement[..at].trim_end();
            before.is_empty()
                || before.ends_with([';', '{', '}', ']', ')'])
                || before.ends_with("pub")
        });
        match start {
            Some(at) => expand(&[], statement[at + 4..].trim_end_matches(';'), &mut paths),
            None => rest.push_str(statement),
        }
    }
    for word in rest.split(|letter: char| !(letter.is_alphanumeric() || "_:".contains(letter))) {
        if word.starts_with("crate::") || word.starts_with("super::") {
            expand(&[], word, &mut paths);
        }
    }
    paths
}

/// The path from the crate's root, where it is one of this crate.
fn absolute(path: &[String], from: &[String]) -> Option<Module> {
    let ups = path.iter().take_while(|name| *name == "super").count();
    match path.first().map(String::as_str) {
        Some("crate") => Some(path[1..].to_vec()),
        Some("super") => {
            let base = from.get(..from.len().checked_sub(ups)?)?;
            Some([base, &path[ups..]].concat())
        }
        _ => None,
    }
}

/// Modules that are declared for tests alone.
fn is_for_tests(source: &Source, all: &[Source]) -> bool {
    let Some((parent, name)) = module(&source.path)
        .split_last()
        .map(|(name, parent)| (parent.to_vec(), name.clone()))
    else {
        return false;
    };
    let declared = format!("mod {name};");
    all.iter()
        .filter(|other| module(&other.path) == parent)
        .any(|other| {
            let mut lines = other.text.lines();
            while let Some(line) = lines.next() {
                if line.trim() == "#[cfg(test)]"
                    && lines.next().is_some_and(|next| next.ends_with(&declared))
                {
                    return true;
                }
            }
            false
        })
}

pub(super) fn edges(all: &[Source]) -> Edges {
    let modules: BTreeSet<Module> = all.iter().map(|source| module(&source.path)).collect();
    // The child of a folder that a name of its `mod.rs` comes from.
    let mut re_exports: BTreeMap<(Module, String), String> = BTreeMap::new();
    for source in all {
        let folder = module(&source.path);
        for path in paths(&source.code) {
            let is_child = |name: &String| {
                modules.contains(&[folder.as_slice(), std::slice::from_ref(name)].concat())
            };
            if let [child, .., name] = path.as_slice()
                && is_child(child)
            {
                re_exports.insert((folder.clone(), name.clone()), child.clone());
            }
        }
    }
    let mut edges = Edges::new();
    // A folder's `mod.rs` depends on all files of the folder: a name that it defines and one of them
    // imports makes a circle.
    for child in &modules {
        if let Some((name, folder)) = child.split_last() {
            let folder = edges.entry(folder.to_vec()).or_default();
            folder
                .entry("mod".to_owned())
                .or_default()
                .insert(name.clone());
        }
    }
    for source in all.iter().filter(|source| !is_for_tests(source, all)) {
        let from = module(&source.path);
        for target in paths(&source.code)
            .iter()
            .filter_map(|path| absolute(path, &from))
        {
            for depth in 0..from.len() {
                let folder = &from[..depth];
                if !target.starts_with(folder) || target.len() == depth {
                    break;
                }
                let name = &target[depth];
                let child = [folder, std::slice::from_ref(name)].concat();
                let node = if modules.contains(&child) {
                    name.clone()
                } else {
                    let known = re_exports.get(&(folder.to_vec(), name.clone()));
                    known.cloned().unwrap_or_else(|| "mod".to_owned())
                };
                if node != from[depth] {
                    let folder = edges.entry(folder.to_vec()).or_default();
                    folder.entry(from[depth].clone()).or_default().insert(node);
                }
            }
        }
    }
    edges
}

/// The nodes that can be reached from a node.
fn reached<'a>(from: &'a str, edges: &'a BTreeMap<String, BTreeSet<String>>) -> BTreeSet<&'a str> {
    let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
    while let Some(node) = open.pop() {
        for next in edges.get(node).into_iter().flatten() {
            if seen.insert(next.as_str()) {
                open.push(next);
            }
        }
    }
    seen
}

#[test]
fn no_files_of_a_folder_import_each_other_in_a_circle() {
    let all = sources();
    let mut circles = BTreeSet::new();
    for (folder, edges) in edges(&all) {
        for node in edges.keys() {
            let circle = reached(node, &edges).into_iter();
            let circle = circle.filter(|other| reached(other, &edges).contains(node.as_str()));
            let circle: Vec<&str> = circle.collect();
            if circle.contains(&node.as_str()) {
                circles.insert(format!("{}: {}", folder.join("/"), circle.join(", ")));
            }
        }
    }
    assert_eq!(circles.into_iter().collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn use_trees_and_paths_in_code_are_understood() {
    let code = "use crate::a::{self, b::{C, D as E}, *};\npub(crate) use super::x::Y;\n\
                fn f() -> super::super::Z { crate::w::g(1) }";
    let found: Vec<String> = paths(code).iter().map(|path| path.join("::")).collect();
    let expected = [
        "crate::a",
        "crate::a::b::C",
        "crate::a::b::D",
        "crate::a::*",
        "super::x::Y",
        "super::super::Z",
        "crate::w::g",
    ];
    assert_eq!(found, expected);
    let from = module("a/b/c.rs");
    let named = |path: &str| {
        absolute(
            &path.split("::").map(str::to_owned).collect::<Vec<_>>(),
            &from,
        )
    };
    assert_eq!(named("super::x").expect("ours").join("::"), "a::b::x");
    assert_eq!(named("std::fs"), None);
}
