//! Tests of many nodes over one database and one object store: nodes are killed and frozen, and the
//! database crashes.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use reqwest::StatusCode;
use serde_json::Value;

use crate::clouds::{ENDLESS, form, small_pair};
use crate::crash_recovery::{Dice, end_undisturbed, list_all, options};
use crate::object_server::ObjectServer;
use crate::postgres_server::{PostgresServer, start_postgres};
use crate::server::{PATIENCE, Server, plain_get};

/// Default number of jobs. `FNSF_FLEET_JOBS` overrides it.
const JOBS: usize = 24;

/// Nodes of each role.
const OF_A_ROLE: usize = 3;

/// A database, an object store, and how nodes are started on them.
#[derive(Clone)]
pub(crate) struct Farm {
    database: Arc<PostgresServer>,
    url: String,
    pub(crate) objects: Arc<ObjectServer>,
    pub(crate) config: String,
}

impl Farm {
    /// `None` without PostgreSQL or moto.
    pub(crate) fn start(queue: &str) -> Option<Self> {
        let database = start_postgres()?;
        let objects = ObjectServer::start()?;
        let url = database.database();
        let config = format!(
            "storage = \"s3://farm/fnsf\"\n[queue]\npostgres = \"{url}\"\n\
             retry_delay_seconds = 1\nsnapshot_interval_ms = 250\nmax_crashes = 1000\n\
             max_attempts = 1000\n{queue}"
        );
        Some(Self {
            database: Arc::new(database),
            url,
            objects: Arc::new(objects),
            config,
        })
    }

    /// The URL of the database.
    pub(crate) fn url(&self) -> &str {
        &self.url
    }

    /// Runs a statement in the database and returns what it says.
    pub(crate) fn sql(&self, text: &str) -> String {
        let name = self.url.rsplit('=').next().expect("a name");
        self.database.sql(name, text)
    }

    pub(crate) fn node(&self, role: &str) -> Server {
        let variables = self.objects.variables();
        let variables: Vec<_> = variables.iter().map(|(k, v)| (*k, v.as_str())).collect();
        Server::node(&self.config, role, &variables)
    }
}

/// The addresses of the nodes that answer requests now.
type Addresses = Arc<Mutex<Vec<String>>>;

