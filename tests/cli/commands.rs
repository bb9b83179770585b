//! Tests of every command of the command line, and of the fields of its JSON reports.

use fnsf::flow::gpu::{Adapter, AdapterKind, adapters};

use super::gpu_rule;
use super::program::{fnsf, json, street};

#[test]
fn synth_flow_and_eval_work_hand_in_hand_in_every_output_format() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let mut first = None;
    for format in ["npz", "npy", "feather", "ply", "pcd", "json"] {
        let out = format!("flow.{format}");
        let arguments = [
            "flow",
            "street/pair_0000.npz",
            "--device",
            "cpu",
            "-o",
            &out,
        ];
        let done = fnsf(folder, &arguments);
        assert_eq!(done.code, 0, "{}", done.stderr);
        assert!(
            done.stderr.is_empty(),
            "no bar without a terminal: {}",
            done.stderr
        );
        let score = json(
            folder,
            &["eval", &out, "--truth", "street/pair_0000.npz", "--json"],
        );
        let epe = score["epe"].as_f64().expect("a number");
        assert!(epe < 0.5, "{format}: {epe}");
        let expected = *first.get_or_insert(epe);
        assert!((epe - expected).abs() < 1e-6, "{format}: {epe} {expected}");
    }
}

#[test]
fn the_json_report_has_every_field_of_the_contract() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let arguments = [
        "flow",
        "street/sweep_0000.pcd",
        "street/sweep_0001.pcd",
        "--json",
        "--seed",
        "4",
        "--max-points",
        "4000",
        "--threads",
        "1",
    ];
    let report = json(folder, &arguments);
    let fields = [
        "points",
        "valid_points",
        "dt_s",
        "dt_assumed",
        "objects",
        "stop_reason",
        "device",
        "preset",
        "seed",
        "ego_motion",
        "seconds",
        "peak_rss_bytes",
    ];
    for field in fields {
        assert!(!report[field].is_null(), "{field} in {report}");
    }
    for phase in ["load", "precompute", "search", "total"] {
        assert!(
            report["seconds"][phase].as_f64().is_some_and(|s| s >= 0.0),
            "{phase}"
        );
    }
    assert_eq!(report["valid_points"], 4000);
    assert_eq!(report["seed"], 4);
    assert_eq!(report["preset"], "default");
    let paper = json(folder, &[&arguments[..], &["--preset", "paper"]].concat());
    assert!(paper["ego_motion"].is_null());
    assert_eq!(paper["stop_reason"], "converged");
}

#[test]
fn the_number_of_threads_does_not_change_the_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let flow = |preset: &str, threads: &str, out: &str| {
        let arguments = [
            "flow",
            "street/pair_0000.npz",
            "--preset",
            preset,
            "--threads",
            threads,
            "-o",
            out,
        ];
        assert_eq!(fnsf(folder, &arguments).code, 0);
        std::fs::read(folder.join(out)).expect("the flow was written")
    };
    for preset in ["default", "neural"] {
        let [one, three] = [("1", "one.npy"), ("3", "three.npy")];
        assert_eq!(flow(preset, one.0, one.1), flow(preset, three.0, three.1));
    }
}

#[test]
fn a_known_ego_motion_can_be_given_as_text_or_as_a_pair() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    std::fs::write(
        folder.join("still.txt"),
        "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    )
    .expect("written");
    let pair = "street/pair_0000.npz";
    let report = json(folder, &["flow", pair, "--json", "--ego", "still.txt"]);
    assert_eq!(
        report["ego_motion"][0],
        serde_json::json!([1.0, 0.0, 0.0, 0.0])
    );
    let report = json(folder, &["flow", pair, "--json", "--ego", pair]);
    assert!(
        report["ego_motion"][0][3]
            .as_f64()
            .is_some_and(|x| x < -0.1),
        "{report}"
    );
    let report = json(folder, &["flow", pair, "--json", "--ego", "off"]);
    assert!(report["ego_motion"].is_null());
}

