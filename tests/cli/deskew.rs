//! Tests of deskewing: sweeps whose points have times.

use fnsf::flow::Point;
use fnsf::formats::{read_cloud, read_pair};

use super::program::{fnsf, json, street};
use super::sequences::SWEEPS;

/// Writes a street with times of its points, at a speed at which it is deskewed.
fn rolling_street(folder: &std::path::Path) {
    let arguments = ["synth", "-o", "street", "--rolling", "--speed-mps", "25"];
    assert_eq!(fnsf(folder, &arguments).code, 0);
}

#[test]
fn rolling_sweeps_are_deskewed_and_their_flow_starts_from_the_deskewed_points() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    rolling_street(folder);
    let sweeps = ["flow", "street/sweep_0000.pcd", "street/sweep_0001.pcd"];
    let run = |options: &[&str]| json(folder, &[&sweeps[..], options, &["--json"]].concat());
    let report = run(&["-o", "flow.ply"]);
    assert_eq!(report["deskew"]["applied"], true, "{report}");
    let distance = |at: usize| report["deskew"]["distance_m"][at].as_f64();
    assert!(distance(1) < distance(0), "{report}");
    let dt_s = report["dt_s"].as_f64().expect("a number");
    assert!((0.098..=0.1).contains(&dt_s), "the sweep lasts {dt_s} s");
    let error = |output: &str| {
        let truth = ["eval", output, "--truth", "street/pair_0000.npz", "--json"];
        let score = json(folder, &truth);
        score["epe_static"]
            .as_f64()
            .unwrap_or_else(|| panic!("{score}"))
    };
    let deskewed = error("flow.ply");
    let points = |path: &str| {
        let bytes = std::fs::read(folder.join(path)).expect("written");
        read_cloud(&bytes, None).expect("a cloud").points
    };
    let truth = std::fs::read(folder.join("street/pair_0000.npz")).expect("written");
    let truth = read_pair(&truth).expect("a pair").source;
    let apart = |a: &[Point], b: &[Point]| -> f32 {
        let off = |(a, b): (&Point, &Point)| (0..3).map(|i| (a[i] - b[i]).abs()).sum::<f32>();
        a.iter().zip(b).map(off).sum::<f32>() / a.len() as f32
    };
    assert!(apart(&points("flow.ply"), &truth) < 0.02);
    assert!(apart(&points("street/sweep_0000.pcd"), &truth) > 0.5);
    let report = run(&["--deskew", "off", "-o", "raw.ply"]);
    assert!(report.get("deskew").is_none(), "{report}");
    assert_eq!(report["dt_s"], dt_s, "the times are those of the sensor");
    let raw = error("raw.ply");
    assert!(raw > 3.0 * deskewed, "{raw} {deskewed}");
    let [_, earlier, later] = sweeps;
    let view = ["view", earlier, later, later, "--flow", "flow.ply"];
    let view = fnsf(folder, &view);
    assert_eq!(view.code, 2, "{}", view.stderr);
    assert!(
        view.stderr.contains("of deskewed sweeps"),
        "{}",
        view.stderr
    );
}

#[test]
fn a_pair_with_the_newer_sweep_first_is_deskewed_against_the_direction_of_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    rolling_street(folder);
    let [earlier, later] = ["1700000000000.pcd", "1700000000100.pcd"];
    for (sweep, name) in [
        ("street/sweep_0000.pcd", earlier),
        ("street/sweep_0001.pcd", later),
    ] {
        std::fs::copy(folder.join(sweep), folder.join(name)).expect("copied");
    }
    let report = json(folder, &["flow", later, earlier, "--json"]);
    assert_eq!(report["dt_s"], 0.1, "{report}");
    assert_eq!(report["deskew"]["applied"], true, "{report}");
    // A label does the same, and its report says so.
    let manifest = format!("source,target\n{later},{earlier}\n");
    std::fs::write(folder.join("pairs.csv"), manifest).expect("written");
    for end in [&["--preset", "default"][..], &["--finalize"]] {
        let done = fnsf(
            folder,
            &[&["label", "pairs.csv", "-o", "labels"], end].concat(),
        );
        assert_eq!(done.code, 0, "{}", done.stderr);
    }
    let table = std::fs::read_to_string(folder.join("labels/_report.csv")).expect("written");
    assert!(table.contains(",true,0"), "{table}");
    // Without timestamps in the names the first sweep counts as the earlier one.
    let unnamed = ["street/sweep_0001.pcd", "street/sweep_0000.pcd"];
    let report = json(folder, &["flow", unnamed[0], unnamed[1], "--json"]);
    assert_eq!(report["deskew"]["applied"], false, "{report}");
}

#[test]
fn deskewing_is_refused_where_it_is_asked_for_and_cannot_be_done() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    for (arguments, code, reason) in [
        (
            vec!["street/pair_0000.npz"],
            2,
            "an .npz pair have no times",
        ),
        (
            SWEEPS[..2].to_vec(),
            65,
            "sweep_0000.pcd: its points have no times",
        ),
        (
            [&SWEEPS[..2], &["--ego", "off"]].concat(),
            2,
            "needs the ego motion",
        ),
    ] {
        let asked = ["flow", "--deskew", "on", "--json"];
        let done = fnsf(folder, &[&asked[..], &arguments].concat());
        assert_eq!(done.code, code, "{arguments:?}: {}", done.stderr);
        assert!(done.stderr.contains(reason), "{}", done.stderr);
    }
}
