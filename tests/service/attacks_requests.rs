//! Attacks by text: job ids, options, and forged log lines.

use fnsf::formats::CloudFormat;
use reqwest::multipart::{Form, Part};
use reqwest::{Method, StatusCode};
use serde_json::Value;

use crate::clouds::{file, form, small_pair};
use crate::grpc::proto::ListJobsRequest;
use crate::raw_http::{Besieged, SMALL, exchange, multipart, post, status};
use crate::server::Server;

#[tokio::test]
async fn a_name_that_is_no_jobs_is_not_found_whatever_it_holds() {
    let siege = Besieged::new("").await;
    let long = "a".repeat(30_000);
    let names = [
        "..%2f..%2f..%2fetc%2fpasswd",
        "..%5c..%5cqueue.db",
        "%2e%2e",
        "..",
        ".",
        "%00",
        "%0d%0aset-cookie:%20a=b",
        "%ff%fe",
        "%",
        "0192f0c1-7b7a-7000-8000-00000000000g",
        "0192f0c17b7a70008000000000000000",
        "0192f0c1-7b7a-7000-8000-000000000000%20",
        "{0192f0c1-7b7a-7000-8000-000000000000}",
        "urn:uuid:0192f0c1-7b7a-7000-8000-000000000000",
        "'; drop table jobs; --",
        "\u{1f980}",
        long.as_str(),
    ];
    for name in names {
        for (method, rest) in [
            ("GET", ""),
            ("DELETE", ""),
            ("POST", "/requeue"),
            ("GET", "/events"),
            ("GET", "/result"),
            ("GET", "/scene"),
            ("GET", "/sweeps/0"),
            ("POST", "/share"),
        ] {
            let name = name.replace(' ', "%20");
            let head = "host: localhost\r\nconnection: close\r\n\r\n";
            let request = format!("{method} /v1/jobs/{name}{rest} HTTP/1.1\r\n{head}");
            let answer = exchange(&siege.server, request.as_bytes());
            let short = name.chars().take(60).collect::<String>();
            if status(&answer) == Some(400) {
                // Not a valid HTTP request: the path contains bytes that no path may contain.
                assert!(
                    !name.is_ascii() || name.contains(['{', '\'']),
                    "{short}: {answer}"
                );
                continue;
            }
            assert_eq!(
                status(&answer),
                Some(404),
                "{method} {short}{rest}: {answer}"
            );
            assert!(
                answer.contains("application/problem+json"),
                "{short}: {answer}"
            );
            assert!(!answer.contains("set-cookie"), "{answer}");
        }
    }
    for query in ["?wait=-1", "?wait=x", "?nonsense=1", "?wait=1&wait=2"] {
        let url = format!("/v1/jobs/0192f0c1-7b7a-7000-8000-000000000000{query}");
        let answer = reqwest::get(siege.server.url(&url))
            .await
            .expect("an answer");
        assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{query}");
    }
    for (query, expected) in [
        ("?limit=0", 200),
        ("?limit=4294967295", 200),
        ("?limit=4294967296", 400),
        ("?limit=-1", 400),
        ("?state=broken", 400),
        ("?before=..%2f..", 400),
        ("?offset=1", 400),
    ] {
        let url = siege.server.url(&format!("/v1/jobs{query}"));
        let answer = reqwest::get(url).await.expect("an answer");
        assert_eq!(answer.status(), expected, "{query}");
    }
    siege.stands().await;
}

