//! Tests of `fnsf eval` with several flows, and of its refusals.

use super::program::{fnsf, json};

/// Two pairs of a street, and their estimated flows.
fn two_flows(folder: &std::path::Path) {
    let made = fnsf(
        folder,
        &["synth", "-o", "street", "--beams", "16", "--sweeps", "3"],
    );
    assert_eq!(made.code, 0, "{}", made.stderr);
    for (out, pair) in [("a.npz", "pair_0000"), ("b.feather", "pair_0001")] {
        let pair = format!("street/{pair}.npz");
        let arguments = ["flow", &pair, "-o", out];
        let done = fnsf(folder, &arguments);
        assert_eq!(done.code, 0, "{}", done.stderr);
    }
}

const PAIRS: [&str; 2] = ["street/pair_0000.npz", "street/pair_0001.npz"];

#[test]
fn several_flows_have_a_row_each_and_one_of_all_their_points() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    two_flows(folder);
    let [first, second] = PAIRS;
    let alone = json(folder, &["eval", "a.npz", "--truth", first, "--json"]);
    assert!(alone["flow"].is_null());
    let many = [
        "eval",
        "a.npz",
        "b.feather",
        "--truth",
        first,
        second,
        "--json",
    ];
    let many = fnsf(folder, &many);
    assert_eq!(many.code, 0, "{}", many.stderr);
    let reports: Vec<serde_json::Value> = many
        .stdout
        .lines()
        .map(|line| serde_json::from_str(line).expect("an object a line"))
        .collect();
    let [a, b, all] = &reports[..] else {
        panic!("{reports:?}");
    };
    assert_eq!(
        (&a["flow"], &b["flow"]),
        (&"a.npz".into(), &"b.feather".into())
    );
    assert_eq!(a["epe"], alone["epe"]);
    let number = |report: &serde_json::Value, key: &str| report[key].as_f64().expect("a number");
    let points = [a, b].map(|report| number(report, "points"));
    assert_eq!(number(all, "points"), points[0] + points[1]);
    let pooled = number(a, "epe") * points[0] + number(b, "epe") * points[1];
    let pooled = pooled / (points[0] + points[1]);
    assert!((number(all, "epe") - pooled).abs() < 1e-12);
    for report in &reports {
        let confidence = &report["confidence"];
        assert!(number(confidence, "calibration_error") < 0.1, "{report}");
        assert!(
            number(confidence, "sure_half_epe") < number(confidence, "rest_epe"),
            "{report}"
        );
        let moving = &report["moving"];
        assert!(number(moving, "calibration_error") < 0.1, "{report}");
        assert!(number(moving, "precision") > 0.5, "{report}");
        let classes = report["bucket_normalized"]["classes"].as_array();
        let classes = classes.expect("the truth holds source, ego motion and objects");
        let names: Vec<_> = classes.iter().map(|class| class["class"].clone()).collect();
        assert_eq!(names, ["BACKGROUND", "OBJECT"]);
    }

    let table = fnsf(
        folder,
        &["eval", "a.npz", "b.feather", "--truth", first, second],
    );
    let rows: Vec<&str> = table.stdout.lines().collect();
    assert_eq!(rows.len(), 9, "{}", table.stdout);
    assert!(rows[0].contains("calibration") && rows[3].starts_with("all "));
    let columns = |row: &str| row.split_whitespace().count();
    let heading = "class static (m) moving 0.04-0.2 0.2-0.52 0.52-1 1-2 2-";
    assert_eq!(
        rows[5].split_whitespace().collect::<Vec<_>>().join(" "),
        heading
    );
    assert!(rows[4].contains("bucket-normalized") && rows[8].trim().starts_with("mean"));
    assert_eq!([rows[6], rows[7], rows[8]].map(columns), [8, 8, 3]);
}

#[test]
fn flows_without_a_truth_each_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let arguments = ["eval", "a.npz", "b.npz", "--truth", "pair.npz"];
    let ended = fnsf(folder.path(), &arguments);
    assert_eq!(ended.code, 2);
    assert!(
        ended.stderr.contains("2 flows but 1 after --truth"),
        "{}",
        ended.stderr
    );
}
