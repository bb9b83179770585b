//! Tests of `fnsf tables`.

use std::fs;

use super::program::{fnsf, street};

#[test]
fn the_methods_come_side_by_side_as_text_csv_json_and_plots() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let only = "fnsf,fnsf-sampled-loss,nsfp-kdtree-every-5,nsfp++-dt,default";
    let usual = ["tables", "street/pair_0000.npz", "--max-points", "500"];
    let more = ["--only", only, "--seeds", "2", "--cells", "--bev"];
    let out = ["--csv", "t.csv", "--json", "t.json", "--plots", "."];
    let done = fnsf(folder, &[&usual[..], &more, &out].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    for method in only.split(',') {
        let row = done
            .stdout
            .lines()
            .find(|line| line.starts_with(&format!("| {method} |")));
        let row = row.unwrap_or_else(|| panic!("{method}: {}", done.stdout));
        assert!(row.contains("(2)"), "{row}");
    }
    assert!(done.stdout.contains("bird's eye view"));

    let csv = fs::read_to_string(folder.join("t.csv")).expect("csv");
    let columns = csv.lines().next().map(|line| line.split(',').count());
    assert_eq!(csv.lines().count(), 6);
    assert!(
        csv.lines()
            .all(|line| Some(line.split(',').count()) == columns)
    );

    let json = fs::read_to_string(folder.join("t.json")).expect("json");
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(json["methods"][0]["method"], "fnsf");
    assert_eq!(json["methods"][0]["paper_total_seconds"], 0.51);
    let device = json["methods"][0]["device"].as_str().expect("a device");
    assert!(device.starts_with("cpu"), "{device}");
    assert!(json["methods"][4]["iterations"].is_null());
    let cells = json["cells"].as_array().expect("cells");
    assert_eq!(cells.len(), 8);
    // On a plane the finest cells fit in memory.
    assert!(cells.iter().all(|cell| cell["refused"].is_null()), "{json}");
    for plot in ["time_error", "cells_error", "cells_time", "cells_memory"] {
        let svg = fs::read_to_string(folder.join(format!("{plot}.svg"))).expect("a plot");
        assert!(svg.starts_with("<svg") && svg.contains("<circle"), "{plot}");
    }
}

#[test]
fn a_run_beyond_its_budget_is_cut_and_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let usual = ["tables", "street/pair_0000.npz", "--max-points", "2000"];
    let more = ["--only", "nsfp", "--budget", "0.5"];
    let done = fnsf(folder, &[&usual[..], &more].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert!(done.stdout.contains("(cut)"), "{}", done.stdout);
}

#[test]
fn what_cannot_be_tabled_is_refused_before_any_work() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let pair = "street/pair_0000.npz";
    for (arguments, code, said) in [
        (
            vec!["--only", "best"],
            2,
            "is none of fnsf, fnsf-linear, nsfp",
        ),
        (vec!["--budget", "0"], 2, "--budget 0: a number above 0"),
        (vec!["--budget", "nan"], 2, "a number above 0"),
        (vec!["--bev"], 2, "--cells"),
        (vec!["--device", "auto"], 2, "name cpu or gpu"),
        (vec!["--plots", "nowhere"], 2, "there is no such folder"),
        (vec!["--csv", pair], 2, "would be written over"),
    ] {
        let refused = fnsf(folder, &[&["tables", pair][..], &arguments].concat());
        assert_eq!(
            (refused.code, refused.stdout.as_str()),
            (code, ""),
            "{arguments:?}"
        );
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }
    let untrue = fnsf(folder, &["tables", "street/sweep_0000.pcd"]);
    assert_eq!(untrue.code, 65);
}