#[tokio::test]
async fn options_that_are_deep_huge_doubled_or_wrong_are_refused_by_name() {
    let siege = Besieged::new("").await;
    let deep = |open: &str| format!(r#"{{"ego": {}"#, open.repeat(10_000));
    let large = format!(r#"{{"device": "{}"}}"#, "a".repeat(100 << 10));
    for (options, expected) in [
        (deep("["), 400),
        (deep("{\"a\":"), 400),
        (deep("[").replacen("ego", "unknown", 1), 400),
        (large, 413),
        (String::new(), 400),
        ("null".to_owned(), 400),
        ("[]".to_owned(), 400),
        ("{} {}".to_owned(), 400),
        (r#"{"seed": 1, "seed": 2}"#.to_owned(), 400),
        (r#"{"seed": 18446744073709551616}"#.to_owned(), 400),
        (r#"{"seed": -1}"#.to_owned(), 400),
        (r#"{"seed": 1e400}"#.to_owned(), 400),
        (r#"{"max_points": 4294967296}"#.to_owned(), 400),
        (r#"{"max_points": 0}"#.to_owned(), 400),
        (r#"{"max_points": 1e9}"#.to_owned(), 400),
        (r#"{"crop_m": 1e39}"#.to_owned(), 400),
        (r#"{"crop_m": -1}"#.to_owned(), 400),
        (r#"{"crop_m": NaN}"#.to_owned(), 400),
        (r#"{"min_range_m": 0}"#.to_owned(), 400),
        (r#"{"deadline_ms": 18446744073709551615}"#.to_owned(), 400),
        (r#"{"deadline_ms": 0}"#.to_owned(), 400),
        (
            r#"{"ego": [[1e308,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#.to_owned(),
            400,
        ),
        (
            r#"{"ego": [[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0]]}"#.to_owned(),
            400,
        ),
        (r#"{"preset": "\u0000"}"#.to_owned(), 400),
        (r#"{"iterations": 1000000000}"#.to_owned(), 400),
        (r#"{"layers": 1000000000}"#.to_owned(), 400),
        (r#"{"hidden": 1000000000}"#.to_owned(), 400),
        (format!("{}{SMALL}", " ".repeat(60 << 10)), 200),
    ] {
        let answer = reqwest::Client::new()
            .post(siege.server.url("/v1/flow"))
            .multipart(form(small_pair(), &options))
            .send()
            .await
            .expect("an answer");
        let short = options.chars().take(60).collect::<String>();
        assert_eq!(answer.status(), expected, "{short}");
        if expected != 200 {
            let problem: Value = answer.json().await.expect("a problem");
            assert!(
                !problem["detail"].as_str().unwrap_or_default().is_empty(),
                "{problem}"
            );
        }
    }
    let twice = form(small_pair(), SMALL).text("options", SMALL);
    let answer = reqwest::Client::new()
        .post(siege.server.url("/v1/flow"))
        .multipart(twice)
        .send()
        .await
        .expect("an answer");
    assert_eq!(answer.status(), StatusCode::BAD_REQUEST);
    for prefer in [
        "wait=18446744073709551615",
        "wait=99999999999999999999",
        "wait=-1",
        "=;,=,",
    ] {
        let answer = reqwest::Client::new()
            .post(siege.server.url("/v1/flow"))
            .header("prefer", prefer)
            .multipart(form(small_pair(), SMALL))
            .send()
            .await
            .expect("an answer");
        assert_eq!(answer.status(), StatusCode::OK, "{prefer}");
    }
    siege.stands().await;
}

#[tokio::test]
async fn nothing_that_a_client_sends_forges_a_line_of_the_log() {
    const FORGED: &str = r#"{"level":"ERROR","message":"forged"}"#;
    let hostile = format!("a\r\n{FORGED}\n\u{1b}[31m\u{7}\u{202e}b");
    for format in ["json", "human"] {
        let arguments = ["--log-format", format, "--log", "fnsf=trace,debug"];
        let siege = Besieged::with("", &arguments).await;
        let bytes = file(CloudFormat::Npy, &small_pair()[0]);
        let named = |bytes: &[u8]| Part::bytes(bytes.to_vec()).file_name(hostile.clone());
        let pair = |source: &[u8]| {
            Form::new()
                .part("source", named(source))
                .part("target", named(&bytes))
        };
        for path in ["/v1/flow", "/v1/jobs"] {
            for body in [
                pair(&bytes).text("options", SMALL),
                pair(&[7; 100]),
                Form::new().text(hostile.clone(), hostile.clone()),
                Form::new().text("options", hostile.clone()),
                Form::new().text("options", format!("{{{hostile:?}: 1}}")),
            ] {
                let client = reqwest::Client::new();
                let sent = client.post(siege.server.url(path)).multipart(body).send();
                assert!(!sent.await.expect("an answer").status().is_server_error());
            }
        }
        let [source, target] = small_pair()
            .each_ref()
            .map(|points| file(CloudFormat::Npy, points));
        let body = multipart(&[
            ("options", SMALL.as_bytes()),
            ("source", &source),
            ("target", &target),
        ]);
        for key in [
            "\"level\":\"ERROR\"",
            "a\u{1b}[31mb",
            "a\tb",
            "\u{e9}\u{202e}",
        ] {
            let mut bytes = post(
                "/v1/jobs?a=%0a%7b%22level%22",
                &format!(
                    "idempotency-key: {key}\r\nconnection: close\r\ncontent-length: {}\r\n\r\n",
                    body.len()
                ),
            )
            .into_bytes();
            bytes.extend(&body);
            assert!(
                status(&exchange(&siege.server, &bytes)).is_some(),
                "{key:?}"
            );
        }
        siege.stands().await;
        let log = siege.server.log();
        let whole = log.rsplit_once('\n').map_or("", |(whole, _)| whole);
        assert!(whole.lines().count() > 10, "nothing is logged");
        for line in whole.lines() {
            assert!(
                !line.starts_with(FORGED) && !line.contains('\u{1b}'),
                "{line:?}"
            );
            if format == "json" {
                let entry: Value = serde_json::from_str(line).expect(line);
                assert!(
                    entry["level"].is_string() && entry["message"] != "forged",
                    "{line}"
                );
            }
        }
    }
}

#[tokio::test]
async fn keys_are_never_logged_nor_printed() {
    const KEY: &str = "correct-horse-battery-staple";
    const WRONG: &str = "wrong-horse-battery-staple";
    let config = format!("[[keys]]\ntenant = \"a\"\nrole = \"write\"\nkey = \"{KEY}\"\n");
    let folder = crate::server::Folder::new();
    let server = Server::start_in(&folder, &config, &["--log", "debug,fnsf=trace"]);
    for key in [KEY, WRONG] {
        for method in [Method::GET, Method::POST] {
            let sent = reqwest::Client::new().request(method, server.url("/v1/jobs"));
            let answer = sent.bearer_auth(key).send().await.expect("an answer");
            let body = answer.text().await.expect("text");
            assert!(!body.contains("horse"), "{body}");
        }
        let mut asked = tonic::Request::new(ListJobsRequest::default());
        let shown = format!("Bearer {key}").parse().expect("plain text");
        asked.metadata_mut().insert("authorization", shown);
        let listed = crate::grpc::client(&server).await.list_jobs(asked).await;
        assert_eq!(listed.is_ok(), key == KEY);
    }
    let log = server.log();
    assert!(log.contains("answered") && !log.contains("horse"), "{log}");
    let printed = std::process::Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(["serve", "--print-config", "--config"])
        .arg(folder.path().join("fnsf.toml"))
        .env("FNSF_SERVE_API_KEY", WRONG)
        .output()
        .expect("it runs");
    let said = String::from_utf8_lossy(&printed.stdout).into_owned();
    assert!(
        printed.status.success() && said.contains("tenant = \"a\""),
        "{said}"
    );
    let all = said + &String::from_utf8_lossy(&printed.stderr);
    assert!(!all.contains("horse"), "{all}");
}
