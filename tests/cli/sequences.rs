//! Tests of sequences and dense clouds from the command line.

use std::collections::HashMap;

use fnsf::flow::Point;
use fnsf::formats::{read_cloud, read_depth_png, read_flow, read_intensity, read_tracks};

use super::program::{fnsf, json, street};

pub(crate) const SWEEPS: [&str; 4] = [
    "street/sweep_0000.pcd",
    "street/sweep_0001.pcd",
    "street/sweep_0002.pcd",
    "street/sweep_0003.pcd",
];
const CAMERA: &str = r#"{"width": 310, "height": 94, "k": [[180, 0, 155], [0, 180, 47], [0, 0, 1]],
    "camera_from_lidar": [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]}"#;

#[test]
fn the_flows_of_a_sequence_are_numbered_and_the_first_is_that_of_its_pair_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    let of = |sweeps: &[&str], out: &str| {
        let options = ["--preset", "neural", "--device", "cpu", "-o", out];
        let arguments = [&["flow"], sweeps, &options].concat();
        let done = fnsf(folder, &arguments);
        assert_eq!(done.code, 0, "{}", done.stderr);
    };
    of(&SWEEPS, "all.npz");
    of(&SWEEPS[..2], "first.npz");
    let read = |name: &str| {
        let bytes = std::fs::read(folder.join(name)).expect("written");
        read_flow(&bytes, Some(name)).expect("a flow").flow
    };
    assert_eq!(read("all_0000.npz"), read("first.npz"));
    for (k, sweep) in SWEEPS[..3].iter().enumerate() {
        let bytes = std::fs::read(folder.join(sweep)).expect("written");
        let points = read_cloud(&bytes, Some(sweep)).expect("a cloud").points;
        assert_eq!(read(&format!("all_{k:04}.npz")).len(), points.len());
    }
    assert!(!folder.join("all_0003.npz").exists());
}

#[test]
fn sweeps_out_of_the_order_of_their_numbers_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    let [a, b, c, _] = SWEEPS;
    for (sweeps, warned) in [([a, b, c], false), ([c, b, a], false), ([a, c, b], true)] {
        let done = fnsf(
            folder,
            &[&["flow"], &sweeps[..], &["-o", "out.npz"]].concat(),
        );
        assert_eq!(done.code, 0, "{}", done.stderr);
        let warning = format!("{c} is followed by {b}");
        assert_eq!(done.stderr.contains(&warning), warned, "{}", done.stderr);
    }
    // Names may have been chosen by others, and steer no terminal.
    let names = [1, 10, 2].map(|sweep| format!("\u{1b}]52;c;x\u{7}{sweep}.pcd"));
    for (from, name) in [a, c, b].into_iter().zip(&names) {
        std::fs::rename(folder.join(from), folder.join(name)).expect("renamed");
    }
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let done = fnsf(
        folder,
        &[&["flow"], &names[..], &["-o", "out.npz"]].concat(),
    );
    assert!(done.stderr.contains("is followed by"), "{}", done.stderr);
    assert!(!done.stderr.contains('\u{1b}') && !done.stdout.contains('\u{1b}'));
}

#[test]
fn flows_that_wait_for_sweeps_to_come_are_numbered_and_reported_like_any() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    let options = [
        "--device", "cpu", "--preset", "label", "--json", "-o", "all.npz",
    ];
    let done = fnsf(folder, &[&["flow"], &SWEEPS[..], &options].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert_eq!(done.stdout.lines().count(), 3);
    for (k, sweep) in SWEEPS[..3].iter().enumerate() {
        let bytes = std::fs::read(folder.join(sweep)).expect("written");
        let points = read_cloud(&bytes, Some(sweep)).expect("a cloud").points;
        let name = format!("all_{k:04}.npz");
        let bytes = std::fs::read(folder.join(&name)).expect("written");
        assert_eq!(
            read_flow(&bytes, Some(&name)).expect("a flow").flow.len(),
            points.len()
        );
    }
}

