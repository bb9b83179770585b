//! Tests of `fnsf submit` and `fnsf jobs` against a server.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use fnsf::formats::CloudFormat;
use serde_json::Value;

use crate::clouds::{file, small_pair};
use crate::server::{Folder, Server};

const KEY: &str = "a-key-of-the-command-line";

/// Runs `fnsf` in a folder, against a server, with a key.
fn fnsf(server: &Server, folder: &Path, key: &str, arguments: &[&str]) -> Output {
    let run = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(arguments)
        .current_dir(folder)
        .env("FNSF_SERVER", server.url("/"))
        .env("FNSF_API_KEY", key)
        .output();
    run.expect("it runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn sweeps_are_submitted_and_jobs_listed_shown_cancelled_requeued_and_removed() {
    let config = format!("api_key = \"{KEY}\"\n");
    let server = Server::with_config(&config);
    let folder = Folder::new();
    for (name, points) in ["a.pcd", "b.pcd", "c.pcd"]
        .iter()
        .zip(small_pair().iter().cycle())
    {
        std::fs::write(folder.path().join(name), file(CloudFormat::Pcd, points)).expect("a file");
    }
    let run = |arguments: &[&str]| {
        let ended = fnsf(&server, folder.path(), KEY, arguments);
        assert!(
            ended.status.success(),
            "{arguments:?}: {}",
            text(&ended.stderr)
        );
        text(&ended.stdout)
    };
    let said = run(&[
        "submit", "a.pcd", "b.pcd", "-o", "flow.ply", "--label", "drive=7",
    ]);
    assert!(said.contains("wrote flow.ply"), "{said}");
    let flow = std::fs::read(folder.path().join("flow.ply")).expect("a flow");
    assert!(flow.starts_with(b"ply"));
    run(&["submit", "a.pcd", "b.pcd", "c.pcd", "-o", "flows.zip"]);
    let zip = std::fs::read(folder.path().join("flows.zip")).expect("flows");
    assert!(zip.starts_with(b"PK"));
    // A dense cloud of two sweeps, which have more points than are drawn only before they are cropped.
    let drawn = (small_pair()[0].len() - 1).to_string();
    let dense = format!(
        r#"{{"crop_m": 20, "max_points": {drawn}, "densify": {{"reference_time": 1}}, "seed": 3}}"#
    );
    let sweeps = ["a.pcd", "b.pcd", "-o"];
    let submit = ["submit", "--preset", "neural", "--options", &dense];
    let submit = [&submit, &sweeps[..]].concat();
    run(&[&submit[..], &["dense.npz"]].concat());
    let options = ["--crop-m", "20", "--max-points", &drawn, "--seed", "3"];
    let densify = ["densify", "--preset", "neural", "--reference-time", "1"];
    let densify = [&densify[..], &options, &sweeps].concat();
    run(&[&densify[..], &["local.npz"]].concat());
    let [dense, local] = ["dense.npz", "local.npz"]
        .map(|path| std::fs::read(folder.path().join(path)).expect("a dense cloud"));
    assert!(fnsf::formats::is_dense(&dense));
    assert!(
        dense == local,
        "the server's dense cloud is not that of the command line"
    );

    // A job that lasts, one behind it, and their cancellation.
    let long = r#"{"field": {"max_iterations": 1000000, "patience": 1000000}}"#;
    let long = [
        "submit",
        "a.pcd",
        "b.pcd",
        "--preset",
        "paper",
        "--options",
        long,
        "--detach",
    ];
    let ids = [
        run(&long),
        run(&["submit", "a.pcd", "b.pcd", "--label", "drive=7", "--detach"]),
    ];
    let ids = ids.map(|id| id.trim().to_owned());
    let listed = run(&["jobs", "list", "--label", "drive=7", "--json"]);
    let listed: Vec<Value> = listed
        .lines()
        .map(|line| serde_json::from_str(line).expect("a job"))
        .collect();
    assert_eq!(listed.len(), 2);
    assert_eq!(listed[0]["id"], ids[1].as_str());
    let cancelled = run(&["jobs", "cancel", &ids[0], &ids[1]]);
    assert!(cancelled.contains("2 jobs cancelled"), "{cancelled}");
    server.until("both have ended", || {
        run(&["jobs", "list", "--state", "cancelled"])
            .lines()
            .count()
            == 2
    });
    // All that a filter finds.
    let requeued = run(&[
        "jobs",
        "requeue",
        "--state",
        "cancelled",
        "--label",
        "drive=7",
    ]);
    assert!(requeued.contains("1 jobs requeued"), "{requeued}");
    server.until("it is done", || {
        let shown: Value = serde_json::from_str(&run(&["jobs", "show", &ids[1]])).expect("JSON");
        shown["state"] == "succeeded"
    });
    run(&["jobs", "remove", &ids[1]]);
    assert_eq!(
        run(&["jobs", "requeue", "--dead-letters"]),
        "0 jobs requeued\n"
    );
    assert_eq!(
        run(&["jobs", "list", "--label", "drive=7"]).lines().count(),
        1
    );
}

/// A folder with two sweeps, `a.pcd` and `b.pcd`.
fn with_two_sweeps() -> Folder {
    let folder = Folder::new();
    for (name, points) in ["a.pcd", "b.pcd"].iter().zip(small_pair()) {
        std::fs::write(folder.path().join(name), file(CloudFormat::Pcd, points)).expect("a file");
    }
    folder
}

#[test]
fn an_output_is_checked_before_anything_is_sent() {
    let server = Server::with_config(&format!("api_key = \"{KEY}\"\n"));
    let folder = with_two_sweeps();
    let run = |arguments: &[&str]| fnsf(&server, folder.path(), KEY, arguments);
    let b = std::fs::read(folder.path().join("b.pcd")).expect("a sweep");
    for (arguments, code, what) in [
        (
            &["submit", "a.pcd", "b.pcd", "-o", "b.pcd"][..],
            2,
            "written over",
        ),
        (
            &["submit", "a.pcd", "b.pcd", "-o", "b.pcd/f.npz"],
            70,
            "folder cannot be created",
        ),
        (&["submit", "a.pcd", "b.pcd", "-o", "flow.xyz"], 2, ".npz"),
        (&["submit", "a.pcd", "b.pcd", "-o", "flow"], 2, ".npz"),
        (
            &["submit", "a.pcd", "b.pcd", "a.pcd", "-o", "flows.npz"],
            2,
            ".zip",
        ),
    ] {
        let ended = run(arguments);
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(what), "{arguments:?}: {said}");
    }
    assert_eq!(
        std::fs::read(folder.path().join("b.pcd")).expect("a sweep"),
        b
    );
    assert_eq!(text(&run(&["jobs", "list"]).stdout), "");

    // An ending in capitals is the same, and a pipe is written as it is.
    let ended = run(&["submit", "a.pcd", "b.pcd", "-o", "flow.PLY"]);
    assert!(ended.status.success(), "{}", text(&ended.stderr));
    let flow = std::fs::read(folder.path().join("flow.PLY")).expect("a flow");
    assert!(flow.starts_with(b"ply"));
    let pipe = folder.path().join("pipe.ply");
    let made = Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo").success());
    let reader = std::thread::spawn({
        let pipe = pipe.clone();
        move || std::fs::read(pipe)
    });
    let ended = run(&["submit", "a.pcd", "b.pcd", "-o", "pipe.ply"]);
    assert!(ended.status.success(), "{}", text(&ended.stderr));
    let read = reader.join().expect("no panic").expect("a flow");
    assert_eq!(read, flow);

    // A job that has ended is not cancelled, and is not said to be.
    let id = text(&run(&["jobs", "list"]).stdout);
    let id = id.split_whitespace().next().expect("a job").to_owned();
    let cancelled = text(&run(&["jobs", "cancel", &id]).stdout);
    assert!(cancelled.contains("it had succeeded"), "{cancelled}");
    assert!(cancelled.contains("0 jobs cancelled"), "{cancelled}");
    let cancelled = text(&run(&["jobs", "cancel", "--state", "succeeded"]).stdout);
    assert_eq!(cancelled, "0 jobs cancelled\n");
}

