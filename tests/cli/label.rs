//! Tests of bulk labelling: many processes, kills, signals, rows that cannot be used, object stores.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fnsf::formats::{read_flow, read_tracks};

use super::object_server::ObjectServer;
use super::program::{Ended, fnsf};

/// Simulates `drives` drives of `sweeps` sweeps each in `folder/drives`.
pub(crate) fn drives(folder: &Path, drives: usize, sweeps: &str) {
    for drive in 0..drives {
        let (out, seed) = (format!("drives/d{drive}"), drive.to_string());
        let size = ["--beams", "16", "--sweeps", sweeps, "--seed", &seed];
        let made = fnsf(folder, &[&["synth", "-o", &out], &size[..]].concat());
        assert_eq!(made.code, 0, "{}", made.stderr);
    }
}

pub(crate) fn label(folder: &Path, arguments: &[&str]) -> Ended {
    fnsf(folder, &[&["label"], arguments].concat())
}

/// Every file below a folder, by its relative path.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("a folder") {
            let path: PathBuf = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.strip_prefix(root).expect("below").to_string_lossy();
            // A write in progress has another name a moment later.
            if let Ok(bytes) = fs::read(&path) {
                found.insert(name.into_owned(), bytes);
            }
        }
    }
    found
}

/// The labels among them: not the files of the run itself, and not a write that a kill has cut off,
/// such as `0007.npz#1`.
pub(crate) fn labels(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = files(root);
    found.retain(|name, _| !name.starts_with('_') && name != "run.json" && !name.contains('#'));
    found
}

/// Compares labels without printing megabytes.
pub(crate) fn assert_same(one: &BTreeMap<String, Vec<u8>>, other: &BTreeMap<String, Vec<u8>>) {
    assert!(
        one.keys().eq(other.keys()),
        "{:?} {:?}",
        one.keys(),
        other.keys()
    );
    for (name, bytes) in one {
        assert!(*bytes == other[name], "{name} differs");
    }
}

fn start(folder: &Path, arguments: &[&str], variables: &[(&str, String)]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .arg("label")
        .args(arguments)
        .current_dir(folder)
        .envs(variables.iter().map(|(name, value)| (name, value)))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts")
}

/// Waits until a folder has so many labels.
fn await_labels(root: &Path, count: usize) {
    let began = Instant::now();
    while !root.exists() || labels(root).len() < count {
        assert!(began.elapsed() < Duration::from_secs(60), "no labels come");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn signal(child: &Child, name: &str) {
    let id = child.id().to_string();
    let sent = Command::new("kill").args([name, &id]).status();
    assert!(sent.expect("kill starts").success());
}

#[test]
fn labels_have_the_bits_of_a_sequence_whatever_the_shards() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 2, "5");
    let whole = label(folder, &["drives", "-o", "whole"]);
    assert_eq!(whole.code, 0, "{}", whole.stderr);
    assert!(whole.stdout.contains("8 of 8 pairs"), "{}", whole.stdout);
    for shard in ["0/4", "1/4", "2/4", "3/4"] {
        let done = label(folder, &["drives", "-o", "parts", "--shard", shard]);
        assert_eq!(done.code, 0, "{}", done.stderr);
    }
    let found = labels(&folder.join("whole"));
    assert_eq!(found.len(), 8);
    assert_same(&found, &labels(&folder.join("parts")));
    for drive in 0..2 {
        let sweeps: Vec<String> = (0..5)
            .map(|sweep| format!("drives/d{drive}/sweep_{sweep:04}.pcd"))
            .collect();
        let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
        let options = ["--preset", "label", "-o", "flow.npz"];
        let done = fnsf(folder, &[&["flow"], &sweeps[..], &options].concat());
        assert_eq!(done.code, 0, "{}", done.stderr);
        for pair in 0..4 {
            let theirs = fs::read(folder.join(format!("flow_{pair:04}.npz"))).expect("written");
            assert!(
                found[&format!("d{drive}/sweep_{pair:04}.npz")] == theirs,
                "{pair}"
            );
        }
    }
    let again = label(folder, &["drives", "-o", "parts"]);
    assert!(
        again.stdout.contains("8 were there before"),
        "{}",
        again.stdout
    );
    // An output below the input is no drive.
    for _ in 0..2 {
        let inside = label(
            folder,
            &["drives", "-o", "drives/out", "--layout", "feather"],
        );
        assert!(inside.stdout.contains("of 8 pairs"), "{}", inside.stdout);
    }
    let end = label(folder, &["drives", "-o", "parts", "--finalize"]);
    assert_eq!(end.code, 0, "{}", end.stderr);
    let success = fs::read_to_string(folder.join("parts/_SUCCESS")).expect("written");
    assert_eq!(success, "8 labelled, 0 refused\n");
    let report = fs::read_to_string(folder.join("parts/_report.csv")).expect("written");
    assert_eq!(
        report
            .lines()
            .filter(|line| line.contains(",labelled,"))
            .count(),
        8
    );
}

