//! Tests under load: shutdown, overload by a factor of ten, one tenant's flood, and deadlines.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use reqwest::StatusCode;
use serde_json::Value;
use tokio::task::JoinSet;

use crate::clouds::{accepted, form, medium_pair, small_pair};
use crate::server::{Folder, Server, ended, plain_get};

/// A job of a few hundredths of a second.
const SMALL: &str = r#"{"preset": "neural", "max_points": 512}"#;

async fn submit(server: &Server, client: &reqwest::Client, options: &str, key: &str) -> String {
    let mut request = client.post(server.url("/v1/jobs"));
    if !key.is_empty() {
        request = request.bearer_auth(key);
    }
    let sent = request.multipart(form(small_pair(), options)).send().await;
    let sent = sent.expect("an answer");
    assert_eq!(sent.status(), StatusCode::ACCEPTED);
    let job: Value = sent.json().await.expect("a job");
    job["id"].as_str().expect("a name").to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_under_load_loses_nothing_and_ends_in_time_with_open_streams() {
    const DEADLINE: Duration = Duration::from_secs(5);
    let config = "[shutdown]\nreadiness_delay_seconds = 1\ntimeout_seconds = 5\n";
    let folder = Folder::new();
    let mut server = Server::start_in(&folder, config, &[]);
    let client = reqwest::Client::new();
    // One job that runs beyond the shutdown timeout, and a queue behind it.
    let long = client
        .post(server.url("/v1/jobs"))
        .multipart(form(
            medium_pair(),
            r#"{"preset": "paper", "priority": "high"}"#,
        ))
        .send()
        .await
        .expect("an answer");
    let long: Value = long.json().await.expect("a job");
    let mut ids = vec![long["id"].as_str().expect("a name").to_owned()];
    for _ in 0..10 {
        ids.push(submit(&server, &client, SMALL, "").await);
    }
    let mut streams = JoinSet::new();
    for id in ids.iter().cycle().take(50) {
        let url = server.url(&format!("/v1/jobs/{id}/events"));
        let events = client.get(url).send().await.expect("a stream");
        streams.spawn(async move {
            let mut stream = events.bytes_stream();
            while let Some(Ok(_)) = stream.next().await {}
        });
    }
    server.signal("TERM");
    let began = Instant::now();
    while server.is_ready() {
        assert!(
            began.elapsed() < Duration::from_secs(1),
            "it is still ready"
        );
    }
    // Not ready, but requests from a load balancer that has not reacted are still served.
    ids.push(submit(&server, &client, SMALL, "").await);
    let status = server
        .wait(DEADLINE + Duration::from_secs(2))
        .expect("it ends");
    assert!(status.success(), "{status}: {}", server.log());
    assert!(
        began.elapsed() < DEADLINE + Duration::from_millis(500),
        "{:?}",
        began.elapsed()
    );
    while streams.join_next().await.is_some() {}

    let server = Server::start_in(&folder, config, &[]);
    for id in ids {
        assert_eq!(ended(&server, &id).await["state"], "succeeded");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_times_too_much_is_refused_with_a_time_to_come_back_and_health_answers_at_once() {
    /// Seconds of overload. `FNSF_OVERLOAD_SECONDS` overrides it.
    const SECONDS: u64 = 5;
    const CALLERS: usize = 60;
    const MAX_WAIT: Duration = Duration::from_secs(2);
    /// Memory growth that is not a leak: the buffers of sixty connections.
    const GROWTH: u64 = 96 << 20;
    let asked = std::env::var("FNSF_OVERLOAD_SECONDS").ok();
    let seconds = asked
        .and_then(|seconds| seconds.parse().ok())
        .unwrap_or(SECONDS);
    let server = Arc::new(Server::with_config("[limits]\nmax_wait_seconds = 2\n"));
    let client = reqwest::Client::new();
    // The cost model first learns the time of a small job.
    let mut alone = Duration::MAX;
    for _ in 0..10 {
        let asked = Instant::now();
        let sent = client
            .post(server.url("/v1/flow"))
            .multipart(form(small_pair(), SMALL));
        assert_eq!(
            sent.send().await.expect("an answer").status(),
            StatusCode::OK
        );
        alone = alone.min(asked.elapsed());
    }
    let (accepted, refused) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let longest = Arc::new(std::sync::Mutex::new(Duration::ZERO));
    let over = Arc::new(AtomicBool::new(false));
    let before = server.resident_bytes();
    let mut callers = JoinSet::new();
    for _ in 0..CALLERS {
        let (server, client, over) = (Arc::clone(&server), client.clone(), Arc::clone(&over));
        let (accepted, refused) = (Arc::clone(&accepted), Arc::clone(&refused));
        let longest = Arc::clone(&longest);
        callers.spawn(async move {
            while !over.load(Ordering::Relaxed) {
                let began = Instant::now();
                let sent = client
                    .post(server.url("/v1/flow"))
                    .multipart(form(small_pair(), SMALL));
                let answer = sent.send().await.expect("an answer");
                match answer.status() {
                    StatusCode::OK => {
                        accepted.fetch_add(1, Ordering::Relaxed);
                        let mut longest = longest.lock().expect("no panic holds it");
                        *longest = began.elapsed().max(*longest);
                    }
                    StatusCode::SERVICE_UNAVAILABLE => {
                        refused.fetch_add(1, Ordering::Relaxed);
                        let after = answer.headers()["retry-after"].to_str().expect("text");
                        let after: u64 = after.parse().expect("seconds");
                        assert!((1..=60).contains(&after), "{after}");
                        // Much earlier than the server asked for. The load is then about ten times
                        // the capacity.
                        tokio::time::sleep(Duration::from_millis(400 * after)).await;
                    }
                    other => panic!("{other}: {:?}", answer.text().await),
                }
            }
        });
    }
    let (mut slowest, mut most) = (Duration::ZERO, before);
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(seconds) {
        let asked = Instant::now();
        let address = server.admin.clone();
        let alive = tokio::task::spawn_blocking(move || plain_get(&address, "/livez"));
        assert!(alive.await.expect("no panic").is_some());
        slowest = slowest.max(asked.elapsed());
        most = most.max(server.resident_bytes());
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    over.store(true, Ordering::Relaxed);
    while let Some(ended) = callers.join_next().await {
        ended.expect("no caller was disappointed");
    }
    let lasted = began.elapsed();
    let (accepted, refused) = (
        accepted.load(Ordering::Relaxed),
        refused.load(Ordering::Relaxed),
    );
    let longest = *longest.lock().expect("no panic holds it");
    // Queue length ahead of the request that waited longest, at the average throughput. It must be
    // about the number of jobs that fit in the maximum wait, independent of the machine's speed.
    // The throughput is about half of that without load, since refusing requests also takes CPU
    // time. Without admission control all callers would be queued.
    let line = longest.as_secs_f64() * accepted as f64 / lasted.as_secs_f64();
    let fit = MAX_WAIT.as_secs_f64() / alone.as_secs_f64();
    let bound = (3.0 * fit).min(CALLERS as f64 / 2.0);
    println!(
        "{seconds} s: {accepted} accepted, {refused} refused, longest answer {longest:?}, {line:.1} in \
         line where {fit:.1} fit, slowest health {slowest:?}, memory {} to {} MiB",
        before >> 20,
        most >> 20
    );
    assert!(accepted > 0 && refused > 0);
    assert!(line < bound, "{line} in line where {fit} fit");
    assert!(most < before + GROWTH, "{before} to {most}");
}

const KEYS: &str = r#"
[[keys]]
tenant = "many"
role = "write"
key = "the key of many jobs"
[[keys]]
tenant = "few"
role = "write"
key = "the key of few jobs!"
"#;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_tenant_with_few_jobs_waits_for_two_of_the_others_at_most() {
    /// Number of queued jobs. `FNSF_FLOOD` overrides it.
    const FLOOD: usize = 120;
    let asked = std::env::var("FNSF_FLOOD").ok();
    let flood = asked.and_then(|flood| flood.parse().ok()).unwrap_or(FLOOD);
    let server = Arc::new(Server::with_config(KEYS));
    let client = reqwest::Client::new();
    let mut senders = JoinSet::new();
    for sender in 0..8 {
        let (server, client) = (Arc::clone(&server), client.clone());
        senders.spawn(async move {
            for _ in (sender..flood).step_by(8) {
                submit(&server, &client, SMALL, "the key of many jobs").await;
            }
        });
    }
    while let Some(sent) = senders.join_next().await {
        sent.expect("accepted");
    }
    let mut few = Vec::new();
    for _ in 0..10 {
        few.push(submit(&server, &client, SMALL, "the key of few jobs!").await);
    }
    let mut starts: Vec<String> = Vec::new();
    for id in &few {
        let url = server.url(&format!("/v1/jobs/{id}?wait=60"));
        let job = client
            .get(url)
            .bearer_auth("the key of few jobs!")
            .send()
            .await;
        let job: Value = job.expect("an answer").json().await.expect("a job");
        assert_eq!(job["state"], "succeeded", "{job}");
        starts.push(job["started_at"].as_str().expect("a time").to_owned());
    }
    let mut others: Vec<String> = Vec::new();
    let mut before = String::new();
    loop {
        let url = server.url(&format!("/v1/jobs?limit=1000{before}"));
        let page = client
            .get(url)
            .bearer_auth("the key of many jobs")
            .send()
            .await;
        let page: Value = page.expect("an answer").json().await.expect("a page");
        let started = page["jobs"].as_array().expect("jobs").iter();
        others.extend(started.filter_map(|job| Some(job["started_at"].as_str()?.to_owned())));
        match page["next"].as_str() {
            Some(next) => before = format!("&before={next}"),
            None => break,
        }
    }
    let mut most = 0;
    for (earlier, later) in starts.iter().zip(&starts[1..]) {
        let between = others
            .iter()
            .filter(|start| *start >= earlier && *start < later);
        most = most.max(between.count());
    }
    println!("{flood} jobs queued; at most {most} of them between two of the few's");
    assert!(most <= 2, "{most} of the others between two of the few's");
    assert!(
        others.len() < flood,
        "the flood was over before: nothing was shown"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_deadline_in_the_queue_ends_the_job_while_every_device_is_busy() {
    let server = Server::start(&[]);
    let client = reqwest::Client::new();
    let busy = client.post(server.url("/v1/jobs")).multipart(form(
        medium_pair(),
        r#"{"preset": "paper", "priority": "high"}"#,
    ));
    let busy = accepted(busy).await;
    let began = Instant::now();
    let late = client.post(server.url("/v1/flow")).multipart(form(
        small_pair(),
        r#"{"deadline_ms": 300, "priority": "low"}"#,
    ));
    let answer = late.send().await.expect("an answer");
    let waited = began.elapsed();
    assert_eq!(answer.status(), StatusCode::GATEWAY_TIMEOUT);
    let problem: Value = answer.json().await.expect("a problem");
    assert_eq!(problem["code"], "deadline_in_queue");
    assert!(waited < Duration::from_secs(3), "{waited:?}");
    let id = busy["id"].as_str().expect("a name");
    client
        .delete(server.url(&format!("/v1/jobs/{id}")))
        .send()
        .await
        .expect("an answer");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn small_jobs_do_not_wait_behind_a_long_one_while_another_device_is_free() {
    let server = Server::start(&["--device", "cpu:1", "--device", "cpu:1"]);
    let client = reqwest::Client::new();
    let long = client
        .post(server.url("/v1/jobs"))
        .multipart(form(medium_pair(), r#"{"preset": "paper"}"#));
    let long = accepted(long).await;
    let id = long["id"].as_str().expect("a name");
    for _ in 0..5 {
        let small = client
            .post(server.url("/v1/flow"))
            .multipart(form(small_pair(), SMALL));
        assert_eq!(
            small.send().await.expect("an answer").status(),
            StatusCode::OK
        );
    }
    let job: Value = reqwest::get(server.url(&format!("/v1/jobs/{id}")))
        .await
        .expect("an answer")
        .json()
        .await
        .expect("a job");
    assert_eq!(
        job["state"], "running",
        "the long one was over before: nothing was shown"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_number_of_series_does_not_grow_with_the_jobs() {
    /// Number of jobs. `FNSF_FLOOD` overrides it.
    const FLOOD: usize = 60;
    let asked = std::env::var("FNSF_FLOOD").ok();
    let flood = asked.and_then(|flood| flood.parse().ok()).unwrap_or(FLOOD);
    let server = Server::start(&[]);
    let client = reqwest::Client::new();
    let mut counts = Vec::new();
    let mut asked_for = 0;
    for jobs in [0, 30, flood] {
        for _ in asked_for..jobs {
            submit(
                &server,
                &client,
                r#"{"preset": "neural", "max_points": 16}"#,
                "",
            )
            .await;
        }
        asked_for = jobs;
        let began = Instant::now();
        let patience = Duration::from_secs(60) + Duration::from_millis(100) * jobs as u32;
        while server.metric("fnsf_jobs_finished_total") < jobs as f64 {
            assert!(began.elapsed() < patience, "{jobs} jobs take too long");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let page = plain_get(&server.admin, "/metrics").expect("metrics");
        let body = page.split("\r\n\r\n").nth(1).expect("a body");
        counts.push(body.lines().filter(|line| !line.starts_with('#')).count());
    }
    println!("series: {counts:?}");
    assert!(counts.iter().all(|count| *count == counts[0]), "{counts:?}");
    assert!(counts[0] > 100);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_asked_for_again_is_admitted_as_what_is_new() {
    let config = "[limits]\nmax_queue_seconds = 20\nmax_tenant_queue_seconds = 20\n";
    let server = Server::with_config(config);
    let client = reqwest::Client::new();
    let mut ids = Vec::new();
    // Filled and cancelled several times, so that there are more jobs than the queue admits.
    for _ in 0..3 {
        let mut refused = false;
        while !refused {
            let sent = client
                .post(server.url("/v1/jobs"))
                .multipart(form(medium_pair(), r#"{"preset": "paper"}"#))
                .send();
            let answer = sent.await.expect("an answer");
            refused = !answer.status().is_success();
            if !refused {
                let job: Value = answer.json().await.expect("a job");
                ids.push(job["id"].as_str().expect("a name").to_owned());
            }
        }
        for id in &ids {
            let url = server.url(&format!("/v1/jobs/{id}"));
            client.delete(url).send().await.expect("an answer");
        }
        for id in &ids {
            ended(&server, id).await;
        }
    }
    let mut refused = 0;
    for id in &ids {
        let url = server.url(&format!("/v1/jobs/{id}/requeue"));
        let answer = client.post(url).send().await.expect("an answer");
        if answer.status() == StatusCode::TOO_MANY_REQUESTS {
            assert!(answer.headers().contains_key("retry-after"));
            refused += 1;
        }
    }
    assert!(refused > 0, "all {} are queued again", ids.len());
    assert!(server.metric("fnsf_queue_work_seconds") <= 20.5);
}
