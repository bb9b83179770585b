//! Tests of bulk labelling with names, links and files that cannot work.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::process::Command;
use std::sync::atomic::AtomicBool;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::Backend;
use fnsf::flow::{Estimate, FlowError, Uncontrolled};
use fnsf::formats::read_cloud;
use fnsf::job::JobOptions;
use fnsf::label::{Inputs, Place, Solver, open_plan, run};

use super::label::{drives, label, labels};

#[test]
fn names_and_files_that_cannot_work_are_refused_and_do_not_hang() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "4");
    let made = Command::new("mkfifo").arg(folder.join("pipe")).status();
    assert!(made.expect("mkfifo").success());
    let sweep = |index: usize| format!("drives/d0/sweep_{index:04}.pcd");
    let mut rows = "source,target,drive,id\n".to_owned();
    // The last says that it is empty, and never ends.
    let strange = [
        "pipe",
        "/dev/zero",
        "drives",
        "drives/d0/sweep_0000.pcd/x",
        "/proc/self/pagemap",
    ];
    for source in strange {
        rows += &format!("{source},{},z,{}\n", sweep(1), rows.lines().count());
    }
    rows += &format!("{},{},z,good\n", sweep(0), sweep(1));
    fs::write(folder.join("strange.csv"), rows).expect("writable");
    let done = label(folder, &["strange.csv", "-o", "strange"]);
    // Nothing of it will ever work: the farm is not told to try again.
    assert_eq!(done.code, 65, "{}", done.stderr);
    assert_eq!(labels(&folder.join("strange")).len(), 1);

    let rows = (0..3).map(|id| format!("{},{},z,{id}\n", sweep(id), sweep(id + 1)));
    let rows = format!("source,target,drive,id\n{}", rows.collect::<String>());
    fs::write(folder.join("pairs.csv"), rows).expect("writable");
    for more in [&["--layout", "av2-v2"][..], &["--tracks"]] {
        let refused = label(folder, &[&["pairs.csv", "-o", "one"], more].concat());
        assert!(
            refused.stderr.contains("would both be written"),
            "{}",
            refused.stderr
        );
    }
    let rows = format!(
        "source,target,drive,id\n{0},{1},a,b\n{0},{1},a/b.npz,c\n",
        sweep(0),
        sweep(1)
    );
    fs::write(folder.join("nested.csv"), rows).expect("writable");
    let refused = label(folder, &["nested.csv", "-o", "nested"]);
    assert!(
        refused.stderr.contains("the folder of that of"),
        "{}",
        refused.stderr
    );
    let uri = format!("file://{}/drives", folder.display());
    for output in ["drives", "drives/", &uri] {
        let refused = label(folder, &["drives", "-o", output]);
        assert_eq!(refused.code, 2, "{output}: {}", refused.stderr);
        let said = "the output is the folder of the sweeps";
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }

    // Links multiply nothing.
    for (to, name) in [
        ("..", "up1"),
        ("..", "up2"),
        (".", "latest"),
        (".", "d0/self"),
        ("nowhere", "d0/gone"),
    ] {
        std::os::unix::fs::symlink(to, folder.join("drives").join(name)).expect("a link");
    }
    // What a file system keeps for itself is no drive.
    fs::create_dir(folder.join("drives/lost+found")).expect("a folder");
    for sweep in 0..2 {
        let name = format!("sweep_{sweep:04}.pcd");
        let (from, to) = (
            folder.join("drives/d0").join(&name),
            folder.join("drives/lost+found").join(name),
        );
        fs::copy(from, to).expect("copied");
    }
    let done = label(folder, &["drives", "-o", "linked"]);
    assert!(
        done.stdout.contains("3 of 3 pairs"),
        "{} {}",
        done.stdout,
        done.stderr
    );
}

