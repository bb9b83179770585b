//! Tests of runs of `fnsf label` that go wrong and are repaired.

use std::fs;
use std::os::unix::net::UnixListener;
use std::path::Path;

use super::label::{assert_same, drives, label, labels};
use super::program::Ended;

/// A manifest of the sweeps of `drives/d0`, as `folder/drives.csv`.
fn manifest(folder: &Path, name: &str, sweeps: usize, apart_s: f64) {
    let rows = (0..sweeps).map(|sweep| {
        let time_s = apart_s * sweep as f64;
        format!("d0,drives/d0/sweep_{sweep:04}.pcd,{time_s}\n")
    });
    let text = format!("drive,sweep,time_s\n{}", rows.collect::<String>());
    fs::write(folder.join(name), text).expect("writable");
}

/// Labels the drives with tracks.
fn tracked(folder: &Path, output: &str, more: &[&str]) -> Ended {
    let run = ["drives", "-o", output, "--tracks", "--preset", "default"];
    label(folder, &[&run[..], more].concat())
}

#[test]
fn a_mended_sweep_gives_the_tracks_and_the_flows_of_a_drive_without_fault() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "8");
    let run = |output: &str| tracked(folder, output, &[]);
    assert_eq!(run("reference").code, 0);
    let sweep = folder.join("drives/d0/sweep_0003.pcd");
    let bytes = fs::read(&sweep).expect("written");
    fs::write(&sweep, &bytes[..bytes.len() / 2]).expect("writable");
    let refused = run("labels");
    assert_eq!(refused.code, 65, "{}", refused.stderr);
    let [reference, damaged] = ["reference", "labels"].map(|name| labels(&folder.join(name)));
    assert_eq!(damaged.len(), 7 + 1 - 2);
    assert!(damaged["d0/tracks.json"] != reference["d0/tracks.json"]);
    fs::write(&sweep, &bytes).expect("writable");
    let mended = run("labels");
    assert_eq!(mended.code, 0, "{}", mended.stderr);
    assert_same(&labels(&folder.join("labels")), &reference);
}

#[test]
fn a_pair_that_is_refused_though_its_label_is_there_gets_its_tracks_once_it_is_mended() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "8");
    let run = |output: &str| tracked(folder, output, &[]);
    for output in ["reference", "labels"] {
        assert_eq!(run(output).code, 0);
    }
    // A kill before the tracks; then a sweep is damaged.
    fs::remove_file(folder.join("labels/d0/tracks.json")).expect("there");
    let sweep = folder.join("drives/d0/sweep_0003.pcd");
    let bytes = fs::read(&sweep).expect("written");
    fs::write(&sweep, &bytes[..bytes.len() / 2]).expect("writable");
    assert_eq!(run("labels").code, 65);
    let [reference, cut] = ["reference", "labels"].map(|name| labels(&folder.join(name)));
    assert!(cut["d0/tracks.json"] != reference["d0/tracks.json"]);
    fs::write(&sweep, &bytes).expect("writable");
    let mended = run("labels");
    assert_eq!(mended.code, 0, "{}", mended.stderr);
    assert_same(&labels(&folder.join("labels")), &reference);
}

#[test]
fn a_rerun_while_a_sweep_is_damaged_leaves_labels_and_tracks_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "8");
    let run = |output: &str| label(folder, &["drives", "-o", output, "--tracks"]);
    assert_eq!(run("reference").code, 0);
    let sweep = folder.join("drives/d0/sweep_0003.pcd");
    let bytes = fs::read(&sweep).expect("written");
    fs::write(&sweep, &bytes[..bytes.len() / 2]).expect("writable");
    assert_eq!(run("labels").code, 65);
    let modified = || {
        let file = folder.join("labels/d0/sweep_0000.npz");
        let about = fs::metadata(file).expect("a label");
        about.modified().expect("a time")
    };
    let (before, written) = (labels(&folder.join("labels")), modified());
    assert_eq!(run("labels").code, 65);
    assert_same(&labels(&folder.join("labels")), &before);
    assert_eq!(modified(), written);
    fs::write(&sweep, &bytes).expect("writable");
    let mended = run("labels");
    assert_eq!(mended.code, 0, "{}", mended.stderr);
    let reference = labels(&folder.join("reference"));
    assert!(before["d0/sweep_0000.npz"] != reference["d0/sweep_0000.npz"]);
    assert_same(&labels(&folder.join("labels")), &reference);
}