#[test]
fn a_dense_cloud_has_every_point_and_shows_more_than_one_sweep_through_a_camera() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    std::fs::write(folder.join("camera.json"), CAMERA).expect("written");
    for (into, preset, out) in [
        ("2", "neural", "dense.ply"),
        ("1.5", "default", "dense.npz"),
        ("0", "label", "dense.pcd"),
    ] {
        let options = [
            "--reference-time",
            into,
            "--preset",
            preset,
            "--device",
            "cpu",
            "-o",
            out,
            "--camera",
            "camera.json",
            "--depth",
            "depth.png",
            "--picture",
            "look.png",
            "--json",
        ];
        let report = json(folder, &[&["densify"], &SWEEPS[..], &options].concat());
        let bytes = std::fs::read(folder.join(out)).expect("written");
        let points = read_cloud(&bytes, Some(out)).expect("a cloud").points;
        assert_eq!(report["points"], points.len());
        let all: usize = SWEEPS
            .iter()
            .map(|sweep| {
                let bytes = std::fs::read(folder.join(sweep)).expect("written");
                read_cloud(&bytes, Some(sweep))
                    .expect("a cloud")
                    .points
                    .len()
            })
            .sum();
        assert_eq!(points.len(), all);
        let [sparse, dense] = [0, 1].map(|k| report["depth_density"][k].as_f64().expect("a share"));
        assert!(dense > 2.0 * sparse, "{sparse} {dense}");
        let depth = std::fs::read(folder.join("depth.png")).expect("written");
        let depth = read_depth_png(&depth).expect("KITTI's png");
        assert!((depth.density() - dense).abs() < 1e-9);
    }
    let cropped = [
        "--reference-time",
        "1",
        "--crop-m",
        "20",
        "--device",
        "cpu",
        "-o",
        "near.ply",
        "--picture",
        "above.png",
    ];
    let done = fnsf(folder, &[&["densify"], &SWEEPS[..], &cropped].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    let picture = std::fs::read(folder.join("above.png")).expect("written");
    assert!(picture.starts_with(b"\x89PNG"));
    let bytes = std::fs::read(folder.join("near.ply")).expect("written");
    let points = read_cloud(&bytes, Some("near.ply"))
        .expect("a cloud")
        .points;
    // The crop applies to the sweep of each point. The points are then moved by at most two metres.
    assert!(
        points
            .iter()
            .all(|[x, y, _]| x.abs() < 25.0 && y.abs() < 25.0)
    );
}

#[test]
fn a_dense_cloud_keeps_the_intensities_of_its_sweeps() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    // KITTI's rows. The intensity of a row tells its number.
    let intensity = |row: usize| (row % 1000) as f32 / 1000.0;
    let mut clouds = Vec::new();
    for sweep in SWEEPS {
        let bytes = std::fs::read(folder.join(sweep)).expect("written");
        let points = read_cloud(&bytes, Some(sweep)).expect("a cloud").points;
        let rows = points.iter().enumerate();
        let rows = rows.flat_map(|(row, &[x, y, z])| [x, y, z, intensity(row)]);
        let bytes: Vec<u8> = rows.flat_map(f32::to_le_bytes).collect();
        std::fs::write(folder.join(sweep).with_extension("kitti.bin"), bytes).expect("written");
        clouds.push(points);
    }
    let bins = SWEEPS.map(|sweep| sweep.replace(".pcd", ".kitti.bin"));
    let bins: Vec<&str> = bins.iter().map(String::as_str).collect();
    let densify = |sweeps: &[&str]| {
        let options = "--reference-time 1 --crop-m 20 --device cpu -o near.ply";
        let options: Vec<&str> = options.split(' ').collect();
        let done = fnsf(folder, &[&["densify"], sweeps, &options].concat());
        (done, std::fs::read(folder.join("near.ply")))
    };
    let (done, dense) = densify(&bins);
    assert_eq!(done.code, 0, "{}", done.stderr);
    let dense = dense.expect("written");
    let points = read_cloud(&dense, None).expect("a cloud").points;
    let found = read_intensity(&dense, None).expect("a column");
    let found = found.expect("intensities");
    assert_eq!(found.len(), points.len());
    // Points of sweep 1, whose time is the reference time, stay where they are.
    let place = |point: [f32; 3]| point.map(f32::to_bits);
    let of_sweep = clouds[1].iter().enumerate();
    let of_sweep: HashMap<_, _> = of_sweep.map(|(row, &point)| (place(point), row)).collect();
    let rows = points.iter().zip(&found);
    let known = rows.filter_map(|(&point, &found)| Some((*of_sweep.get(&place(point))?, found)));
    let known: Vec<(usize, f32)> = known.collect();
    assert!(known.len() * 5 > points.len(), "{}", known.len());
    for (row, found) in known {
        assert_eq!(found, intensity(row));
    }
    // One sweep without intensities: there is no column.
    let (done, dense) = densify(&[bins[0], bins[1], SWEEPS[2], bins[3]]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert_eq!(
        read_intensity(&dense.expect("written"), None).expect("a cloud"),
        None
    );
}

#[test]
fn a_given_ego_motion_of_two_sweeps_leads_a_dense_cloud_back_as_well() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    assert_eq!(fnsf(folder, &["synth", "-o", "."]).code, 0);
    let dense = |options: &[&str]| {
        let sweeps = ["densify", "sweep_0000.pcd", "sweep_0001.pcd"];
        let output = ["--reference-time", "0", "-o", "dense.ply"];
        let done = fnsf(folder, &[&sweeps[..], &output, options].concat());
        assert_eq!(done.code, 0, "{}", done.stderr);
        let bytes = std::fs::read(folder.join("dense.ply")).expect("written");
        read_cloud(&bytes, None).expect("a cloud").points
    };
    let (found, given) = (dense(&[]), dense(&["--ego", "pair_0000.npz"]));
    assert_eq!(found.len(), given.len());
    let off = |(a, b): (&Point, &Point)| f64::from((a[0] - b[0]).hypot(a[1] - b[1]));
    let off = found.iter().zip(&given).map(off).sum::<f64>() / found.len() as f64;
    // The sensor moves by a metre.
    assert!(off < 0.1, "{off}");
}