#[test]
fn the_demo_writes_a_flow_and_a_picture_and_prints_the_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let done = fnsf(folder.path(), &["demo"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert!(done.stdout.contains("EPE"), "{}", done.stdout);
    for name in ["demo/flow.npz", "demo/flow.png"] {
        let size = std::fs::metadata(folder.path().join(name))
            .expect("written")
            .len();
        assert!(size > 10_000, "{name}: {size} bytes");
    }
}

#[test]
fn doctor_names_the_devices_and_help_teaches() {
    let folder = tempfile::tempdir().expect("a folder");
    let doctor = fnsf(folder.path(), &["doctor"]);
    assert_eq!(doctor.code, 0);
    assert!(doctor.stdout.contains("portable"), "{}", doctor.stdout);
    assert!(doctor.stdout.contains("\ngpu:"), "{}", doctor.stdout);
    for arguments in [
        &["--help"][..],
        &["flow", "--help"],
        &["eval", "--help"],
        &["synth", "--help"],
    ] {
        let help = fnsf(folder.path(), arguments);
        assert_eq!(help.code, 0);
        assert!(
            help.stdout.contains("fnsf "),
            "{arguments:?}: {}",
            help.stdout
        );
    }
}

#[test]
fn wrong_arguments_are_refused_with_exit_code_2_before_any_work() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("sweep_0003.pcd"), "").expect("a file");
    let refused: [&[&str]; 8] = [
        &["synth", "-o", ".", "--sweeps", "3"],
        &["flow"],
        &["flow", "a.npz"],
        &["flow", "a.npz", "-o", "flow.xyz"],
        &["flow", "a.npz", "-o", "flow.npz", "--preset", "best"],
        &["flow", "a.npz", "-o", "flow.npz", "--crop-m", "-3"],
        &["synth", "-o", "s", "--beams", "0"],
        &["fly"],
    ];
    for arguments in refused {
        let ended = fnsf(folder.path(), arguments);
        assert_eq!(ended.code, 2, "{arguments:?}: {}", ended.stderr);
        assert!(!ended.stderr.is_empty());
    }
}

/// Runs the program. Its stdout is closed at once.
fn without_reader(folder: &std::path::Path, arguments: &[&str]) -> std::process::Output {
    use std::process::{Command, Stdio};
    let mut child = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .current_dir(folder)
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    child.wait_with_output().expect("the child is ours")
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    let folder = tempfile::tempdir().expect("a folder");
    let ended = without_reader(folder.path(), &["doctor"]);
    assert!(ended.status.success(), "{ended:?}");
    assert!(ended.stderr.is_empty(), "{ended:?}");
}

#[test]
fn files_are_written_though_the_reader_of_the_lines_goes_away() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "4");
    let sweeps = [0, 1, 2, 3].map(|sweep| format!("street/sweep_{sweep:04}.pcd"));
    let sweeps = sweeps.each_ref().map(String::as_str);
    let ended = without_reader(folder, &[&["flow", "-o", "flow.npz"][..], &sweeps].concat());
    assert!(ended.status.success(), "{ended:?}");
    let written = std::fs::read_dir(folder).expect("a folder");
    let written = written.filter(|file| {
        let name = file.as_ref().expect("a file").file_name();
        name.to_string_lossy().ends_with(".npz")
    });
    assert_eq!(written.count(), 3);
}

#[test]
fn clouds_far_from_the_origin_align_as_near_ones_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    // Single precision resolves 4 mm at 50 km. The motion is that of the same street at the origin.
    let shifted = |name: &str| {
        let pcd = std::fs::read(folder.join(name)).expect("written");
        let cloud = fnsf::formats::read_cloud(&pcd, None)
            .expect("a cloud")
            .points;
        let far: Vec<_> = cloud.iter().map(|p| [p[0] + 5e4, p[1], p[2]]).collect();
        let mut file = Vec::new();
        fnsf::formats::write_cloud(fnsf::formats::CloudFormat::Npy, &far, &mut file)
            .expect("memory takes all");
        std::fs::write(folder.join(format!("{name}.npy")), file).expect("written");
    };
    let names = ["street/sweep_0000.pcd", "street/sweep_0001.pcd"];
    names.iter().for_each(|name| shifted(name));
    let near = json(
        folder,
        &["flow", names[0], names[1], "-o", "near.npy", "--json"],
    );
    let far_names = names.map(|name| format!("{name}.npy"));
    let far = json(
        folder,
        &[
            "flow",
            &far_names[0],
            &far_names[1],
            "-o",
            "far.npy",
            "--json",
        ],
    );
    let turn = |report: &serde_json::Value| report["ego_motion"][1][0].as_f64().expect("a number");
    assert!((turn(&near) - turn(&far)).abs() < 1e-3, "{near} {far}");
    assert!(near["warnings"].is_null(), "{near}");
    let warned = far["warnings"].to_string();
    assert!(warned.contains("far from the origin"), "{warned}");
}

#[test]
fn a_field_that_is_fitted_far_from_the_origin_is_that_of_the_same_cloud_at_home() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let pcd = std::fs::read(folder.join("street/sweep_0000.pcd")).expect("written");
    let cloud = fnsf::formats::read_cloud(&pcd, None)
        .expect("a cloud")
        .points;
    // The same cloud twice, so nothing moves. Single precision resolves 8 mm at 100 km.
    for x in [0.0, 1e3, 1e5] {
        let points: Vec<_> = cloud.iter().map(|p| [p[0] + x, p[1], p[2]]).collect();
        let mut file = Vec::new();
        fnsf::formats::write_cloud(fnsf::formats::CloudFormat::Npy, &points, &mut file)
            .expect("memory takes all");
        for name in ["a.npy", "b.npy"] {
            std::fs::write(folder.join(name), &file).expect("written");
        }
        let arguments = "flow a.npy b.npy --preset paper --max-points 2048 -o flow.npy --json";
        json(folder, &arguments.split(' ').collect::<Vec<_>>());
        let flow = std::fs::read(folder.join("flow.npy")).expect("written");
        let flow = fnsf::formats::read_flow(&flow, Some("flow.npy"))
            .expect("a flow")
            .flow;
        let longest = flow
            .iter()
            .flatten()
            .fold(0.0_f32, |most, x| most.max(x.abs()));
        assert!(longest < 0.3, "{x} m: {longest} m");
    }
}

