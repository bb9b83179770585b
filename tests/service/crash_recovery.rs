//! Tests with a process that is killed at random times: every acknowledged job ends exactly once.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use fnsf::formats::CloudFormat;
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde_json::Value;

use crate::clouds::{file, form, medium_pair, small_pair};
use crate::server::{Folder, Server, ended};

/// Default number of kills. `FNSF_KILLS` overrides it.
const KILLS: usize = 12;
/// Jobs submitted per kill.
const JOBS_A_KILL: usize = 3;

/// Short retries and frequent snapshots, so that kills hit every stage of a job.
const CONFIG: &str =
    "[queue]\nretry_delay_seconds = 1\nsnapshot_interval_ms = 50\nmax_crashes = 40\n";

/// A deterministic random number generator (SplitMix64).
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (mixed ^ (mixed >> 31)) % limit
    }
}

/// The options of job `job`: a few kinds of small jobs, the same in every run.
pub(crate) fn options(job: usize) -> String {
    let seed = job % 7;
    match job % 5 {
        0 => format!(r#"{{"seed": {seed}, "preset": "paper", "max_points": 1024}}"#),
        1 => format!(r#"{{"seed": {seed}, "max_points": 512}}"#),
        _ => format!(r#"{{"seed": {seed}, "preset": "neural", "max_points": 512}}"#),
    }
}

async fn submit(server: &Server, client: &reqwest::Client, job: usize) -> Option<String> {
    let sent = client
        .post(server.url("/v1/jobs"))
        .header("idempotency-key", format!("job-{job}"))
        .multipart(form(small_pair(), &options(job)))
        .send()
        .await
        .ok()?;
    if !matches!(sent.status(), StatusCode::ACCEPTED | StatusCode::OK) {
        panic!("job {job} was refused: {:?}", sent.text().await);
    }
    // A job counts as acknowledged once the response has arrived completely.
    let view: Value = sent.json().await.ok()?;
    Some(view["id"].as_str()?.to_owned())
}

async fn fetch(server: &Server, client: &reqwest::Client, id: &str) -> Vec<u8> {
    let url = server.url(&format!("/v1/jobs/{id}/result"));
    let answer = client.get(url).send().await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::OK, "{id}");
    answer.bytes().await.expect("a body").to_vec()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_acknowledged_job_ends_once_with_the_undisturbed_result_however_often_it_is_killed() {
    let asked = std::env::var("FNSF_KILLS")
        .ok()
        .and_then(|kills| kills.parse().ok());
    let kills: usize = asked.unwrap_or(KILLS);
    let jobs = kills * JOBS_A_KILL;
    let mut dice = Dice(2026);
    let folder = Folder::new();
    let mut acknowledged: HashMap<usize, String> = HashMap::new();
    let mut next = 0;
    for _ in 0..kills {
        let server = Server::start_in(&folder, CONFIG, &[]);
        let client = reqwest::Client::new();
        // The kill may come while jobs are being submitted or later.
        let batch = JOBS_A_KILL.min(jobs - next);
        let life = Duration::from_millis(20 + dice.below(700));
        // Stored outside the future, which the timeout drops.
        let kept = std::sync::Mutex::new(Vec::new());
        let sending = async {
            for job in next..next + batch {
                if let Some(id) = submit(&server, &client, job).await {
                    kept.lock().expect("no panic holds it").push((job, id));
                }
            }
            std::future::pending::<()>().await;
        };
        let _killed = tokio::time::timeout(life, sending).await;
        server.kill();
        for (job, id) in kept.into_inner().expect("no panic holds it") {
            let known = acknowledged.insert(job, id.clone());
            assert!(
                known.is_none_or(|known| known == id),
                "job {job} has two names"
            );
        }
        next += batch;
    }

    let server = Server::start_in(&folder, CONFIG, &[]);
    let client = reqwest::Client::new();
    // Jobs that were not acknowledged are submitted again. The others must keep their ids.
    for job in 0..jobs {
        let id = submit(&server, &client, job).await.expect("it lives");
        let known = acknowledged.insert(job, id.clone());
        assert!(
            known.is_none_or(|known| known == id),
            "job {job} was lost or repeated"
        );
    }
    let listed = list_all(&server, &client).await;
    assert_eq!(listed, jobs, "there are jobs that nobody asked for");

    let ids: Vec<_> = (0..jobs).map(|job| acknowledged[&job].clone()).collect();
    let attempts = end_undisturbed(&server, &client, &ids).await;
    println!("{kills} kills, {jobs} jobs, {attempts} attempts");
}

/// Waits until these jobs have succeeded, and compares their flows with those of an undisturbed run.
/// The ids are in the order of the jobs' numbers. Returns the number of attempts.
pub(crate) async fn end_undisturbed(
    server: &Server,
    client: &reqwest::Client,
    ids: &[String],
) -> u64 {
    let mut attempts = 0;
    for id in ids {
        let view = ended(server, id).await;
        assert_eq!(view["state"], "succeeded", "{view}");
        attempts += view["attempt"].as_u64().expect("a number");
    }
    let mut undisturbed: HashMap<String, Vec<u8>> = HashMap::new();
    for (job, id) in ids.iter().enumerate() {
        let expected = undisturbed.entry(options(job)).or_default();
        if expected.is_empty() {
            let sent = client
                .post(server.url("/v1/flow"))
                .multipart(form(small_pair(), &options(job)))
                .send()
                .await
                .expect("an answer");
            assert_eq!(sent.status(), StatusCode::OK);
            *expected = sent.bytes().await.expect("a body").to_vec();
        }
        let found = fetch(server, client, id).await;
        assert!(found == *expected, "job {job} is another flow");
    }
    attempts
}

/// The number of durable jobs in the server's list.
pub(crate) async fn list_all(server: &Server, client: &reqwest::Client) -> usize {
    let (mut count, mut before) = (0, String::new());
    loop {
        let url = server.url(&format!("/v1/jobs?limit=500{before}"));
        let page: Value = client
            .get(url)
            .send()
            .await
            .expect("an answer")
            .json()
            .await
            .expect("JSON");
        let jobs = page["jobs"].as_array().expect("jobs");
        count += jobs.len();
        match page["next"].as_str() {
            Some(next) => before = format!("&before={next}"),
            None => return count,
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_job_goes_on_from_its_snapshot() {
    let folder = Folder::new();
    let server = Server::start_in(&folder, CONFIG, &[]);
    let client = reqwest::Client::new();
    let body = || {
        let part = |cloud: usize| Part::bytes(file(CloudFormat::Npy, &medium_pair()[cloud]));
        Form::new()
            .part("source", part(0))
            .part("target", part(1))
            .text("options", r#"{"preset": "paper", "max_points": 8192}"#)
    };
    let sent = client
        .post(server.url("/v1/jobs"))
        .multipart(body())
        .send()
        .await;
    let view: Value = sent.expect("an answer").json().await.expect("a job");
    let id = view["id"].as_str().expect("a name").to_owned();
    let began = Instant::now();
    while server.metric("fnsf_snapshots_written_total") < 3.0 {
        assert!(
            began.elapsed() < Duration::from_secs(60),
            "no snapshot: {}",
            server.log()
        );
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    server.kill();
    let server = Server::start_in(&folder, CONFIG, &[]);
    let view = ended(&server, &id).await;
    assert_eq!(
        (&view["state"], &view["attempt"]),
        (&"succeeded".into(), &2.into())
    );
    assert!((server.metric("fnsf_jobs_resumed_total") - 1.0).abs() < f64::EPSILON);
    assert!(server.log().contains("resumed"), "{}", server.log());
    let whole = client
        .post(server.url("/v1/flow"))
        .multipart(body())
        .send()
        .await;
    let whole = whole.expect("an answer").bytes().await.expect("a body");
    assert!(
        fetch(&server, &client, &id).await == whole,
        "it is another flow"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_process_that_is_paused_for_longer_than_a_lease_keeps_its_jobs() {
    let server = Server::with_config("[queue]\nlease_seconds = 2\nmax_attempts = 1\n");
    let client = reqwest::Client::new();
    let sent = client
        .post(server.url("/v1/jobs"))
        .multipart(form(
            medium_pair(),
            r#"{"preset": "paper", "max_points": 8192}"#,
        ))
        .send()
        .await
        .expect("an answer");
    let job: Value = sent.json().await.expect("a job");
    let id = job["id"].as_str().expect("a name");
    server.until("it runs", || server.metric("fnsf_jobs_running") > 0.0);
    for _ in 0..2 {
        server.signal("STOP");
        tokio::time::sleep(Duration::from_secs(4)).await;
        server.signal("CONT");
        tokio::time::sleep(Duration::from_millis(300)).await;
    }
    assert_eq!(ended(&server, id).await["state"], "succeeded");
    assert_eq!(server.metric("fnsf_leases_expired_total"), 0.0);
}