#[test]
fn killed_processes_on_the_same_rows_leave_every_label_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 2, "7");
    let reference = label(folder, &["drives", "-o", "reference"]);
    assert_eq!(reference.code, 0, "{}", reference.stderr);
    let output = folder.join("labels");
    let arguments = ["drives", "-o", "labels"];
    let mut killed = start(folder, &arguments, &[]);
    let mut beside = start(folder, &arguments, &[]);
    await_labels(&output, 4);
    killed.kill().expect("it runs");
    killed.wait().expect("it has ended");
    let mut again = start(folder, &arguments, &[]);
    assert!(again.wait().expect("it ends").success());
    assert!(beside.wait().expect("it ends").success());
    assert_same(&labels(&output), &labels(&folder.join("reference")));
    // The remains of a write that was cut off are removed at the end.
    let remains = output.join("d0/0007.npz#1");
    fs::write(&remains, "half").expect("writable");
    let aged = Command::new("touch")
        .args(["-d", "2 hours ago"])
        .arg(&remains)
        .status();
    assert!(aged.expect("touch starts").success());
    let end = label(folder, &["drives", "-o", "labels", "--finalize"]);
    assert_eq!(end.code, 0, "{}", end.stderr);
    assert!(!remains.exists());
}

#[test]
fn a_signal_finishes_the_pair_and_the_next_process_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 2, "8");
    for name in ["-TERM", "-INT"] {
        let out = format!("labels{name}");
        let mut stopped = start(folder, &["drives", "-o", &out], &[]);
        await_labels(&folder.join(&out), 2);
        signal(&stopped, name);
        let code = stopped.wait().expect("it ends").code();
        let found = labels(&folder.join(&out));
        assert_eq!(code, Some(75), "{} labels", found.len());
        for (name, bytes) in &found {
            read_flow(bytes, Some(name)).expect("a whole flow");
        }
        let missing = label(
            folder,
            &["drives", "-o", &out, "--finalize", "--shards", "2"],
        );
        assert_eq!(missing.code, 75, "{}", missing.stderr);
        assert!(
            missing.stderr.contains("in the shards"),
            "{}",
            missing.stderr
        );
        assert!(!folder.join(&out).join("_SUCCESS").exists());
        let rest = label(folder, &["drives", "-o", &out]);
        assert_eq!(rest.code, 0, "{}", rest.stderr);
        assert_eq!(labels(&folder.join(&out)).len(), 14);
    }
}

#[test]
fn rows_that_cannot_be_used_are_reported_and_do_not_stop_the_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "8");
    let cut = folder.join("drives/d0/sweep_0003.pcd");
    let bytes = fs::read(&cut).expect("written");
    fs::write(&cut, &bytes[..bytes.len() / 2]).expect("writable");
    let done = label(folder, &["drives", "-o", "labels", "--json"]);
    assert_eq!(done.code, 65, "{}", done.stderr);
    let said: serde_json::Value = serde_json::from_str(&done.stdout).expect("JSON");
    assert_eq!(
        (&said["labelled"], &said["refused"]),
        (&5.into(), &2.into())
    );
    let trouble = said["troubles"][0]["error"].as_str().expect("a reason");
    assert!(trouble.contains("sweep_0003.pcd"), "{trouble}");
    let report = files(&folder.join("labels"));
    let lines = report.iter().find(|(name, _)| name.starts_with("_report/"));
    let lines = String::from_utf8_lossy(lines.expect("a report").1).into_owned();
    assert!(lines.contains("left_out"), "{lines}");
    let end = label(folder, &["drives", "-o", "labels", "--finalize"]);
    assert_eq!(end.code, 0, "{}", end.stderr);
    assert!(
        end.stdout.contains("5 labelled, 2 refused, 0 missing"),
        "{}",
        end.stdout
    );
    // All other windows have the damaged sweep.
    let lacking = "5 lack a sweep";
    assert!(end.stdout.contains(lacking), "{}", end.stdout);
    // The file is mended: all labels are those of a run that has never seen it damaged.
    fs::write(&cut, &bytes).expect("writable");
    for output in ["labels", "whole"] {
        let done = label(folder, &["drives", "-o", output]);
        assert_eq!(done.code, 0, "{}", done.stderr);
    }
    let found = labels(&folder.join("labels"));
    assert_eq!(found.len(), 7);
    assert_same(&found, &labels(&folder.join("whole")));
    let end = label(folder, &["drives", "-o", "labels", "--finalize"]);
    assert!(!end.stdout.contains("lack a sweep"), "{}", end.stdout);
    let again = label(folder, &["drives", "-o", "labels"]);
    assert!(again.stdout.contains("0 of 7 pairs"), "{}", again.stdout);
}

