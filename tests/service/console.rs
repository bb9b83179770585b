//! Tests of the console's files, and of the routes below it: scenes, sweeps, share links, the queue,
//! labels and the street.

use fnsf::flow::Point;
use fnsf::formats::read_cloud;
use reqwest::{Client, Method, Response};
use serde_json::{Value, json};

use crate::clouds::{accepted, form, small_pair};
use crate::raw_http::SMALL;
use crate::server::Server;

const WRITER: &str = "key-of-the-writer-of-a";
const OPERATOR: &str = "key-of-the-operator";
const OTHER: &str = "key-of-the-writer-of-b";

fn guarded() -> Server {
    let mut config = String::new();
    for (tenant, role, key) in [
        ("a", "write", WRITER),
        ("operators", "operate", OPERATOR),
        ("b", "write", OTHER),
    ] {
        config += &format!("[[keys]]\ntenant = \"{tenant}\"\nrole = \"{role}\"\nkey = \"{key}\"\n");
    }
    Server::with_config(&config)
}

async fn ask(server: &Server, method: Method, path: &str, key: &str) -> Response {
    let request = Client::new().request(method, server.url(path));
    let request = if key.is_empty() {
        request
    } else {
        request.bearer_auth(key)
    };
    request.send().await.expect("an answer")
}

async fn get(server: &Server, path: &str, key: &str) -> Response {
    ask(server, Method::GET, path, key).await
}

async fn get_json(server: &Server, path: &str, key: &str) -> Value {
    get(server, path, key).await.json().await.expect("JSON")
}

/// The code of a refusal.
async fn refusal(answer: Response) -> String {
    let status = answer.status();
    let problem: Value = answer.json().await.expect("a problem");
    assert_eq!(problem["status"], status.as_u16());
    problem["code"].as_str().unwrap_or_default().to_owned()
}

/// Submits the small pair and waits for its end. Returns the job.
async fn finished(server: &Server, key: &str, options: &str) -> Value {
    let mut request = Client::new()
        .post(server.url("/v1/jobs"))
        .multipart(form(small_pair(), options));
    if !key.is_empty() {
        request = request.bearer_auth(key);
    }
    let job = accepted(request).await;
    let id = job["id"].as_str().expect("an id");
    let job = get_json(server, &format!("/v1/jobs/{id}?wait=60"), key).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    job
}

#[tokio::test]
async fn the_console_needs_no_key_and_loads_nothing_from_elsewhere() {
    let server = guarded();
    let page = get(&server, "/", "").await;
    assert_eq!(page.status(), 200);
    let policy = page.headers()["content-security-policy"].to_str();
    let policy = policy.expect("text").to_owned();
    for directive in [
        "default-src 'none'",
        "script-src 'self'",
        "frame-ancestors 'none'",
    ] {
        assert!(policy.contains(directive), "{policy}");
    }
    assert!(!policy.contains("unsafe"), "{policy}");
    let tag = page.headers()["etag"].clone();
    let text = page.text().await.expect("text");
    let addresses = text
        .split(['"', '\''])
        .filter(|part| part.contains("/console/"));
    let addresses: Vec<&str> = addresses.collect();
    assert!(addresses.len() >= 4, "{text}");
    for address in addresses {
        let asset = get(&server, address, "").await;
        assert_eq!(asset.status(), 200, "{address}");
        assert!(asset.headers().contains_key("content-security-policy"));
    }
    let again = Client::new()
        .get(server.url("/"))
        .header("if-none-match", tag);
    assert_eq!(again.send().await.expect("an answer").status(), 304);
    assert_eq!(get(&server, "/v1/jobs", "").await.status(), 401);
    assert_eq!(get(&server, "/console/nothing.js", "").await.status(), 404);
}

#[tokio::test]
async fn a_server_without_the_console_answers_no_page() {
    let server = Server::start(&["--no-console"]);
    for path in ["/", "/console/main.js"] {
        assert_eq!(refusal(get(&server, path, "").await).await, "no_route");
    }
    assert_eq!(get(&server, "/v1/info", "").await.status(), 200);
}

#[tokio::test]
async fn the_sweeps_of_a_job_come_back_as_they_were_sent() {
    let server = Server::start(&[]);
    let job = finished(&server, "", SMALL).await;
    let path = job["links"]["self"].as_str().expect("a path");
    let scene = get_json(&server, &format!("{path}/scene"), "").await;
    assert_eq!(scene["pairs"][0]["state"], "succeeded");
    assert_eq!(scene["pairs"][0]["flow"], format!("{path}/result"));
    assert_eq!(scene["tracks"], Value::Null);
    for (index, sent) in small_pair().iter().enumerate() {
        let address = scene["sweeps"][index].as_str().expect("a path");
        let bytes = get(&server, address, "")
            .await
            .bytes()
            .await
            .expect("bytes");
        assert_eq!(fnsf::payload::points_from_le_bytes(&bytes), *sent);
    }
    let beyond = get(&server, &format!("{path}/sweeps/2"), "").await;
    assert_eq!(refusal(beyond).await, "no_sweep");
    let nonsense = get(&server, &format!("{path}/sweeps/-1"), "").await;
    assert_eq!(refusal(nonsense).await, "no_sweep");
}