#[test]
fn a_submission_outlives_a_restart_of_its_server() {
    let config = format!("api_key = \"{KEY}\"\n");
    let server = Server::with_config(&config);
    let folder = with_two_sweeps();
    let long = r#"{"field": {"max_iterations": 1500, "patience": 1500}}"#;
    let submitted = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args([
            "submit", "a.pcd", "b.pcd", "-o", "flow.npz", "--preset", "paper",
        ])
        .args(["--options", long])
        .current_dir(folder.path())
        .env("FNSF_SERVER", server.url("/"))
        .env("FNSF_API_KEY", KEY)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it runs");
    server.until("the job runs", || {
        let running = fnsf(
            &server,
            folder.path(),
            KEY,
            &["jobs", "list", "--state", "running"],
        );
        !running.stdout.is_empty()
    });
    let _server = server.killed_and_started(&config);
    let ended = submitted.wait_with_output().expect("it ends");
    assert!(ended.status.success(), "{}", text(&ended.stderr));
    assert!(folder.path().join("flow.npz").exists());
}

#[test]
fn what_the_server_refuses_is_said_in_its_words() {
    let config = format!("api_key = \"{KEY}\"\n");
    let server = Server::with_config(&config);
    let folder = Folder::new();
    std::fs::write(folder.path().join("a.pcd"), "nothing of the kind").expect("a file");
    let unknown = "0198c2d1-5ad7-7c3a-9c55-0f2f3a1b4c5d";
    for (key, arguments, code, what) in [
        (
            "a-wrong-key-for-the-server",
            &["jobs", "list"][..],
            70,
            "a valid key is needed",
        ),
        (KEY, &["jobs", "show", unknown], 70, "no job has this name"),
        (KEY, &["jobs", "show", "../info"], 70, "server answered"),
        (KEY, &["jobs", "list", "--state", "lost"], 2, "lost"),
        (KEY, &["jobs", "requeue"], 2, "required"),
        (
            KEY,
            &["submit", "a.pcd", "a.pcd", "-o", "f.npz"],
            65,
            "unrecognized file",
        ),
        (
            KEY,
            &["submit", "a.pcd", "missing.pcd", "-o", "f.npz"],
            65,
            "missing.pcd",
        ),
        (KEY, &["submit", "a.pcd", "a.pcd"], 2, "--output"),
        (KEY, &["jobs", "list", "--server", "ftp://a"], 2, "ftp://a"),
        (KEY, &["jobs", "list", "--server", "a:80"], 2, "http://"),
        (
            KEY,
            &["jobs", "--server", "http://127.0.0.1:9", "list"],
            70,
            "cannot reach",
        ),
    ] {
        let ended = fnsf(&server, folder.path(), key, arguments);
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(what), "{arguments:?}: {said}");
    }
    // A list of one refused id goes on, and fails in the end.
    let ended = fnsf(&server, folder.path(), KEY, &["jobs", "cancel", unknown]);
    assert_eq!(ended.status.code(), Some(70));
    assert!(text(&ended.stdout).contains("no job has this name"));
}
