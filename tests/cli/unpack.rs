//! Tests of `fnsf unpack`.

use std::path::Path;

use fnsf::formats::{read_pair, read_timed_cloud};

use super::program::fnsf;

const RECORDING: &[u8] = include_bytes!("../formats/recordings/ros2_zstd.mcap");
const SCENE: &[u8] = include_bytes!("../formats/scenes/gzip.h5");

fn names(folder: &Path) -> Vec<String> {
    let files = std::fs::read_dir(folder).expect("a folder");
    let mut names: Vec<String> = files
        .map(|file| {
            file.expect("a file")
                .file_name()
                .to_string_lossy()
                .into_owned()
        })
        .collect();
    names.sort();
    names
}

#[test]
fn the_sweeps_of_a_recording_become_files_with_their_times() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    std::fs::write(folder.join("drive.mcap"), RECORDING).expect("a file");
    let listed = fnsf(folder, &["unpack", "drive.mcap", "--list"]);
    assert_eq!(
        (listed.code, listed.stdout.trim()),
        (0, "/lidar/top: 3 clouds")
    );
    let done = fnsf(folder, &["unpack", "drive.mcap", "-o", "sweeps"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    for words in [
        "3 sweeps, 117 points",
        "3 points without finite",
        "with the times",
    ] {
        assert!(done.stdout.contains(words), "{}", done.stdout);
    }
    let topic = folder.join("sweeps/lidar_top");
    let names = names(&topic);
    assert_eq!(names[1], "1700000000100000000.pcd");
    let sweep = std::fs::read(topic.join(&names[2])).expect("a sweep");
    let sweep = read_timed_cloud(&sweep, None).expect("a sweep");
    assert_eq!(sweep.cloud.points[0], [2.0, -3.0, 1.0]);
    let times = sweep.times.expect("times").offsets_s;
    assert!((times[38] - 0.0975).abs() < 1e-6, "{times:?}");
    let some = [
        "unpack",
        "drive.mcap",
        "-o",
        "some",
        "--skip",
        "1",
        "--limit",
        "1",
    ];
    assert_eq!(fnsf(folder, &some).code, 0);
    assert_eq!(
        self::names(&folder.join("some/lidar_top")),
        [names[1].clone()]
    );
}

#[test]
fn a_recording_that_ends_early_gives_its_sweeps_and_exit_code_65() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let length = RECORDING.len();
    // Without the summary and the last chunk.
    std::fs::write(folder.join("drive.mcap"), &RECORDING[..length * 6 / 10]).expect("a file");
    let done = fnsf(folder, &["unpack", "drive.mcap", "-o", "sweeps"]);
    assert_eq!(done.code, 65, "{}", done.stdout);
    assert!(
        done.stderr.contains("middle of a record"),
        "{}",
        done.stderr
    );
    assert!(!names(&folder.join("sweeps/lidar_top")).is_empty());
}

#[test]
fn a_recording_without_the_topic_or_without_clouds_is_refused_in_words() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    std::fs::write(folder.join("text.mcap"), "no recording").expect("a file");
    std::fs::write(folder.join("drive.mcap"), RECORDING).expect("a file");
    for (arguments, said) in [
        (
            vec!["unpack", "drive.mcap", "-o", "x", "--topic", "/chatter"],
            "--list shows",
        ),
        (
            vec!["unpack", "text.mcap", "-o", "x"],
            "does not begin as a recording",
        ),
        (
            vec!["unpack", "nothing.mcap", "-o", "x"],
            "cannot read nothing.mcap",
        ),
        (
            vec!["flow", "drive.mcap", "drive.mcap", "--json"],
            "fnsf unpack",
        ),
    ] {
        let ended = fnsf(folder, &arguments);
        assert_eq!(ended.code, 65, "{}", ended.stderr);
        assert!(ended.stderr.contains(said), "{}", ended.stderr);
    }
}

#[test]
fn the_sweeps_of_a_scene_become_files_and_pairs_with_their_truth() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    std::fs::write(folder.join("a.scene.h5"), SCENE).expect("a file");
    let listed = fnsf(folder, &["unpack", "a.scene.h5", "--list"]);
    assert_eq!(
        (listed.code, listed.stdout.trim()),
        (0, "a_scene: 2 sweeps")
    );
    let done = fnsf(folder, &["unpack", "a.scene.h5", "-o", "drives"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    for words in [
        "2 sweeps, 212 points",
        "1 pairs with true flow and ground masks",
        "with the times",
    ] {
        assert!(done.stdout.contains(words), "{}", done.stdout);
    }
    let found = names(&folder.join("drives/a_scene"));
    let (first, second) = ("1700000000000000000", "1700000000100000000");
    let expected = [
        format!("{first}.npz"),
        format!("{first}.pcd"),
        format!("{second}.pcd"),
    ];
    assert_eq!(found, expected);
    let pair = std::fs::read(folder.join("drives/a_scene").join(&found[0])).expect("a pair");
    let pair = read_pair(&pair).expect("a pair");
    assert_eq!((pair.source.len(), pair.target.len()), (106, 106));
    assert!(pair.truth.is_some() && pair.ground.is_some() && pair.ego.is_some());
    // One sweep alone has no pair.
    let one = ["unpack", "a.scene.h5", "-o", "one", "--skip", "1"];
    assert_eq!(fnsf(folder, &one).code, 0);
    assert_eq!(
        names(&folder.join("one/a_scene")),
        [format!("{second}.pcd")]
    );
    let topic = ["unpack", "a.scene.h5", "-o", "x", "--topic", "/lidar"];
    let refused = fnsf(folder, &topic);
    assert_eq!(refused.code, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains("recordings"), "{}", refused.stderr);
}

#[test]
fn links_in_the_output_are_not_followed_and_a_pipe_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    std::fs::write(folder.join("scene.h5"), SCENE).expect("a file");
    std::fs::write(folder.join("mine"), "precious").expect("a file");
    let file = folder.join("drives/scene/1700000000000000000.pcd");
    std::fs::create_dir_all(folder.join("drives/scene")).expect("made");
    std::os::unix::fs::symlink(folder.join("mine"), &file).expect("a link");
    let done = fnsf(folder, &["unpack", "scene.h5", "-o", "drives"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    let mine = std::fs::read(folder.join("mine")).expect("there");
    assert_eq!(mine, b"precious");
    assert!(std::fs::symlink_metadata(&file).expect("there").is_file());

    std::fs::create_dir_all(folder.join("elsewhere")).expect("made");
    std::fs::create_dir_all(folder.join("linked")).expect("made");
    let link = folder.join("linked/scene");
    std::os::unix::fs::symlink(folder.join("elsewhere"), link).expect("a link");
    let refused = fnsf(folder, &["unpack", "scene.h5", "-o", "linked"]);
    assert_ne!(refused.code, 0);
    assert!(
        refused.stderr.contains("leads out of linked"),
        "{}",
        refused.stderr
    );
    assert!(names(&folder.join("elsewhere")).is_empty());

    std::fs::write(folder.join("drive.mcap"), RECORDING).expect("a file");
    let program = env!("CARGO_BIN_EXE_fnsf");
    let piped = std::process::Command::new("sh")
        .args([
            "-c",
            "cat drive.mcap | \"$0\" unpack /dev/stdin --list",
            program,
        ])
        .current_dir(folder)
        .output()
        .expect("a shell");
    let listed = String::from_utf8_lossy(&piped.stdout).into_owned();
    assert!(listed.contains("/lidar/top: 3 clouds"), "{listed}");
}