#[test]
fn a_manifest_names_sweeps_or_pairs() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 2, "4");
    let mut sweeps = "drive,sweep,time_s,note\n".to_owned();
    for (drive, of) in [("night/7", 0), ("night/8", 1)] {
        for sweep in 0..4 {
            let time = 0.2 * f64::from(sweep);
            sweeps += &format!("{drive},drives/d{of}/sweep_{sweep:04}.pcd,{time},x\n");
        }
    }
    fs::write(folder.join("sweeps.csv"), sweeps).expect("writable");
    let done = label(
        folder,
        &["sweeps.csv", "-o", "by_sweeps", "--preset", "default"],
    );
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert_eq!(labels(&folder.join("by_sweeps")).len(), 6);
    let path = folder.display();
    let pairs = format!(
        "id,source,target\none,{path}/drives/d0/sweep_0000.pcd,file://{path}/drives/d0/sweep_0001.pcd\n\
         two,{path}/drives/d1/sweep_0000.pcd,{path}/none.pcd\n"
    );
    fs::write(folder.join("pairs.csv"), pairs).expect("writable");
    let done = label(
        folder,
        &["pairs.csv", "-o", "by_pairs", "--layout", "feather"],
    );
    assert_eq!(done.code, 65, "{}", done.stderr);
    assert!(
        done.stdout.contains("none.pcd is not there"),
        "{}",
        done.stdout
    );
    let found = labels(&folder.join("by_pairs"));
    assert_eq!(found.keys().collect::<Vec<_>>(), ["one.feather"]);
    for (manifest, said) in [
        ("a,b\n1,2\n", "drive and sweep are needed"),
        (
            "sweep\nx/0.pcd\ny/0.pcd\nz/0.pcd\n",
            "would both be written as 0",
        ),
        ("sweep\n0.pcd\n", "there is no pair"),
    ] {
        fs::write(folder.join("wrong.csv"), manifest).expect("writable");
        let refused = label(folder, &["wrong.csv", "-o", "none"]);
        assert_eq!(refused.code, 65, "{}", refused.stderr);
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }
}

#[test]
fn an_output_belongs_to_one_run() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    assert_eq!(label(folder, &["drives", "-o", "labels"]).code, 0);
    for (other, said) in [
        (&["--seed", "1"][..], "another options"),
        (&["--layout", "feather"], "another layout"),
        (&["--tracks"], "another tracks"),
    ] {
        let arguments = [&["drives", "-o", "labels"], other].concat();
        let refused = label(folder, &arguments);
        assert_eq!(refused.code, 2, "{}", refused.stderr);
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }
    for (wrong, said) in [
        (&["--known-poses"][..], "has no pose"),
        (&["--layout", "av2-v1"], "belong together"),
        (&["--tracks", "--preset", "paper"], "tracks need clusters"),
        (
            &["--tracks", "--layout", "av2-v2"],
            "tracks need every pair",
        ),
        (&["--ego", "x.txt"], "x.txt"),
        (&["--shard", "4/4"], "no shard"),
        (&["--shards", "4"], "goes with --shard-from-env"),
        (&["--shard-from-env"], "names no shard"),
    ] {
        let refused = label(folder, &[&["drives", "-o", "others"], wrong].concat());
        assert_ne!(refused.code, 0);
        assert!(
            refused.stderr.contains(said),
            "{wrong:?}: {}",
            refused.stderr
        );
    }
    let none = label(folder, &["drives", "-o", "drives", "--finalize"]);
    assert!(none.stderr.contains("holds no run"), "{}", none.stderr);
}

