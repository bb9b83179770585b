//! Runs every `curl` example of the README unchanged against a server with matching files.

use std::fs;
use std::path::Path;
use std::process::Command;

use fnsf::formats::{CloudFormat, Ground, Pair, read_flow, write_pair_npz};
use serde_json::Value;

use crate::clouds::{file, small_pair};
use crate::server::Server;

/// The commands of the marked block in the README.
fn examples() -> Vec<String> {
    let readme = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md"));
    let readme = readme.expect("a README");
    let block = readme
        .split("<!-- curl:")
        .nth(1)
        .expect("the block is marked");
    let block = block.split("```").nth(1).expect("it is fenced");
    let lines = block.lines().filter(|line| line.starts_with("curl"));
    lines.map(str::to_owned).collect()
}

/// Writes the files that the examples name.
fn lay_out(folder: &Path) {
    let [source, target] = small_pair();
    for (name, points) in [("a", source), ("b", target), ("c", source)] {
        for (format, ending) in [
            (CloudFormat::Pcd, "pcd"),
            (CloudFormat::Ply, "ply"),
            (CloudFormat::Npy, "npy"),
            (CloudFormat::Feather, "feather"),
        ] {
            let path = folder.join(format!("{name}.{ending}"));
            fs::write(path, file(format, points)).expect("written");
        }
    }
    let low = |points: &[[f32; 3]]| points.iter().map(|point| point[2] < -1.5).collect();
    let pair = Pair {
        source: source.clone(),
        target: target.clone(),
        ground: Some(Ground {
            source: low(source),
            target: low(target),
        }),
        ..Pair::default()
    };
    let mut bytes = Vec::new();
    write_pair_npz(&pair, &mut bytes).expect("written");
    fs::write(folder.join("pair.npz"), bytes).expect("written");
}

#[test]
fn every_curl_of_the_readme_does_what_it_says() {
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().expect("a folder");
    lay_out(folder.path());
    let examples = examples();
    assert!(examples.len() >= 10, "{examples:?}");
    let mut job = String::new();
    for example in examples {
        let command = example
            .replace("localhost:8080", &server.public)
            .replace("localhost:9090", &server.admin)
            .replace("JOB", &job)
            .replacen("curl", "curl --silent --show-error --fail-with-body", 1);
        let ran = Command::new("bash")
            .args(["-c", &command])
            .current_dir(folder.path())
            .output()
            .expect("bash and curl are there");
        let said = String::from_utf8_lossy(&ran.stdout).into_owned();
        let complained = String::from_utf8_lossy(&ran.stderr);
        assert!(ran.status.success(), "{command}: {said}{complained}");
        if let Some(name) = command.split(" -o ").nth(1) {
            let bytes = fs::read(folder.path().join(name)).expect("it was written");
            let flow = read_flow(&bytes, None).expect("a flow").flow;
            assert_eq!(flow.len(), small_pair()[0].len(), "{command}");
            fs::remove_file(folder.path().join(name)).expect("it is ours");
        }
        // Examples that query a job use the pair that was submitted last.
        let view: Value = serde_json::from_str(&said).unwrap_or_default();
        if view["kind"] == "pair" {
            job = view["id"].as_str().unwrap_or_default().to_owned();
        }
    }
}