#[test]
fn a_repair_that_is_interrupted_is_done_by_the_next_run() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "8");
    let run = |output: &str, more: &[&str]| tracked(folder, output, more);
    assert_eq!(run("reference", &[]).code, 0);
    let [damaged, away] =
        ["0002", "0006"].map(|sweep| folder.join(format!("drives/d0/sweep_{sweep}.pcd")));
    let [sound, other] = [&damaged, &away].map(|path| fs::read(path).expect("written"));
    fs::write(&damaged, &sound[..sound.len() / 2]).expect("writable");
    assert_eq!(run("labels", &[]).code, 65);
    // The sweep is mended, and the store fails in the middle of the repair.
    fs::write(&damaged, &sound).expect("writable");
    fs::remove_file(&away).expect("there");
    let socket = UnixListener::bind(&away).expect("a socket");
    let failed = run("labels", &[]);
    assert_eq!(failed.code, 75, "{}", failed.stderr);
    assert_eq!(run("labels", &["--finalize"]).code, 75, "a pair is missing");
    drop(socket);
    fs::remove_file(&away).expect("there");
    fs::write(&away, &other).expect("writable");
    let repaired = run("labels", &[]);
    assert_eq!(repaired.code, 0, "{}", repaired.stderr);
    let [reference, found] = ["reference", "labels"].map(|name| labels(&folder.join(name)));
    assert_same(&found, &reference);
    assert_eq!(run("labels", &["--finalize"]).code, 0);

    // A label that is deleted, and whose sweep is then damaged, is refused and not missing.
    fs::remove_file(folder.join("labels/d0/sweep_0006.npz")).expect("there");
    fs::remove_file(folder.join("labels/d0/tracks.json")).expect("there");
    fs::write(folder.join("drives/d0/sweep_0007.pcd"), "no cloud").expect("writable");
    assert_eq!(run("labels", &[]).code, 65);
    let end = run("labels", &["--finalize"]);
    assert_eq!(end.code, 0, "{}", end.stderr);
    assert!(end.stdout.contains("refused"), "{}", end.stdout);
}

#[test]
fn flows_without_the_tracks_of_their_drive_are_missing_though_they_were_refused_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    let run = |output: &str, more: &[&str]| tracked(folder, output, more);
    assert_eq!(run("reference", &[]).code, 0);
    let sweep = folder.join("drives/d0/sweep_0001.pcd");
    let sound = fs::read(&sweep).expect("written");
    fs::write(&sweep, &sound[..sound.len() / 2]).expect("writable");
    assert_eq!(run("labels", &[]).code, 65);
    assert_eq!(run("labels", &["--finalize"]).code, 0, "both are refused");
    // What a repair leaves that is killed before it writes the tracks.
    fs::write(&sweep, &sound).expect("writable");
    fs::remove_file(folder.join("labels/d0/tracks.json")).expect("there");
    for name in ["d0/sweep_0000.npz", "d0/sweep_0001.npz"] {
        let [from, to] = ["reference", "labels"].map(|output| folder.join(output).join(name));
        fs::copy(from, to).expect("copied");
    }
    assert_eq!(run("labels", &["--finalize"]).code, 75, "both are missing");
    assert_eq!(run("labels", &[]).code, 0);
    let [reference, found] = ["reference", "labels"].map(|name| labels(&folder.join(name)));
    assert_same(&found, &reference);
}

