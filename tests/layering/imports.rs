//! The tables of ARCHITECTURE.md name every module of `src` and of `src/flow`, and all that each imports.

use std::collections::BTreeSet;

use super::circles::{Edges, edges};
use super::{docs, sources};

/// The names in backticks of a cell, without folders' slashes and files' endings.
fn names(cell: &str) -> BTreeSet<String> {
    let code = cell.split('`').skip(1).step_by(2);
    code.map(|name| {
        name.trim_end_matches('/')
            .trim_end_matches(".rs")
            .to_owned()
    })
    .collect()
}

/// The rows of the table below a heading: the modules, and what the last column says they import.
fn rows(page: &str, heading: &str) -> Vec<[BTreeSet<String>; 2]> {
    let (_, table) = page.split_once(&format!("{heading}\n")).expect(heading);
    let lines = table.lines().skip_while(|line| !line.starts_with("| `"));
    lines
        .take_while(|line| line.starts_with('|'))
        .map(|line| {
            let mut cells = line.trim_matches('|').split(" | ");
            let [first, last] = [cells.next(), cells.last()];
            [first, last].map(|cell| names(cell.expect("a table of three columns")))
        })
        .collect()
}

/// What modules import beside each other.
fn imports(edges: &Edges, folder: &[String], modules: &BTreeSet<String>) -> BTreeSet<String> {
    let nodes = &edges[folder];
    let found = modules.iter().filter_map(|module| nodes.get(module));
    let found = found.flatten().filter(|name| *name != "mod");
    found
        .filter(|name| !modules.contains(*name))
        .cloned()
        .collect()
}

#[test]
fn the_tables_of_modules_name_all_that_each_imports() {
    let edges = edges(&sources());
    let page = docs::read("ARCHITECTURE.md");
    let mut wrong = Vec::new();
    for (heading, folder) in [
        ("## Modules of `src`", vec![]),
        ("## Modules of `src/flow`", vec!["flow".to_owned()]),
    ] {
        let mut all: BTreeSet<String> = edges[&folder].keys().cloned().collect();
        all.remove("mod");
        for [modules, claimed] in rows(&page, heading) {
            let found = imports(&edges, &folder, &modules);
            if found != claimed {
                wrong.push(format!("{heading}, {modules:?}: {found:?}"));
            }
            all.retain(|module| !modules.contains(module));
        }
        assert_eq!(all, BTreeSet::new(), "{heading} lacks modules");
    }
    assert_eq!(wrong, [""; 0]);
}
