//! Tests of hostile input files: one line on stderr, exit code 65 and little memory.
//!
//! Also tested: output files that cannot be written or that are inputs.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use super::process_memory::memory_bytes;
use super::program::fnsf;

/// Maximum memory for a file that is refused, bytes.
const MEMORY: u64 = 100 << 20;

/// An array in numpy's format, from its header and data.
fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend(u16::try_from(header.len()).expect("short").to_le_bytes());
    file.extend(header.as_bytes());
    file.extend(data);
    file
}

fn points(points: &[[f32; 3]]) -> Vec<u8> {
    let data: Vec<u8> = points
        .iter()
        .flatten()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    npy("<f4", &format!("({}, 3)", points.len()), &data)
}

fn corpus() -> Vec<(&'static str, Vec<u8>)> {
    let square: Vec<[f32; 3]> = (0..64)
        .map(|i| [(i % 8) as f32, (i / 8) as f32, 0.0])
        .collect();
    let mut with_nan = square.clone();
    with_nan[5][1] = f32::NAN;
    let mut with_infinity = square.clone();
    with_infinity[7][2] = f32::INFINITY;
    let mut truncated = points(&square);
    truncated.truncate(truncated.len() - 10);
    let ply = |count: &str, body: &str| {
        let header = "property float x\nproperty float y\nproperty float z\nend_header\n";
        format!("ply\nformat ascii 1.0\nelement vertex {count}\n{header}{body}").into_bytes()
    };
    let pcd = |points: &str, data: &str| {
        let fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1";
        format!(
            "# .PCD v0.7\nVERSION 0.7\n{fields}\nWIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA {data}\n"
        )
        .into_bytes()
    };
    vec![
        ("empty", Vec::new()),
        ("garbage", vec![0xA5; 1000]),
        ("text", b"hello, this is no point cloud\n".to_vec()),
        ("truncated.npy", truncated),
        ("huge count.npy", npy("<f4", "(4000000000, 3)", &[0; 24])),
        (
            "overflowing count.npy",
            npy("<f4", "(9223372036854775807, 3)", &[0; 24]),
        ),
        ("objects.npy", npy("|O", "(4, 3)", &[0; 24])),
        ("complex.npy", npy("<c8", "(1, 3)", &[0; 24])),
        ("two columns.npy", npy("<f4", "(3, 2)", &[0; 24])),
        ("nan.npy", points(&with_nan)),
        ("infinity.npy", points(&with_infinity)),
        ("no points.npy", points(&[])),
        ("one point.npy", points(&[[1.0, 2.0, 3.0]])),
        ("two far points.npy", points(&[[0.0; 3], [1e6, 0.0, 0.0]])),
        (
            "three far points.npy",
            points(&[[0.0; 3], [1e6, 0.0, 0.0], [-1e6, 5.0, 5.0]]),
        ),
        ("huge count.ply", ply("4000000000", "0 0 0\n")),
        ("negative count.ply", ply("-5", "0 0 0\n")),
        ("short.ply", ply("3", "0 0 0\n1 1 1\n")),
        ("nan.ply", ply("1", "nan 0 0\n")),
        ("huge count.pcd", pcd("4000000000", "binary")),
        (
            "huge compressed.pcd",
            pcd("4000000000", "binary_compressed"),
        ),
        ("short.pcd", pcd("3", "ascii")),
        ("broken zip.npz", b"PK\x03\x04this is no archive".to_vec()),
        (
            "broken arrow.feather",
            b"ARROW1\0\0garbage that is no table ARROW1".to_vec(),
        ),
    ]
}

/// The arguments of `fnsf flow FILE FILE` with a preset.
fn flow<'a>(file: &'a str, preset: &'a str) -> [&'a str; 9] {
    let [device, out] = ["cpu", "out.npz"];
    [
        "flow", file, file, "--preset", preset, "--device", device, "-o", out,
    ]
}

/// Peak resident memory of a run, bytes, as the system reports it.
fn peak_memory(folder: &Path, arguments: &[&str]) -> Option<u64> {
    let program = fs::canonicalize(env!("CARGO_BIN_EXE_fnsf")).expect("the program is there");
    let mut child = Command::new(&program)
        .args(arguments)
        .current_dir(folder)
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts");
    let running = format!("/proc/{}/exe", child.id());
    let mut peak = None;
    while child.try_wait().expect("the child is ours").is_none() {
        std::thread::yield_now();
        // A child that does not run the program yet shares the memory of this process.
        if fs::read_link(&running).ok().as_ref() != Some(&program) {
            continue;
        }
        peak = peak.max(memory_bytes(child.id(), "VmHWM:"));
    }
    peak
}

#[test]
fn every_hostile_file_gets_one_line_exit_code_65_and_little_memory() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let corpus = corpus();
    let presets = ["neural", "default"].into_iter();
    let mut measured = 0;
    for (preset, (name, bytes)) in presets.flat_map(|p| corpus.iter().map(move |file| (p, file))) {
        fs::write(folder.join(name), bytes).expect("written");
        let arguments = flow(name, preset);
        let ended = fnsf(folder, &arguments);
        if let Some(peak) = peak_memory(folder, &arguments) {
            assert!(peak < MEMORY, "{name}: {peak} bytes");
            measured += 1;
        }
        assert_eq!(ended.code, 65, "{name}: {}", ended.stderr);
        assert_eq!(ended.stderr.lines().count(), 1, "{name}: {}", ended.stderr);
        assert!(
            ended.stderr.starts_with("fnsf: "),
            "{name}: {}",
            ended.stderr
        );
        assert!(ended.stdout.is_empty(), "{name}: {}", ended.stdout);
        assert!(!folder.join("out.npz").exists(), "{name} left a file");
    }
    assert!(
        measured > 0 || !cfg!(target_os = "linux"),
        "no memory was measured"
    );
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let ended = fnsf(folder.path(), &["flow", "nowhere.npz", "-o", "out.npz"]);
    assert_eq!(ended.code, 65);
    assert!(ended.stderr.contains("nowhere.npz"), "{}", ended.stderr);
}