#[test]
fn a_pipe_in_the_place_of_poses_does_not_hang_and_matters_only_where_poses_are_asked_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    let log = folder.join("av2/log/sensors/lidar");
    fs::create_dir_all(&log).expect("made");
    for sweep in 0..2 {
        let from = folder.join(format!("drives/d0/sweep_{sweep:04}.pcd"));
        fs::copy(from, log.join(format!("31596626{sweep}359836000.pcd"))).expect("copied");
    }
    let poses = folder.join("av2/log/city_SE3_egovehicle.feather");
    let made = Command::new("mkfifo").arg(&poses).status();
    assert!(made.expect("mkfifo").success());
    let done = label(folder, &["av2", "-o", "labels"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    let refused = label(folder, &["av2", "-o", "posed", "--known-poses"]);
    assert_eq!(refused.code, 2, "{}", refused.stderr);
    assert!(
        refused.stderr.contains("city_SE3_egovehicle"),
        "{}",
        refused.stderr
    );
}

#[test]
fn the_end_of_a_run_removes_its_own_remains_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "2");
    assert_eq!(label(folder, &["drives", "-o", "labels"]).code, 0);
    fs::create_dir(folder.join("outside")).expect("a folder");
    let users = [
        "labels/#notes.txt#",
        "labels/C#",
        "labels/frame#12",
        "outside/a.npz#3",
    ];
    let remains = "labels/d0/sweep_0000.npz#7";
    for name in users.iter().chain([&remains]) {
        fs::write(folder.join(name), "x").expect("writable");
        let old = Command::new("touch")
            .args(["-d", "3 hours ago", name])
            .current_dir(folder)
            .status();
        assert!(old.expect("touch").success());
    }
    std::os::unix::fs::symlink("../outside", folder.join("labels/link")).expect("a link");
    let done = label(
        folder,
        &[
            "drives",
            "-o",
            "labels",
            "--finalize",
            "--shards",
            "4000000000",
        ],
    );
    assert_eq!(done.code, 0, "{}", done.stderr);
    for name in users {
        assert!(folder.join(name).exists(), "{name}");
    }
    assert!(!folder.join(remains).exists());
}

#[test]
fn a_pair_that_needs_more_memory_than_the_run_may_take_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "2");
    let done = label(
        folder,
        &["drives", "-o", "labels", "--max-memory-mib", "16"],
    );
    assert_eq!(done.code, 65, "{}", done.stderr);
    assert!(done.stdout.contains("allows 16"), "{}", done.stdout);
}

/// A solver that panics at the pair `at`, counted from 1.
struct Panicking {
    at: usize,
    solved: usize,
}

impl Solver for Panicking {
    fn solve(
        &mut self,
        work: &dyn Fn(&dyn Backend) -> Result<Estimate, FlowError>,
    ) -> Result<Estimate, FlowError> {
        self.solved += 1;
        assert_ne!(self.solved, self.at, "a defect");
        work(&CpuBackend::new(Some(1)).expect("a thread"))
    }
}

#[test]
fn times_that_are_not_used_are_told_with_each_label() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    let sweep = folder.join("drives/d0/sweep_0001.pcd");
    let read = fs::read(&sweep).expect("a sweep");
    let points = read_cloud(&read, None).expect("a cloud").points;
    let mut timed = format!(
        "VERSION .7\nFIELDS x y z time\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {0}\nHEIGHT 1\n\
         POINTS {0}\nDATA ascii\n",
        points.len()
    );
    for (row, [x, y, z]) in points.iter().enumerate() {
        let time = if row == 5 {
            f64::NAN
        } else {
            row as f64 * 1e-6
        };
        timed += &format!("{x} {y} {z} {time}\n");
    }
    fs::write(&sweep, timed).expect("written");
    for end in [&["--preset", "default"][..], &["--finalize"]] {
        let done = label(folder, &[&["drives", "-o", "labels"], end].concat());
        assert_eq!(done.code, 0, "{}", done.stderr);
    }
    let table = fs::read_to_string(folder.join("labels/_report.csv")).expect("written");
    let told = "sweep_0001.pcd: its column time is NaN or infinite in row 5";
    assert_eq!(table.matches(told).count(), 2, "{table}");
}

#[test]
fn a_name_that_is_no_text_costs_its_own_pair_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "3");
    for name in [b"notes \xff.txt", b"sweep \xff.pcd"] {
        let name = OsStr::from_bytes(name);
        fs::write(folder.join("drives/d0").join(name), "").expect("written");
    }
    let done = label(folder, &["drives", "-o", "labels"]);
    assert_eq!(done.code, 65, "{}", done.stderr);
    assert!(done.stdout.contains("1 are refused"), "{}", done.stdout);
    assert_eq!(labels(&folder.join("labels")).len(), 2);
}

#[test]
fn a_pair_whose_estimate_panics_is_refused_and_the_others_are_labelled() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drives(folder, 1, "4");
    let place = |name: &str| folder.join(name).to_string_lossy().into_owned();
    fs::create_dir(place("labels")).expect("a folder");
    let plan = open_plan(&place("drives")).expect("a drive");
    let options = JobOptions::default();
    let output = Place::open(&place("labels")).expect("a place");
    let inputs = Inputs::new(&plan, &options, output);
    let mut solver = Panicking { at: 2, solved: 0 };
    let goes_on = AtomicBool::new(false);
    let done = run(&inputs, &mut solver, &Uncontrolled, &goes_on, &mut |_| {});
    let done = done.expect("a run");
    assert_eq!((done.labelled, done.refused, done.failed), (2, 1, 0));
    let said = done.troubles[0].error.as_deref().expect("a reason");
    assert!(said.contains("its estimate has panicked"), "{said}");
}