#[test]
fn auto_without_a_card_says_so_and_a_card_that_is_not_there_is_refused_with_advice() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let flow = |device: &str| {
        let pair = "street/pair_0000.npz";
        let preset = ["--preset", "neural"];
        let arguments = [&["flow", pair, "--json", "--device", device], &preset[..]];
        fnsf(folder, &arguments.concat())
    };
    let refused = flow("gpu:no card has this name");
    assert_eq!((refused.code, refused.stdout.as_str()), (70, ""));
    assert!(refused.stderr.contains("fnsf doctor"), "{}", refused.stderr);
    assert_eq!(flow("tpu").code, 2);
    assert_eq!(flow("cpu:1").code, 2);
    let hardware = |card: &Adapter| card.kind != AdapterKind::Software;
    let auto = flow("auto");
    assert_eq!(auto.code, 0, "{}", auto.stderr);
    if !adapters().iter().any(hardware) {
        let warnings = auto.stderr.matches("warning: the CPU does the work");
        assert_eq!(warnings.count(), 1, "{}", auto.stderr);
    }
}

#[test]
fn objects_are_found_by_the_host_on_a_software_device_too_and_the_report_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let pair = "street/pair_0000.npz";
    let flow = |device: &str| fnsf(folder, &["flow", pair, "--json", "--device", device]);
    let auto = flow("auto");
    assert_eq!((auto.code, auto.stderr.as_str()), (0, ""));
    let mut reports = vec![auto.stdout];
    let adapters = adapters();
    // A hardware GPU searches the clusters if the host has few threads.
    let software = |adapter: &Adapter| adapter.kind == AdapterKind::Software;
    if gpu_rule::is_there(adapters.len()) && adapters.iter().all(software) {
        reports.push(flow("gpu:0").stdout);
    }
    for report in reports {
        let report: serde_json::Value = serde_json::from_str(&report).expect("JSON");
        let device = report["device"].as_str().expect("a name");
        assert!(device.starts_with("cpu ("), "{report}");
    }
}

#[test]
fn every_method_of_the_paper_gives_a_flow_and_refuses_a_gpu_that_it_has_no_kernels_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let usual = ["flow", "street/pair_0000.npz", "--max-points", "100"];
    for (preset, unit) in [
        ("nsfp-baseline", "m²"),
        ("nsfp", "m²"),
        ("nsfp++", "m²"),
        ("nsfp++-dt", "m"),
        ("nsfp-kdtree", "m²"),
        ("fnsf-linear", "m"),
        ("nsfp-linear", "m²"),
        ("nsfp-kdtree-linear", "m²"),
    ] {
        let asked = ["--preset", preset, "--json"];
        let report = json(folder, &[&usual[..], &asked].concat());
        assert_eq!(report["stop_reason"], "converged", "{report}");
        assert_eq!(report["field"]["loss_unit"], unit, "{report}");
        let asked = ["--preset", preset, "--device", "gpu:0", "--json"];
        let asked = [&usual[..], &asked].concat();
        if ["nsfp-baseline", "fnsf-linear", "nsfp-linear"].contains(&preset) {
            if gpu_rule::is_there(adapters().len()) {
                let report = json(folder, &asked);
                assert_eq!(report["stop_reason"], "converged", "{report}");
                let device = report["device"].as_str().expect("a name");
                assert!(!device.starts_with("cpu ("), "{report}");
            }
            continue;
        }
        let refused = fnsf(folder, &asked);
        assert_eq!((refused.code, refused.stdout.as_str()), (2, ""));
        let said = &refused.stderr;
        assert!(said.contains("is computed on the CPU alone"), "{said}");
    }
}

#[test]
fn half_precision_of_what_fits_no_field_is_refused_before_any_work() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let pair = "street/pair_0000.npz";
    for preset in ["default", "label"] {
        let asked = ["--preset", preset, "--precision", "f16", "--json"];
        let refused = fnsf(folder, &[&["flow", pair][..], &asked].concat());
        assert_eq!((refused.code, refused.stdout.as_str()), (2, ""));
        let said = &refused.stderr;
        assert!(said.contains("take preset neural"), "{said}");
    }
}