#[test]
fn the_far_points_are_refused_for_their_extent() {
    let folder = tempfile::tempdir().expect("a folder");
    let cloud = points(&[[0.0; 3], [5e5, 0.0, 0.0], [-4e5, 5.0, 5.0], [0.0, 0.0, 5.0]]);
    fs::write(folder.path().join("far.npy"), cloud).expect("written");
    let forced = |preset| {
        let mut arguments = flow("far.npy", preset).to_vec();
        arguments.push("--force");
        fnsf(folder.path(), &arguments)
    };
    let ended = fnsf(folder.path(), &flow("far.npy", "neural"));
    assert_eq!(ended.code, 65);
    assert!(ended.stderr.contains("millimetres"), "{}", ended.stderr);
    let ended = forced("neural");
    assert_eq!(ended.code, 65);
    assert!(ended.stderr.contains("900000"), "{}", ended.stderr);
    assert!(ended.stderr.contains("crop_m"), "{}", ended.stderr);
    // The object search needs no distance transform, and its memory does not depend on the extent.
    let ended = forced("default");
    assert_eq!(ended.code, 0, "{}", ended.stderr);
}

#[test]
fn an_output_that_cannot_be_written_is_an_internal_failure_and_leaves_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let done = fnsf(folder, &["synth", "-o", "street", "--beams", "8"]);
    assert_eq!(done.code, 0);
    let ended = fnsf(
        folder,
        &[
            "flow",
            "street/pair_0000.npz",
            "-o",
            "street/pair_0000.npz/out.npz",
        ],
    );
    assert_eq!(ended.code, 70, "{}", ended.stderr);
    assert_eq!(ended.stderr.lines().count(), 1);
    assert!(
        ended.stderr.contains("cannot be created"),
        "{}",
        ended.stderr
    );
}

#[test]
fn the_missing_folders_of_an_output_are_created() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let done = fnsf(folder, &["synth", "-o", "street", "--beams", "8"]);
    assert_eq!(done.code, 0);
    let output = "new/deep/out.npz";
    let ended = fnsf(folder, &["flow", "street/pair_0000.npz", "-o", output]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(folder.join(output).is_file());
}

/// A folder with three sweeps and their two pairs.
fn street() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let made = fnsf(folder.path(), &["synth", "-o", ".", "--sweeps", "3"]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    folder
}

#[test]
fn an_output_that_is_an_input_is_refused_before_any_work() {
    let folder = street();
    let path = folder.path();
    fs::hard_link(path.join("pair_0000.npz"), path.join("same.npz")).expect("linked");
    fs::copy(path.join("sweep_0001.pcd"), path.join("s_0000.pcd")).expect("copied");
    let ego = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1";
    fs::write(path.join("ego.npz"), ego).expect("written");
    let all = |folder: &Path| -> Vec<(std::ffi::OsString, Vec<u8>)> {
        let entries = fs::read_dir(folder).expect("a list");
        let mut files: Vec<_> = entries
            .map(|entry| {
                let entry = entry.expect("an entry");
                (entry.file_name(), fs::read(entry.path()).expect("bytes"))
            })
            .collect();
        files.sort();
        files
    };
    let before = all(path);
    let sweeps = ["sweep_0000.pcd", "s_0000.pcd", "sweep_0002.pcd"];
    let [first, second, third] = sweeps;
    for arguments in [
        &["flow", "pair_0000.npz", "-o", "pair_0000.npz"][..],
        &["flow", "pair_0000.npz", "-o", "same.npz"],
        &["flow", "pair_0000.npz", "-o", "./pair_0000.npz"],
        &["flow", first, second, third, "-o", "s.pcd"],
        &["flow", first, third, "--ego", "ego.npz", "-o", "ego.npz"],
        &["flow", first, third, "-o", "a.pcd", "--picture", "a.pcd"],
        &[
            "densify",
            first,
            second,
            third,
            "--reference-time",
            "1",
            "-o",
            "s_0000.pcd",
        ],
    ] {
        let refused = fnsf(path, arguments);
        assert_eq!(refused.code, 2, "{arguments:?}: {}", refused.stderr);
    }
    assert!(all(path) == before);
}

#[test]
fn nothing_unfinished_is_left_behind_or_in_the_way() {
    let folder = street();
    let path = folder.path();
    // Unfinished files of other runs, for any process id of the next run.
    for id in 1..70_000 {
        if id % 1000 == 1 {
            fs::write(path.join(format!("flow.npz.{id}.part")), "").expect("written");
        }
    }
    let left = fs::read_dir(path).expect("a list").count();
    let done = fnsf(path, &["flow", "pair_0000.npz", "-o", "flow.npz"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert_eq!(fs::read_dir(path).expect("a list").count(), left + 1);
    let mode = {
        use std::os::unix::fs::PermissionsExt;
        let about = fs::metadata(path.join("flow.npz")).expect("it is there");
        let plain = fs::metadata(path.join("pair_0000.npz")).expect("it is there");
        (about.permissions().mode(), plain.permissions().mode())
    };
    assert_eq!(mode.0, mode.1);
}
