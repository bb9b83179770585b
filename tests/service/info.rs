//! Tests of what a server tells of itself: `/v1/info`, the document of its API, the metrics of the
//! machine, traces in the log.

use std::process::Command;

use reqwest::{Client, StatusCode};
use serde_json::{Value, json};

use crate::clouds::{form, small_pair};
use crate::server::Server;

async fn text(url: String) -> String {
    let answer = reqwest::get(url).await.expect("an answer");
    answer.text().await.expect("text")
}

#[tokio::test]
async fn info_has_the_limits_of_the_configuration_and_the_devices_that_compute() {
    let server = Server::with_config(
        "devices = [\"cpu:1\", \"cpu:1\"]\n[limits]\nmax_points = 70000\nmax_sweeps = 9\n\
         max_upload_mib = 3\n",
    );
    let info: Value = serde_json::from_str(&text(server.url("/v1/info")).await).expect("JSON");
    assert_eq!(info["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(info["presets"][0], "default");
    assert_eq!(info["queue"], "sqlite");
    let limits = &info["limits"];
    assert_eq!(limits["max_points"], 70_000);
    assert_eq!(limits["max_sweeps"], 9);
    assert_eq!(limits["max_upload_bytes"], 3 << 20);
    for result in ["flow", "dense"] {
        let first = json!({ "media_type": "application/x-npz", "extension": "npz" });
        assert_eq!(info["formats"][result][0], first);
    }
    // Variables override the file, and the tests' server is started with one for the devices.
    assert_eq!(info["devices"], json!([{ "kind": "cpu", "lanes": 1 }]));
}

#[tokio::test]
async fn the_documentation_has_every_format_and_header_of_a_result() {
    let server = Server::start(&[]);
    let info: Value = serde_json::from_str(&text(server.url("/v1/info")).await).expect("JSON");
    let document = text(server.url("/openapi.json")).await;
    let document: Value = serde_json::from_str(&document).expect("JSON");
    let paths = &document["paths"];
    let flow = &paths["/v1/flow"]["post"]["responses"]["200"];
    let result = &paths["/v1/jobs/{id}/result"]["get"]["responses"]["200"];
    let media_types = |list: &Value| -> Vec<String> {
        let list = list.as_array().expect("formats").iter();
        list.map(|format| format["media_type"].as_str().expect("text").to_owned())
            .collect()
    };
    for media_type in media_types(&info["formats"]["flow"]) {
        for response in [flow, result] {
            assert!(
                response["content"][&media_type]["schema"].is_object(),
                "{media_type}"
            );
        }
        let asked = Client::new()
            .post(server.url("/v1/flow"))
            .header("accept", &media_type)
            .multipart(form(small_pair(), "{}"));
        let answer = asked.send().await.expect("an answer");
        assert_eq!(answer.headers()["content-type"], media_type);
        let own = answer.headers().keys();
        for name in own.filter(|name| name.as_str().starts_with("fnsf-")) {
            let known = flow["headers"].as_object().expect("headers");
            assert!(
                known
                    .keys()
                    .any(|key| key.eq_ignore_ascii_case(name.as_str())),
                "{name}"
            );
        }
    }
    let mut dense = media_types(&info["formats"]["dense"]);
    dense.push("application/zip".to_owned());
    for media_type in dense {
        assert!(
            result["content"][&media_type]["schema"].is_object(),
            "{media_type}"
        );
    }
}

#[tokio::test]
async fn the_metrics_have_the_free_space_and_the_process() {
    let server = Server::start(&[]);
    let url = format!("http://{}/metrics", server.admin);
    let started = std::time::SystemTime::now();
    let started = started.duration_since(std::time::UNIX_EPOCH);
    let started = started.expect("after 1970").as_secs_f64();
    // The free space is measured once a second.
    tokio::time::sleep(std::time::Duration::from_millis(1500)).await;
    let page = text(url).await;
    let value = |name: &str| -> f64 {
        let line = page.lines().find_map(|line| line.strip_prefix(name));
        let value = line.unwrap_or_else(|| panic!("{name} is missing: {page}"));
        value.trim().parse().expect("a number")
    };
    assert!(value("fnsf_data_free_bytes ") > 1e6);
    assert!(value("fnsf_data_free_inodes ") > 1.0);
    assert!(value("process_cpu_seconds_total ") > 0.0);
    let resident = value("process_resident_memory_bytes ");
    let expected = server.resident_bytes() as f64;
    assert!(
        (0.5..2.0).contains(&(resident / expected)),
        "{resident} {expected}"
    );
    assert!((value("process_start_time_seconds ") - started).abs() < 60.0);
    assert!(value("process_threads ") >= 2.0);
    let open = value("process_open_fds ");
    assert!(open > 3.0 && open < value("process_max_fds "));
}

#[tokio::test]
async fn the_log_of_a_request_has_the_trace_of_its_caller() {
    let server = Server::start(&["--log", "fnsf::api=debug,info", "--log-format", "json"]);
    let trace = "0af7651916cd43dd8448eb211c80319c";
    let asked = Client::new()
        .get(server.url("/v1/info"))
        .header("traceparent", format!("00-{trace}-b7ad6b7169203331-01"));
    assert_eq!(asked.send().await.expect("an answer").status(), 200);
    let is_wanted = |line: &&str| line.contains("\"answered\"") && line.contains("/v1/info");
    // The log is written beside the answers.
    server.until("the line of the request", || {
        server.log().lines().any(|line| is_wanted(&line))
    });
    let log = server.log();
    let line = log.lines().find(is_wanted).expect("the line");
    assert!(line.contains(trace), "{line}");
}

#[test]
fn variables_that_kubernetes_sets_for_a_service_named_fnsf_serve_are_no_configuration() {
    let printed = |name: &str, value: &str| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_fnsf"));
        let program = program.args(["serve", "--print-config"]).env(name, value);
        program.output().expect("it runs").status.success()
    };
    for (name, value) in [
        ("SERVICE_HOST", "10.0.0.1"),
        ("SERVICE_PORT", "8080"),
        ("SERVICE_PORT_HTTP", "8080"),
        ("PORT", "tcp://10.0.0.1:8080"),
        ("PORT_8080_TCP", "tcp://10.0.0.1:8080"),
        ("PORT_8080_TCP_PROTO", "tcp"),
        ("PORT_8080_TCP_PORT", "8080"),
        ("PORT_8080_TCP_ADDR", "10.0.0.1"),
    ] {
        assert!(printed(&format!("FNSF_SERVE_{name}"), value), "{name}");
    }
    for (name, value) in [("PORT", "8080"), ("SERVICE", "8080"), ("PORTS_80", "8080")] {
        assert!(!printed(&format!("FNSF_SERVE_{name}"), value), "{name}");
    }
}

#[tokio::test]
async fn the_documentation_names_every_route() {
    let server = Server::start(&[]);
    let document = reqwest::get(server.url("/openapi.json"))
        .await
        .expect("an answer");
    let document: Value = document.json().await.expect("JSON");
    let paths = document["paths"].as_object().expect("paths");
    for (path, methods) in [
        ("/v1/info", vec!["get"]),
        ("/v1/flow", vec!["post"]),
        ("/v1/sequences", vec!["post"]),
        ("/v1/jobs", vec!["get", "post"]),
        ("/v1/jobs/{id}", vec!["delete", "get"]),
        ("/v1/jobs/{id}/requeue", vec!["post"]),
        ("/v1/jobs/{id}/events", vec!["get"]),
        ("/v1/jobs/{id}/result", vec!["get"]),
        ("/v1/jobs/{id}/tracks", vec!["get"]),
        ("/v1/jobs/{id}/scene", vec!["get"]),
        ("/v1/jobs/{id}/sweeps/{index}", vec!["get"]),
        ("/v1/jobs/{id}/share", vec!["post"]),
        ("/v1/queue", vec!["get"]),
        ("/v1/street/{sweep}", vec!["get"]),
    ] {
        let known = paths
            .get(path)
            .unwrap_or_else(|| panic!("{path} is missing"));
        let known: Vec<&String> = known.as_object().expect("methods").keys().collect();
        assert_eq!(known, methods, "{path}");
    }
    assert_eq!(paths.len(), 14);
    let page = reqwest::get(server.url("/docs/")).await.expect("an answer");
    assert_eq!(page.status(), StatusCode::OK);
}