#[test]
fn tracks_of_whole_drives_are_those_of_a_sequence() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 2, "5");
    let arguments = ["drives", "-o", "labels", "--tracks", "--dt", "0.1"];
    let mut cut_off = start(folder, &arguments, &[]);
    await_labels(&folder.join("labels"), 2);
    cut_off.kill().expect("it runs");
    cut_off.wait().expect("it has ended");
    let done = label(folder, &arguments);
    assert_eq!(done.code, 0, "{}", done.stderr);
    let sweeps: Vec<String> = (0..5)
        .map(|sweep| format!("drives/d1/sweep_{sweep:04}.pcd"))
        .collect();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let options = [
        "--preset",
        "label",
        "--dt",
        "0.1",
        "-o",
        "flow.npz",
        "--tracks",
        "tracks.json",
    ];
    let flow = fnsf(folder, &[&["flow"], &sweeps[..], &options].concat());
    assert_eq!(flow.code, 0, "{}", flow.stderr);
    let found = labels(&folder.join("labels"));
    assert_eq!(found.len(), 2 * 5);
    let tracks = fs::read(folder.join("tracks.json")).expect("written");
    assert!(found["d1/tracks.json"] == tracks);
    assert!(!read_tracks(&tracks).expect("tracks").is_empty());
    for pair in 0..4 {
        let theirs = fs::read(folder.join(format!("flow_{pair:04}.npz"))).expect("written");
        assert!(
            found[&format!("d1/sweep_{pair:04}.npz")] == theirs,
            "{pair}"
        );
    }
}

#[test]
fn sixteen_racing_processes_label_a_bucket_once() {
    let Some(store) = ObjectServer::start() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "4");
    let reference = label(
        folder,
        &["drives", "-o", "reference", "--preset", "default"],
    );
    assert_eq!(reference.code, 0, "{}", reference.stderr);
    let arguments = [
        "drives",
        "-o",
        "s3://farm/flow/run 7",
        "--threads",
        "1",
        "--preset",
        "default",
        "--json",
    ];
    let variables = store.variables();
    let mut racing: Vec<Child> = (0..16)
        .map(|_| {
            Command::new(env!("CARGO_BIN_EXE_fnsf"))
                .arg("label")
                .args(arguments)
                .current_dir(folder)
                .envs(variables.iter().map(|(name, value)| (name, value)))
                .stdout(Stdio::piped())
                .spawn()
                .expect("the program starts")
        })
        .collect();
    racing[0].kill().expect("it runs");
    let mut labelled = 0;
    for (index, child) in racing.into_iter().enumerate() {
        let ended = child.wait_with_output().expect("it ends");
        if index > 0 {
            assert!(ended.status.success());
            let said: serde_json::Value = serde_json::from_slice(&ended.stdout).expect("JSON");
            labelled += said["labelled"].as_u64().expect("a number");
        }
    }
    assert!((1..=3).contains(&labelled), "{labelled}");
    let end = start(
        folder,
        &["drives", "-o", "s3://farm/flow/run 7", "--finalize"],
        &variables,
    );
    let end = end.wait_with_output().expect("it ends");
    assert!(end.status.success());
    for (name, bytes) in labels(&folder.join("reference")) {
        assert!(
            store.get(&format!("flow/run%207/{name}")) == bytes,
            "{name}"
        );
    }
}

#[test]
fn sweeps_are_read_from_a_bucket() {
    let Some(store) = ObjectServer::start() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 2, "3");
    assert_eq!(label(folder, &["drives", "-o", "reference"]).code, 0);
    for (name, bytes) in files(&folder.join("drives")) {
        if name.ends_with(".pcd") {
            store.put(&format!("lake/{name}"), &bytes);
        }
    }
    let variables = store.variables();
    let manifest = "drive,sweep\nx,s3://farm/lake/d1/sweep_0000.pcd\nx,s3://farm/lake/d1/sweep_0001.pcd\n\
        x,s3://farm/lake/d1/none.pcd\n";
    fs::write(folder.join("bucket.csv"), manifest).expect("writable");
    let mut whole = start(folder, &["s3://farm/lake", "-o", "labels"], &variables);
    assert_eq!(whole.wait().expect("it ends").code(), Some(0));
    assert_same(
        &labels(&folder.join("labels")),
        &labels(&folder.join("reference")),
    );
    let mut listed = start(folder, &["bucket.csv", "-o", "listed"], &variables);
    assert_eq!(listed.wait().expect("it ends").code(), Some(65));
    assert_eq!(labels(&folder.join("listed")).len(), 1);
}
