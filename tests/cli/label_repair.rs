//! Tests of runs of `fnsf label` that go wrong and are repaired.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};

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

/// A street, and the runs that label it with tracks.
struct Street {
    folder: tempfile::TempDir,
}

impl Street {
    fn of(sweeps: &str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        drives(folder.path(), 1, sweeps);
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Labels the street, or what `more` says.
    fn run(&self, output: &str, more: &[&str]) -> Ended {
        let run = ["drives", "-o", output, "--tracks", "--preset", "default"];
        label(self.folder.path(), &[&run[..], more].concat())
    }

    /// Labels the street without fault.
    fn complete(&self, output: &str) {
        let ended = self.run(output, &[]);
        assert_eq!(ended.code, 0, "{}", ended.stderr);
    }

    /// The files of labels and tracks in an output.
    fn labels(&self, output: &str) -> BTreeMap<String, Vec<u8>> {
        labels(&self.path(output))
    }

    /// Cuts a sweep to its half.
    fn damage(&self, sweep: usize) -> Replaced {
        let replaced = self.replace(sweep);
        let half = &replaced.sound[..replaced.sound.len() / 2];
        fs::write(&replaced.path, half).expect("writable");
        replaced
    }

    /// Makes a sweep unreadable for a while: opening a socket fails as a disk does.
    fn fail(&self, sweep: usize) -> Replaced {
        let replaced = self.replace(sweep);
        let _stays_in_its_place = UnixListener::bind(&replaced.path).expect("a socket");
        replaced
    }

    fn replace(&self, sweep: usize) -> Replaced {
        let path = self.path(&format!("drives/d0/sweep_{sweep:04}.pcd"));
        let sound = fs::read(&path).expect("written");
        fs::remove_file(&path).expect("there");
        Replaced { path, sound }
    }
}

/// A sweep that cannot be used until it is mended.
struct Replaced {
    path: PathBuf,
    sound: Vec<u8>,
}

impl Replaced {
    fn mend(self) {
        fs::remove_file(&self.path).expect("there");
        fs::write(&self.path, &self.sound).expect("writable");
    }
}

#[test]
fn a_mended_sweep_gives_the_tracks_and_the_flows_of_a_drive_without_fault() {
    let street = Street::of("8");
    street.complete("reference");
    let sweep = street.damage(3);
    let refused = street.run("labels", &[]);
    assert_eq!(refused.code, 65, "{}", refused.stderr);
    let [reference, damaged] = ["reference", "labels"].map(|name| street.labels(name));
    assert_eq!(damaged.len(), 7 + 1 - 2);
    assert!(damaged["d0/tracks.json"] != reference["d0/tracks.json"]);
    sweep.mend();
    street.complete("labels");
    assert_same(&street.labels("labels"), &reference);
}

#[test]
fn a_pair_that_is_refused_though_its_label_is_there_gets_its_tracks_once_it_is_mended() {
    let street = Street::of("8");
    for output in ["reference", "labels"] {
        street.complete(output);
    }
    // A kill before the tracks; then a sweep is damaged.
    fs::remove_file(street.path("labels/d0/tracks.json")).expect("there");
    let sweep = street.damage(3);
    assert_eq!(street.run("labels", &[]).code, 65);
    let [reference, cut] = ["reference", "labels"].map(|name| street.labels(name));
    assert!(cut["d0/tracks.json"] != reference["d0/tracks.json"]);
    sweep.mend();
    street.complete("labels");
    assert_same(&street.labels("labels"), &reference);
}

#[test]
fn a_rerun_while_a_sweep_is_damaged_leaves_labels_and_tracks_alone() {
    let street = Street::of("8");
    // The windows of `label` have more sweeps than two: more labels lack the damaged one.
    let run = |output: &str| label(street.folder.path(), &["drives", "-o", output, "--tracks"]);
    assert_eq!(run("reference").code, 0);
    let sweep = street.damage(3);
    assert_eq!(run("labels").code, 65);
    let modified = || {
        let about = fs::metadata(street.path("labels/d0/sweep_0000.npz")).expect("a label");
        about.modified().expect("a time")
    };
    let (before, written) = (street.labels("labels"), modified());
    assert_eq!(run("labels").code, 65);
    assert_same(&street.labels("labels"), &before);
    assert_eq!(modified(), written);
    sweep.mend();
    let mended = run("labels");
    assert_eq!(mended.code, 0, "{}", mended.stderr);
    let reference = street.labels("reference");
    assert!(before["d0/sweep_0000.npz"] != reference["d0/sweep_0000.npz"]);
    assert_same(&street.labels("labels"), &reference);
}

#[test]
fn a_repair_that_is_interrupted_is_done_by_the_next_run() {
    let street = Street::of("8");
    street.complete("reference");
    let sweep = street.damage(2);
    assert_eq!(street.run("labels", &[]).code, 65);
    // The sweep is mended, and the store fails in the middle of the repair.
    sweep.mend();
    let away = street.fail(6);
    let failed = street.run("labels", &[]);
    assert_eq!(failed.code, 75, "{}", failed.stderr);
    let end = street.run("labels", &["--finalize"]);
    assert_eq!(end.code, 75, "a pair is missing");
    away.mend();
    street.complete("labels");
    assert_same(&street.labels("labels"), &street.labels("reference"));
    assert_eq!(street.run("labels", &["--finalize"]).code, 0);

    // A label that is deleted, and whose sweep is then damaged, is refused and not missing.
    fs::remove_file(street.path("labels/d0/sweep_0006.npz")).expect("there");
    fs::remove_file(street.path("labels/d0/tracks.json")).expect("there");
    let _stays_damaged = street.damage(7);
    assert_eq!(street.run("labels", &[]).code, 65);
    let end = street.run("labels", &["--finalize"]);
    assert_eq!(end.code, 0, "{}", end.stderr);
    assert!(end.stdout.contains("refused"), "{}", end.stdout);
}

#[test]
fn flows_without_the_tracks_of_their_drive_are_missing_though_they_were_refused_once() {
    let street = Street::of("3");
    street.complete("reference");
    let sweep = street.damage(1);
    assert_eq!(street.run("labels", &[]).code, 65);
    let end = street.run("labels", &["--finalize"]);
    assert_eq!(end.code, 0, "both are refused");
    // What a repair leaves that is killed before it writes the tracks.
    sweep.mend();
    fs::remove_file(street.path("labels/d0/tracks.json")).expect("there");
    for name in ["d0/sweep_0000.npz", "d0/sweep_0001.npz"] {
        let [from, to] = ["reference", "labels"].map(|output| street.path(output).join(name));
        fs::copy(from, to).expect("copied");
    }
    let end = street.run("labels", &["--finalize"]);
    assert_eq!(end.code, 75, "both are missing");
    street.complete("labels");
    assert_same(&street.labels("labels"), &street.labels("reference"));
}

#[test]
fn a_store_that_fails_for_a_while_changes_no_tracks_and_no_flows() {
    let street = Street::of("8");
    street.complete("reference");
    let sweep = street.fail(4);
    let failed = street.run("labels", &[]);
    assert_eq!(failed.code, 75, "{}", failed.stderr);
    let names: Vec<String> = street.labels("labels").into_keys().collect();
    assert_eq!(
        names,
        [0, 1, 2].map(|sweep| format!("d0/sweep_{sweep:04}.npz"))
    );
    sweep.mend();
    street.complete("labels");
    assert_same(&street.labels("labels"), &street.labels("reference"));
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