#[test]
fn what_no_sequence_can_be_asked_is_refused_with_advice() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n";
    std::fs::write(folder.join("poses.txt"), poses).expect("written");
    let ego = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n";
    std::fs::write(folder.join("ego.txt"), ego).expect("written");
    let [a, b, c, _] = SWEEPS;
    let refused: [(&[&str], i32, &str); 7] = [
        (
            &[
                "densify",
                a,
                b,
                "--reference-time",
                "0",
                "--picture",
                "x.jpg",
            ],
            2,
            "ends in .png",
        ),
        (
            &["densify", a, b, "--reference-time", "2", "-o", "x.ply"],
            2,
            "0 to 1",
        ),
        (
            &["densify", a, b, "--reference-time", "0", "-o", "x.obj"],
            2,
            ".laz",
        ),
        (
            &["flow", a, b, c, "--ego", "ego.txt", "--json"],
            2,
            "--poses",
        ),
        (&["flow", a, b, c, "--ground", "mask", "--json"], 2, "auto"),
        (
            &[
                "flow",
                "street/pair_0000.npz",
                "--poses",
                "poses.txt",
                "--json",
            ],
            2,
            "--ego FILE",
        ),
        (
            &["flow", a, b, c, "--poses", "poses.txt", "--json"],
            65,
            "poses",
        ),
    ];
    for (arguments, code, advice) in refused {
        let ended = fnsf(folder, arguments);
        assert_eq!(ended.code, code, "{arguments:?}: {}", ended.stderr);
        assert!(
            ended.stderr.contains(advice),
            "{arguments:?}: {}",
            ended.stderr
        );
    }
}

#[test]
fn tracks_of_a_sequence_are_written_drawn_and_scored() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let arguments = ["synth", "-o", "street", "--beams", "32", "--sweeps", "7"];
    assert_eq!(fnsf(folder, &arguments).code, 0);
    let sweeps: Vec<String> = (0..7)
        .map(|index| format!("street/sweep_{index:04}.pcd"))
        .collect();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let outputs = ["--tracks", "tracks.json", "--tracks-picture", "tracks.png"];
    let done = fnsf(folder, &[&["flow"], &sweeps[..], &outputs].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert!(done.stdout.contains(" tracks, "), "{}", done.stdout);
    let bytes = std::fs::read(folder.join("tracks.json")).expect("written");
    let tracks = read_tracks(&bytes).expect("tracks");
    assert!(tracks.len() > 3, "{}", tracks.len());
    let picture = std::fs::read(folder.join("tracks.png")).expect("written");
    assert!(picture.starts_with(b"\x89PNG"));
    let truth = ["--truth", "street/tracks.json"];
    let score = json(
        folder,
        &[&["eval", "tracks.json"], &truth[..], &["--json"]].concat(),
    );
    let [truth, matches] = ["truth", "matches"].map(|key| score[key].as_u64().expect("a number"));
    assert!(matches * 2 > truth, "{score}");
    assert!(score["hota"].as_f64().is_some_and(|hota| hota > 0.3));
}

#[test]
fn flows_and_tracks_before_a_pair_that_is_refused_are_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let arguments = ["synth", "-o", "street", "--beams", "32", "--sweeps", "6"];
    assert_eq!(fnsf(folder, &arguments).code, 0);
    std::fs::write(folder.join("street/sweep_0005.pcd"), "cut").expect("written");
    let sweeps: Vec<String> = (0..6)
        .map(|index| format!("street/sweep_{index:04}.pcd"))
        .collect();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let outputs = [
        "--preset",
        "label",
        "-o",
        "flow.npz",
        "--tracks",
        "tracks.json",
    ];
    let done = fnsf(folder, &[&["flow"], &sweeps[..], &outputs].concat());
    assert_eq!(done.code, 65, "{}", done.stderr);
    assert!(done.stderr.contains("sweep_0005.pcd"), "{}", done.stderr);
    for pair in 0..4 {
        assert!(
            folder.join(format!("flow_{pair:04}.npz")).exists(),
            "{pair}"
        );
    }
    let bytes = std::fs::read(folder.join("tracks.json")).expect("written");
    let tracks = read_tracks(&bytes).expect("tracks");
    assert!(tracks.iter().any(|track| track.states.len() > 2));
}

#[test]
fn tracks_of_what_cannot_have_any_are_refused_before_any_work() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    let refused = |sweeps: &[&str], options: &[&str]| {
        let tracks = ["--tracks", "tracks.json"];
        let done = fnsf(folder, &[&["flow"], sweeps, &tracks, options].concat());
        assert_eq!(done.code, 2, "{}", done.stderr);
        assert!(!folder.join("tracks.json").exists());
        done.stderr
    };
    assert!(refused(&SWEEPS[..3], &[]).contains("tracks need 4 sweeps or more"));
    assert!(refused(&SWEEPS, &["--preset", "paper"]).contains("--preset default or label"));
    assert!(refused(&SWEEPS, &["--ego", "off"]).contains("ego motion"));
    assert!(refused(&SWEEPS, &["--tracks-picture", "a.jpg"]).contains(".png"));
}