#[tokio::test]
async fn a_share_link_shows_one_job_and_nothing_else_until_it_expires() {
    let server = guarded();
    let job = finished(&server, WRITER, SMALL).await;
    let other = finished(&server, WRITER, SMALL).await;
    let path = job["links"]["self"].as_str().expect("a path");
    let other = other["links"]["self"].as_str().expect("a path");
    let link = ask(
        &server,
        Method::POST,
        &format!("{path}/share?seconds=600"),
        WRITER,
    )
    .await;
    let link: Value = link.json().await.expect("JSON");
    let token = link["token"].as_str().expect("a token");
    for below in ["", "/scene", "/sweeps/1", "/result"] {
        let answer = get(&server, &format!("{path}{below}"), token).await;
        assert_eq!(answer.status(), 200, "{below}");
    }
    assert_eq!(refusal(get(&server, other, token).await).await, "not_found");
    for (method, path) in [
        (Method::GET, "/v1/jobs".to_owned()),
        (Method::GET, "/v1/queue".to_owned()),
        (Method::GET, "/v1/street/0".to_owned()),
        (Method::DELETE, path.to_owned()),
        (Method::POST, format!("{path}/requeue")),
        (Method::POST, format!("{path}/share")),
    ] {
        let answer = ask(&server, method, &path, token).await;
        assert_eq!(refusal(answer).await, "forbidden", "{path}");
    }
    let foreign = ask(&server, Method::POST, &format!("{path}/share"), OTHER).await;
    assert_eq!(refusal(foreign).await, "not_found");
    for seconds in ["0", "7776001", "x"] {
        let terms = format!("{path}/share?seconds={seconds}");
        let refused = ask(&server, Method::POST, &terms, WRITER).await;
        assert_eq!(refusal(refused).await, "bad_request");
    }
    let short = ask(
        &server,
        Method::POST,
        &format!("{path}/share?seconds=1"),
        WRITER,
    )
    .await;
    let short: Value = short.json().await.expect("JSON");
    tokio::time::sleep(std::time::Duration::from_millis(1100)).await;
    let expired = get(&server, path, short["token"].as_str().expect("a token")).await;
    assert_eq!(expired.status(), 401);
    assert_eq!(refusal(expired).await, "link_expired");
}

#[tokio::test]
async fn jobs_are_listed_by_label() {
    let server = Server::start(&[]);
    let name = "<img src=x onerror=alert(1)>";
    let labelled = json!({ "max_points": 500, "labels": { "drive": name } }).to_string();
    let job = finished(&server, "", &labelled).await;
    finished(&server, "", SMALL).await;
    assert_eq!(job["options"]["labels"]["drive"], name);
    let url = server.url("/v1/jobs");
    let listed = |label: String| {
        let mut address: url::Url = url.parse().expect("an address");
        address.query_pairs_mut().append_pair("label", &label);
        let request = Client::new().get(address);
        async move {
            let page: Value = request
                .send()
                .await
                .expect("an answer")
                .json()
                .await
                .expect("JSON");
            page["jobs"].as_array().expect("jobs").clone()
        }
    };
    let found = listed(format!("drive={name}")).await;
    assert_eq!(found.len(), 1);
    assert_eq!(found[0]["id"], job["id"]);
    assert_eq!(listed("drive=another".to_owned()).await.len(), 0);
    let wrong = json!({ "labels": { "a b": "x" } }).to_string();
    let refused = Client::new()
        .post(&url)
        .multipart(form(small_pair(), &wrong));
    let refused = refused.send().await.expect("an answer");
    assert_eq!(refusal(refused).await, "invalid_options");
}

#[tokio::test]
async fn callers_see_their_part_of_the_queue_and_operators_all_of_it() {
    let server = guarded();
    // The paper's method occupies the one lane for a while.
    let slow = json!({ "preset": "paper", "field": { "max_iterations": 100_000 } }).to_string();
    for key in [WRITER, OTHER, OTHER] {
        let sent = Client::new()
            .post(server.url("/v1/jobs"))
            .bearer_auth(key)
            .multipart(form(small_pair(), &slow));
        assert_eq!(sent.send().await.expect("an answer").status(), 202);
    }
    let tenants = |view: &Value| -> Vec<String> {
        let rows = view["queued"].as_array().expect("rows").iter();
        rows.map(|row| row["tenant"].as_str().unwrap_or_default().to_owned())
            .collect()
    };
    let seen = get_json(&server, "/v1/queue", OTHER).await;
    assert!(tenants(&seen).iter().all(|tenant| tenant == "b"), "{seen}");
    assert_eq!(seen["nodes"], Value::Null);
    assert_eq!(seen["operates"], false);
    let all = get_json(&server, "/v1/queue", OPERATOR).await;
    assert_eq!(all["operates"], true);
    assert_eq!(all["devices"][0]["kind"], "cpu");
    assert_eq!(all["nodes"][0]["is_this"], true);
    let jobs = all["total"]["jobs"].as_u64().expect("a number");
    let running = all["running"]["jobs"].as_u64().expect("a number");
    assert_eq!(jobs + running, 3, "{all}");
    let waits = all["queued"][0]["wait_seconds"].as_f64();
    assert!(waits.is_some_and(|seconds| seconds > 0.0), "{all}");
}

#[tokio::test]
async fn the_street_is_a_cloud_that_the_server_takes() {
    let server = Server::start(&[]);
    let sweep = get(&server, "/v1/street/0?seed=7", "").await;
    let bytes = sweep.bytes().await.expect("bytes");
    let cloud = read_cloud(&bytes, Some("street.pcd")).expect("a cloud");
    assert!(cloud.points.len() > 100_000);
    let first: Point = cloud.points[0];
    assert!(first.iter().all(|value| value.is_finite()));
    for path in ["/v1/street/50", "/v1/street/0?sead=1", "/v1/street/x"] {
        assert_eq!(refusal(get(&server, path, "").await).await, "bad_request");
    }
}