#[test]
fn a_store_that_fails_for_a_while_changes_no_tracks_and_no_flows() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "8");
    manifest(folder, "drives.csv", 8, 0.1);
    let tracked = |output: &str| {
        label(
            folder,
            &[
                "drives.csv",
                "-o",
                output,
                "--tracks",
                "--preset",
                "default",
            ],
        )
    };
    assert_eq!(tracked("reference").code, 0);
    let sweep = folder.join("drives/d0/sweep_0004.pcd");
    let bytes = fs::read(&sweep).expect("written");
    fs::remove_file(&sweep).expect("there");
    // Opening a socket fails as a disk does.
    let socket = UnixListener::bind(&sweep).expect("a socket");
    let failed = tracked("labels");
    assert_eq!(failed.code, 75, "{}", failed.stderr);
    let names: Vec<String> = labels(&folder.join("labels")).into_keys().collect();
    assert_eq!(
        names,
        [0, 1, 2].map(|sweep| format!("d0/sweep_{sweep:04}.npz"))
    );
    drop(socket);
    fs::remove_file(&sweep).expect("there");
    fs::write(&sweep, &bytes).expect("writable");
    let again = tracked("labels");
    assert_eq!(again.code, 0, "{}", again.stderr);
    let [reference, found] = ["reference", "labels"].map(|name| labels(&folder.join(name)));
    assert_same(&found, &reference);
}

#[test]
fn the_word_for_success_goes_when_something_is_missing_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    let run = ["drives", "-o", "labels", "--preset", "default"];
    let finalize = [&run[..], &["--finalize"]].concat();
    assert_eq!(label(folder, &run).code, 0);
    assert_eq!(label(folder, &finalize).code, 0);
    let success = folder.join("labels/_SUCCESS");
    assert!(success.exists());
    fs::remove_file(folder.join("labels/d0/sweep_0001.npz")).expect("there");
    let missing = label(folder, &finalize);
    assert_eq!(missing.code, 75, "{}", missing.stderr);
    assert!(!success.exists());
}

#[test]
fn a_drive_without_a_name_has_the_challenge_s_outputs_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "7");
    let run = [
        "drives/d0",
        "-o",
        "labels",
        "--layout",
        "av2-v2",
        "--preset",
        "default",
    ];
    assert_eq!(label(folder, &run).code, 0);
    let again = label(folder, &run);
    assert!(
        again.stdout.contains("2 were there before"),
        "{}",
        again.stdout
    );
    let end = label(folder, &[&run[..], &["--finalize"]].concat());
    assert_eq!(end.code, 0, "{}", end.stderr);
}

#[test]
fn layouts_that_need_the_ego_motion_are_refused_without_it() {
    let folder = tempfile::tempdir().expect("a folder");
    for layout in ["av2-v2", "av2-v3", "semantickitti"] {
        for without in [["--ego", "off"], ["--preset", "paper"]] {
            let run = ["drives", "-o", "labels", "--layout", layout];
            let refused = label(folder.path(), &[&run[..], &without].concat());
            assert_eq!(refused.code, 2, "{layout} {without:?}");
            let said = "needs the ego motion";
            assert!(refused.stderr.contains(said), "{}", refused.stderr);
        }
    }
}

#[test]
fn a_run_has_one_set_of_times() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    manifest(folder, "drives.csv", 3, 0.1);
    let run = ["drives.csv", "-o", "labels", "--preset", "default"];
    assert_eq!(label(folder, &run).code, 0);
    assert_eq!(label(folder, &run).code, 0);
    manifest(folder, "drives.csv", 3, 0.05);
    let other = label(folder, &run);
    assert_eq!(other.code, 2);
    assert!(other.stderr.contains("another plan"), "{}", other.stderr);
}

#[test]
fn a_name_that_no_disk_takes_is_refused_once_and_for_all() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    let rows = format!(
        "id,source,target\n{},drives/d0/sweep_0000.pcd,drives/d0/sweep_0001.pcd\n\
         short,drives/d0/sweep_0001.pcd,drives/d0/sweep_0002.pcd\n",
        "x".repeat(300)
    );
    fs::write(folder.join("pairs.csv"), rows).expect("writable");
    let run = ["pairs.csv", "-o", "labels", "--preset", "default"];
    let refused = label(folder, &run);
    assert_eq!(refused.code, 65, "{}", refused.stderr);
    let end = label(folder, &[&run[..], &["--finalize"]].concat());
    assert_eq!(end.code, 0, "{}", end.stderr);
    assert!(
        end.stdout.contains("1 labelled, 1 refused, 0 missing"),
        "{}",
        end.stdout
    );
}
