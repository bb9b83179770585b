//! Tests of `fnsf flow --follow`: sweeps that are written while the program runs.

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use super::program::{fnsf, street};

/// Longest time to wait for a flow.
const PATIENCE: Duration = Duration::from_secs(120);

fn follow(folder: &Path, options: &[&str]) -> Child {
    let arguments = [
        "flow",
        "--follow",
        "incoming",
        "-o",
        "flows/flow.npz",
        "--json",
    ];
    Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .current_dir(folder)
        .args(arguments)
        .args(["--device", "cpu", "--idle-s", "5"])
        .args(options)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts")
}

/// A folder with a street of `sweeps` sweeps, an empty folder `incoming` and a folder `flows`.
fn prepared(sweeps: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    street(folder.path(), sweeps);
    for name in ["incoming", "flows"] {
        std::fs::create_dir(folder.path().join(name)).expect("a folder");
    }
    folder
}

fn sweep(folder: &Path, number: usize) -> Vec<u8> {
    std::fs::read(folder.join(format!("street/sweep_{number:04}.pcd"))).expect("written")
}

fn await_file(path: &Path) {
    let began = Instant::now();
    while !path.exists() {
        assert!(
            began.elapsed() < PATIENCE,
            "{} does not come",
            path.display()
        );
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn ended(child: Child) -> (Output, Vec<serde_json::Value>, String) {
    let output = child.wait_with_output().expect("it ends");
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    let stdout = String::from_utf8_lossy(&output.stdout);
    let reports = stdout
        .lines()
        .map(|line| serde_json::from_str(line).expect("JSON"));
    let reports = reports.collect();
    (output, reports, stderr)
}

#[test]
fn sweeps_get_the_flows_of_the_sequence_however_they_come_into_the_folder() {
    let folder = prepared("5");
    let folder = folder.path();
    let sweeps: Vec<String> = (0..5).map(|k| format!("street/sweep_{k:04}.pcd")).collect();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let options = ["--device", "cpu", "-o", "expected.npz"];
    let done = fnsf(folder, &[&["flow"], &sweeps[..], &options].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);

    // Two are there before, one of them written last; one is written in place, one is moved in
    // under its name, and one is copied under a name of unfinished files first.
    let incoming = folder.join("incoming");
    let put = |name: &str, number| std::fs::write(incoming.join(name), sweep(folder, number));
    put("sweep_0001.pcd", 1).expect("written");
    put("sweep_0000.pcd", 0).expect("written");
    put(".hidden.pcd", 3).expect("written");
    let child = follow(folder, &[]);
    await_file(&folder.join("flows/flow_0000.npz"));
    put("sweep_0002.pcd", 2).expect("written");
    await_file(&folder.join("flows/flow_0001.npz"));
    std::fs::write(folder.join("aside.pcd"), sweep(folder, 3)).expect("written");
    std::fs::rename(folder.join("aside.pcd"), incoming.join("sweep_0003.pcd")).expect("moved");
    put("sweep_0004.pcd.part", 4).expect("written");
    await_file(&folder.join("flows/flow_0002.npz"));
    let [part, whole] = ["sweep_0004.pcd.part", "sweep_0004.pcd"].map(|name| incoming.join(name));
    std::fs::rename(part, whole).expect("moved");
    let (output, reports, stderr) = ended(child);
    assert!(output.status.success(), "{stderr}");
    assert!(
        stderr.contains("4 flows, each after its sweep by"),
        "{stderr}"
    );
    assert_eq!(reports.len(), 4);
    for (pair, report) in reports.iter().enumerate() {
        let names = [pair, pair + 1].map(|k| format!("sweep_{k:04}.pcd"));
        assert_eq!(report["sweeps"], serde_json::json!(names));
        assert!(
            report["latency_s"].as_f64().is_some_and(|s| s > 0.0),
            "{report}"
        );
        assert_eq!(report["stop_reason"], "completed");
        let read = |name: String| std::fs::read(folder.join(name)).expect("written");
        let [flow, expected] =
            ["flows/flow", "expected"].map(|name| read(format!("{name}_{pair:04}.npz")));
        assert!(flow == expected, "pair {pair}");
    }
    assert!(!folder.join("flows/flow_0004.npz").exists());
}

#[test]
fn a_damaged_sweep_is_named_and_the_sequence_starts_again_after_it() {
    for preset in ["default", "label"] {
        let folder = prepared("4");
        let folder = folder.path();
        let put = |name: &str, bytes: &[u8]| {
            std::fs::write(folder.join("incoming").join(name), bytes).expect("written");
        };
        put("0.pcd", &sweep(folder, 0));
        put("1.pcd", &sweep(folder, 1));
        put("2.pcd", &sweep(folder, 2)[..5000]);
        put("3.pcd", &sweep(folder, 2));
        put("4.pcd", &sweep(folder, 3));
        let options = ["--dt", "0.1", "--preset", preset];
        let (output, reports, stderr) = ended(follow(folder, &options));
        assert!(output.status.success(), "{stderr}");
        assert!(
            stderr.contains("2.pcd") && stderr.contains("starts again"),
            "{stderr}"
        );
        assert_eq!(names(&reports), [["0.pcd", "1.pcd"], ["3.pcd", "4.pcd"]]);
    }
}

/// The names of the sweeps in reports.
fn names(reports: &[serde_json::Value]) -> Vec<[&str; 2]> {
    let mut names = Vec::new();
    for report in reports {
        names.push([0, 1].map(|index| report["sweeps"][index].as_str().expect("a name")));
    }
    names
}

#[test]
fn a_pair_that_is_refused_costs_no_other_pair() {
    let folder = prepared("2");
    let folder = folder.path();
    for number in 0..2 {
        let name = format!("incoming/{number}.pcd");
        std::fs::write(folder.join(name), sweep(folder, number)).expect("written");
    }
    // Another street.
    let done = fnsf(
        folder,
        &[
            "synth", "-o", "other", "--sweeps", "4", "--beams", "16", "--seed", "77",
        ],
    );
    assert_eq!(done.code, 0, "{}", done.stderr);
    for number in 0..4 {
        let from = folder.join(format!("other/sweep_{number:04}.pcd"));
        let to = folder.join(format!("incoming/{}.pcd", number + 2));
        std::fs::rename(from, to).expect("moved");
    }
    let options = ["--dt", "0.1", "--preset", "label"];
    let (output, reports, stderr) = ended(follow(folder, &options));
    assert!(output.status.success(), "{stderr}");
    assert!(stderr.contains("1.pcd to 2.pcd"), "{stderr}");
    // The target of the refused pair may be the bad one of the two.
    let expected = [["0.pcd", "1.pcd"], ["3.pcd", "4.pcd"], ["4.pcd", "5.pcd"]];
    assert_eq!(names(&reports), expected);
}

#[test]
fn a_sweep_that_is_being_written_at_the_start_is_taken_when_it_is_complete() {
    let folder = prepared("2");
    let folder = folder.path();
    std::fs::write(folder.join("incoming/0.pcd"), sweep(folder, 0)).expect("written");
    let whole = sweep(folder, 1);
    let mut file = std::fs::File::create(folder.join("incoming/1.pcd")).expect("a file");
    let mut pieces = whole.chunks(whole.len().div_ceil(80));
    let mut write = |count: usize| {
        for piece in pieces.by_ref().take(count) {
            std::io::Write::write_all(&mut file, piece).expect("written");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    write(1);
    let child = follow(folder, &[]);
    write(usize::MAX);
    drop(file);
    let (output, reports, stderr) = ended(child);
    assert!(output.status.success(), "{stderr}");
    assert!(!stderr.contains("warning"), "{stderr}");
    assert_eq!(names(&reports), [["0.pcd", "1.pcd"]]);
}

#[test]
fn a_sweep_that_is_closed_several_times_is_taken_once() {
    let folder = prepared("4");
    let folder = folder.path();
    let put = |number: usize| {
        let path = folder.join(format!("incoming/{number}.pcd"));
        std::fs::write(&path, sweep(folder, number)).expect("written");
        for _ in 0..3 {
            let opened = std::fs::OpenOptions::new().append(true).open(&path);
            drop(opened.expect("there"));
        }
    };
    (0..2).for_each(put);
    let child = follow(folder, &["--dt", "0.1"]);
    await_file(&folder.join("flows/flow_0000.npz"));
    (2..4).for_each(put);
    let (output, reports, stderr) = ended(child);
    assert!(output.status.success(), "{stderr}");
    let expected = [["0.pcd", "1.pcd"], ["1.pcd", "2.pcd"], ["2.pcd", "3.pcd"]];
    assert_eq!(names(&reports), expected);
}

#[test]
fn a_flow_that_is_due_before_it_is_found_is_the_best_one_until_then() {
    let folder = prepared("4");
    let folder = folder.path();
    for number in 0..4 {
        let name = format!("incoming/{number}.pcd");
        std::fs::write(folder.join(name), sweep(folder, number)).expect("written");
    }
    let (output, reports, stderr) = ended(follow(folder, &["--due-ms", "1", "--threads", "1"]));
    assert!(output.status.success(), "{stderr}");
    assert_eq!(reports.len(), 3);
    assert!(
        reports
            .iter()
            .all(|report| report["stop_reason"] == "deadline")
    );
    assert_eq!(reports[0]["waiting"], 2);
    // They were there before, so that nothing is late.
    assert!(!stderr.contains("warning"), "{stderr}");
    for pair in 0..3 {
        assert!(folder.join(format!("flows/flow_{pair:04}.npz")).exists());
    }
}

#[test]
fn what_does_not_go_with_a_folder_is_refused() {
    let folder = prepared("2");
    let folder = folder.path();
    let refused = |arguments: &[&str]| {
        let done = fnsf(folder, arguments);
        (done.code, done.stderr)
    };
    let with =
        |more: &[&'static str]| [&["flow", "--follow", "incoming", "-o", "f.npz"], more].concat();
    for (arguments, code, word) in [
        (with(&["--tracks", "t.json"]), 2, "tracks"),
        (with(&["--poses", "poses.txt"]), 2, "--poses"),
        (with(&["street/sweep_0000.pcd"]), 2, "cannot be used with"),
        (
            with(&["--deskew", "on", "--ego", "off"]),
            2,
            "--deskew on needs the ego motion",
        ),
        (
            vec!["flow", "--follow", "incoming", "-o", "incoming/flow.npz"],
            2,
            "the folder that is followed",
        ),
        (with(&["--idle-s", "0"]), 2, "positive"),
        (with(&["--due-ms", "0"]), 2, "--due-ms"),
        (vec!["flow", "--follow", "incoming"], 2, "--output"),
        (
            vec!["flow", "--follow", "nowhere", "-o", "f.npz"],
            65,
            "nowhere",
        ),
        (
            vec![
                "flow",
                "street/sweep_0000.pcd",
                "-o",
                "f.npz",
                "--idle-s",
                "1",
            ],
            2,
            "--follow",
        ),
    ] {
        let (found, stderr) = refused(&arguments);
        assert_eq!(found, code, "{arguments:?}: {stderr}");
        assert!(stderr.contains(word), "{arguments:?}: {stderr}");
    }
}