/// Submits a job to one node after the other, until one has acknowledged it.
async fn submit(addresses: &Addresses, client: &reqwest::Client, job: usize) -> String {
    let began = Instant::now();
    for turn in job.. {
        assert!(began.elapsed() < PATIENCE * 3, "nobody takes job {job}");
        let address = {
            let addresses = addresses.lock().expect("no panic holds it");
            addresses[turn % addresses.len()].clone()
        };
        let sent = client
            .post(format!("http://{address}/v1/jobs"))
            .header("idempotency-key", format!("job-{job}"))
            .timeout(Duration::from_secs(20))
            .multipart(form(small_pair(), &options(job)))
            .send()
            .await;
        if let Ok(answer) = sent {
            let status = answer.status();
            if let Ok(view) = answer.json::<Value>().await
                && matches!(status, StatusCode::ACCEPTED | StatusCode::OK)
                && let Some(id) = view["id"].as_str()
            {
                return id.to_owned();
            }
            assert!(!status.is_client_error(), "job {job} was refused: {status}");
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    unreachable!("it goes on until one takes it")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn every_acknowledged_job_ends_once_while_nodes_are_killed_and_frozen_and_the_database_crashes()
 {
    let asked = std::env::var("FNSF_FLEET_JOBS").ok();
    let jobs: usize = asked.and_then(|jobs| jobs.parse().ok()).unwrap_or(JOBS);
    let Some(farm) = Farm::start("lease_seconds = 5\n") else {
        return;
    };
    let roles = ["api", "worker"].map(|role| [role; OF_A_ROLE]).concat();
    let mut nodes: Vec<Option<Server>> = Vec::new();
    for role in &roles {
        nodes.push(Some(farm.node(role)));
    }
    let address = |node: &Option<Server>| node.as_ref().expect("it runs").public.clone();
    let addresses: Addresses = Arc::default();
    *addresses.lock().expect("no panic") = nodes[..OF_A_ROLE].iter().map(address).collect();

    let submitting = {
        let addresses = Arc::clone(&addresses);
        tokio::spawn(async move {
            let client = reqwest::Client::new();
            let mut ids = Vec::new();
            for job in 0..jobs {
                ids.push(submit(&addresses, &client, job).await);
            }
            ids
        })
    };
    let mut dice = Dice(2027);
    let (mut turn, mut kills, mut crashes, mut freezes) = (0, 0, 0, 0);
    let began = Instant::now();
    let open = "SELECT count(*) FROM jobs WHERE state < 2";
    while !submitting.is_finished() || farm.sql(open) != "0" {
        assert!(
            began.elapsed() < Duration::from_secs(120 + 4 * jobs as u64),
            "it does not end"
        );
        tokio::time::sleep(Duration::from_millis(700)).await;
        let which = dice.below(roles.len() as u64) as usize;
        turn += 1;
        match turn % 6 {
            3 => {
                crashes += 1;
                let database = Arc::clone(&farm.database);
                let crash = tokio::task::spawn_blocking(move || database.crash());
                crash.await.expect("it starts again");
            }
            5 => {
                let which = OF_A_ROLE + which % OF_A_ROLE;
                // It wakes when its leases are those of others.
                freezes += 1;
                let node = nodes[which].as_ref().expect("it runs");
                node.signal("STOP");
                tokio::time::sleep(Duration::from_secs(8)).await;
                node.signal("CONT");
            }
            _ => {
                kills += 1;
                nodes[which].take().expect("it runs").kill();
                let (farm, role) = (farm.clone(), roles[which]);
                let start = tokio::task::spawn_blocking(move || farm.node(role));
                let node = start.await.expect("it starts");
                if which < OF_A_ROLE {
                    addresses.lock().expect("no panic")[which].clone_from(&node.public);
                }
                nodes[which] = Some(node);
            }
        }
    }
    let ids = submitting.await.expect("no panic");
    let took = began.elapsed();

    let server = nodes[0].as_ref().expect("it runs");
    let client = reqwest::Client::new();
    for (job, id) in ids.iter().enumerate() {
        let again = submit(&addresses, &client, job).await;
        assert_eq!(again, *id, "job {job} was lost or repeated");
    }
    assert_eq!(list_all(server, &client).await, jobs);
    let attempts = end_undisturbed(server, &client, &ids).await;
    println!(
        "{jobs} jobs, {attempts} attempts, {kills} kills, {crashes} crashes of the database, \
         {freezes} freezes in {:.0} s",
        took.as_secs_f64()
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nodes_know_each_other_and_a_node_without_devices_has_its_jobs_done_by_the_others() {
    let Some(farm) = Farm::start("") else { return };
    let api = farm.node("api");
    let client = reqwest::Client::new();
    let nodes = |server: &Server| -> Vec<(bool, u64)> {
        let page = plain_get(&server.admin, "/nodes").expect("an answer");
        let body = page.split("\r\n\r\n").nth(1).expect("a body");
        let view: Value = serde_json::from_str(body).expect("JSON");
        let nodes = view["nodes"].as_array().expect("nodes").iter();
        let lanes = |node: &Value| node["devices"][0]["lanes"].as_u64().unwrap_or(0);
        nodes
            .map(|node| (node["is_this"] == true, lanes(node)))
            .collect()
    };
    assert_eq!(nodes(&api), [(true, 0)]);
    let worker = farm.node("worker");
    assert!(worker.public.is_empty());
    api.until("it knows the worker", || {
        nodes(&api) == [(true, 0), (false, 1)]
    });
    // The prediction counts the worker's lane.
    let info = async || -> Value {
        let answer = client.get(api.url("/v1/info")).send().await;
        answer.expect("an answer").json().await.expect("JSON")
    };
    assert_eq!(info().await["queue"], "postgres");
    while info().await["devices"][0]["lanes"] != 1 {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let sent = client
        .post(api.url("/v1/flow"))
        .multipart(form(small_pair(), r#"{"max_points": 512}"#))
        .send()
        .await
        .expect("an answer");
    assert_eq!(sent.status(), StatusCode::OK, "{:?}", sent.text().await);
    // The answer may come before the worker has counted the job.
    worker.until("it counts the job", || {
        (worker.metric("fnsf_jobs_finished_total") - 1.0).abs() < 0.5
    });
    let number = |server: &Server| server.metric("fnsf_jobs_submitted_total");
    assert!(number(&api) > 0.5 && number(&worker) < 0.5);
    worker.kill();
    api.until("it knows of its end", || nodes(&api) == [(true, 0)]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_that_stops_answers_the_calls_whose_jobs_other_nodes_do() {
    let Some(farm) = Farm::start("") else { return };
    let (api, worker) = (farm.node("api"), farm.node("worker"));
    let mut options: Value = serde_json::from_str(ENDLESS).expect("JSON");
    options["deadline_ms"] = 4000.into();
    let call = reqwest::Client::new()
        .post(api.url("/v1/flow"))
        .multipart(form(small_pair(), &options.to_string()))
        .send();
    let call = tokio::spawn(call);
    worker.until("it does the job", || {
        worker.metric("fnsf_jobs_running") > 0.5
    });
    api.signal("TERM");
    let answer = call.await.expect("no panic").expect("an answer");
    assert_eq!(answer.status(), StatusCode::OK, "{:?}", answer.text().await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_the_database_accepts_after_its_answer_was_given_up_has_its_sweeps() {
    let Some(farm) = Farm::start("") else { return };
    let node = farm.node("all");
    // Its commit takes longer than a caller waits for the database.
    farm.sql(
        "CREATE FUNCTION slow() RETURNS trigger AS $$ BEGIN PERFORM pg_sleep(34); RETURN NULL; END $$ \
         LANGUAGE plpgsql; \
         CREATE CONSTRAINT TRIGGER slow AFTER INSERT ON jobs DEFERRABLE INITIALLY DEFERRED \
         FOR EACH ROW WHEN (NEW.idempotency_key = 'late') EXECUTE FUNCTION slow()",
    );
    let client = reqwest::Client::new();
    let send = async || {
        let request = client
            .post(node.url("/v1/jobs"))
            .header("idempotency-key", "late")
            .multipart(form(small_pair(), &options(0)));
        request.send().await.expect("an answer")
    };
    let refused = send().await;
    assert!(refused.status().is_server_error(), "{}", refused.status());
    let began = Instant::now();
    while farm.sql("SELECT count(*) FROM jobs WHERE idempotency_key = 'late'") != "1" {
        assert!(began.elapsed() < PATIENCE, "it is not accepted");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let answer = send().await;
    assert_eq!(answer.status(), StatusCode::OK, "it is a job of its own");
    let view: Value = answer.json().await.expect("JSON");
    let id = view["id"].as_str().expect("an id").to_owned();
    end_undisturbed(&node, &client, &[id]).await;
}
