//! The queue of many nodes: jobs a second against nodes, fair shares, and claims from a long queue.
//!
//! `cargo bench --bench queue` starts a PostgreSQL server of its own. The words `throughput`,
//! `shares` and `claims` after `--` choose among the measurements. The nodes are in this process;
//! each has its own connections, and 16 lanes that sleep for the cost of their jobs.
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "a benchmark prints and may fail"
)]

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fnsf::job::{DeviceKind, JobId, Kind, Priority, Tenant};
use fnsf::queue::{
    Event, Outcome, PairOf, PostgresOptions, Queue, QueueOptions, Submission, open_postgres,
    open_sqlite,
};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

#[expect(dead_code, reason = "nothing crashes here")]
#[path = "../tests/common/postgres_server.rs"]
mod postgres_server;
use postgres_server::{PostgresServer, start_postgres};

/// Lanes of a node.
const LANES: usize = 16;

/// Cost of a job, nominal seconds, for which a lane sleeps.
const COST_S: f64 = 0.3;

/// Pairs of a sequence, and tenants that submit them.
const PAIRS: u32 = 150;
const TENANTS: usize = 8;

/// For how long jobs are counted.
const COUNTED: Duration = Duration::from_secs(15);

type Heard = mpsc::UnboundedReceiver<Event>;

async fn node(url: &str) -> (Arc<dyn Queue>, Heard) {
    let (events, heard) = mpsc::unbounded_channel();
    let options = PostgresOptions {
        url: url.to_owned(),
        direct_url: None,
        connections: 2,
        name: "bench".to_owned(),
    };
    let queue = open_postgres(&options, QueueOptions::default(), events).await;
    (queue.unwrap(), heard)
}

fn submission(tenant: &str, pairs: u32, cost_seconds: f64) -> Submission {
    let pair = |index| PairOf {
        index,
        ..PairOf::ALONE
    };
    Submission {
        id: JobId::fresh(),
        tenant: tenant.parse().unwrap(),
        kind: Kind::Sequence,
        pair: PairOf::ALONE,
        pairs: (0..pairs).map(pair).collect(),
        finalizer_seconds: None,
        after: None,
        has_dependents: false,
        priority: Priority::Normal,
        device: None,
        cost_seconds,
        options: "{}".to_owned(),
        labels: Vec::new(),
        trace: None,
        webhook: None,
        result_uri: None,
        deadline: None,
        idempotency: None,
        durable: true,
    }
}

fn done() -> Outcome {
    Outcome::Succeeded {
        stop_reason: None,
        report: "{}".to_owned(),
        progress: None,
    }
}

/// A lane: leases jobs, sleeps for their cost, and finishes them.
async fn lane(queue: Arc<dyn Queue>, ended: Arc<AtomicU64>, sleeps: bool) {
    loop {
        let lease = queue.lease("bench", DeviceKind::Cpu).await.unwrap();
        if sleeps {
            sleep(Duration::from_secs_f64(lease.job.cost_seconds)).await;
        }
        let finished = queue.finish(lease.job.id, lease.job.attempt, done()).await;
        finished.unwrap();
        ended.fetch_add(1, Ordering::Relaxed);
    }
}

/// Jobs a second of these queues, each with 16 lanes, after a while to start.
async fn jobs_a_second(queues: &[Arc<dyn Queue>], sleeps: bool) -> f64 {
    let ended = Arc::new(AtomicU64::new(0));
    let mut lanes = JoinSet::new();
    for queue in queues {
        for _ in 0..LANES {
            lanes.spawn(lane(Arc::clone(queue), Arc::clone(&ended), sleeps));
        }
    }
    sleep(Duration::from_secs(3)).await;
    let (before, began) = (ended.load(Ordering::Relaxed), Instant::now());
    sleep(COUNTED).await;
    (ended.load(Ordering::Relaxed) - before) as f64 / began.elapsed().as_secs_f64()
}

/// Throughput against the number of nodes, beside the embedded queue.
async fn throughput(server: &PostgresServer) {
    println!("jobs a second: lanes that sleep {COST_S} s a job, and lanes that do not sleep");
    let folder = tempfile::tempdir().unwrap();
    let sqlite = embedded(folder.path());
    for turn in 0..600 {
        let tenant = format!("tenant-{}", turn % TENANTS);
        let submitted = sqlite.submit(submission(&tenant, PAIRS, COST_S)).await;
        submitted.unwrap();
    }
    let queues = [sqlite];
    let sleeping = jobs_a_second(&queues, true).await;
    let busy = jobs_a_second(&queues, false).await;
    println!("  SQLite, one process  {sleeping:7.0} {busy:7.0}");
    for nodes in [1, 4, 16, 64] {
        let url = server.database();
        let mut queues = Vec::new();
        let mut heard = Vec::new();
        for _ in 0..nodes {
            let (queue, events) = node(&url).await;
            queues.push(queue);
            heard.push(events);
        }
        for turn in 0..600 {
            let queue = &queues[turn % nodes];
            let tenant = format!("tenant-{}", turn % TENANTS);
            let submission = submission(&tenant, PAIRS, COST_S);
            queue.submit(submission).await.unwrap();
        }
        let sleeping = jobs_a_second(&queues, true).await;
        let busy = jobs_a_second(&queues, false).await;
        let possible = (nodes * LANES) as f64 / COST_S;
        println!(
            "  PostgreSQL, {nodes:2} nodes  {sleeping:7.0} {busy:7.0}   of {possible:5.0} that the \
             lanes could do"
        );
    }
}

fn embedded(folder: &Path) -> Arc<dyn Queue> {
    let (events, _) = mpsc::unbounded_channel();
    open_sqlite(folder, QueueOptions::default(), events).unwrap()
}

/// Jain's index of the seconds that 100 tenants were served while all of them had jobs waiting.
async fn shares(server: &PostgresServer) {
    const TENANTS: u32 = 100;
    const SERVED: usize = 3000;
    let url = server.database();
    let mut nodes = Vec::new();
    for _ in 0..4 {
        nodes.push(node(&url).await);
    }
    for tenant in 0..TENANTS {
        // From 60 to 240 jobs of 0.1 to 0.4 s: each has more work than its share.
        let (jobs, cost) = (
            60 + 180 * (tenant % 10) / 9,
            0.1 * f64::from(1 + tenant % 4),
        );
        let queue = &nodes[tenant as usize % nodes.len()].0;
        let submission = submission(&format!("tenant-{tenant}"), jobs, cost);
        queue.submit(submission).await.unwrap();
    }
    let mut served: HashMap<Tenant, f64> = HashMap::new();
    for turn in 0..SERVED {
        let queue = &nodes[turn % nodes.len()].0;
        let lease = queue.lease("bench", DeviceKind::Cpu).await.unwrap();
        *served.entry(lease.job.tenant.clone()).or_default() += lease.job.cost_seconds;
        let finished = queue.finish(lease.job.id, lease.job.attempt, done()).await;
        finished.unwrap();
    }
    let sum: f64 = served.values().sum();
    let squares: f64 = served.values().map(|seconds| seconds * seconds).sum();
    let jain = sum * sum / (f64::from(TENANTS) * squares);
    println!("Jain's index of {TENANTS} tenants over {SERVED} jobs on 4 nodes: {jain:.4}");
}

/// The time of a claim and of the end of a job with a million queued.
async fn long_queue(server: &PostgresServer) {
    const QUEUED: u32 = 1_000_000;
    const CLAIMS: usize = 1000;
    let url = server.database();
    let (queue, _heard) = node(&url).await;
    let name = url.rsplit('=').next().unwrap();
    let fill = format!(
        "INSERT INTO jobs (id, tenant, kind, pair_index, pairs, pairs_left, priority, state, \
         durable, delayed, attempt, failures, crashes, delays, cost, virtual_start, virtual_finish, \
         options, created, expires, due, error_retryable, dead, cancel_requested, device, backward, \
         has_dependents, ready, closes, sees_from, sees_to, origin) \
         SELECT int8send(n) || int8send(n), 't' || n % 100, 0, 0, 0, 0, n % 3, 0, 1, 0, 0, 0, 0, 0, 1, \
         n / 100, n / 100 + 1, '{{}}', n, 9e15::bigint, 9e15::bigint, 0, 0, 0, 0, 0, 0, n, 0, 0, 2, 1 \
         FROM generate_series(1, {QUEUED}) AS n; ANALYZE jobs"
    );
    server.sql(name, &fill);
    let began = Instant::now();
    while queue.backlog().queued().jobs < u64::from(QUEUED) {
        assert!(began.elapsed() < Duration::from_secs(60), "not counted");
        sleep(Duration::from_millis(50)).await;
    }
    let (mut claims, mut ends) = (Vec::new(), Vec::new());
    for _ in 0..CLAIMS {
        let began = Instant::now();
        let claimed = timeout(COUNTED, queue.lease("bench", DeviceKind::Cpu)).await;
        let lease = claimed.unwrap().unwrap();
        claims.push(began.elapsed().as_secs_f64() * 1e3);
        let began = Instant::now();
        let finished = queue.finish(lease.job.id, lease.job.attempt, done()).await;
        finished.unwrap();
        ends.push(began.elapsed().as_secs_f64() * 1e3);
    }
    for (what, mut times) in [("claim", claims), ("end", ends)] {
        times.sort_by(f64::total_cmp);
        println!(
            "{what} of a job with {QUEUED} queued: p50 {:.1} ms, p99 {:.1} ms",
            times[times.len() / 2],
            times[times.len() * 99 / 100]
        );
    }
}

#[tokio::main]
async fn main() {
    let Some(server) = start_postgres() else {
        return;
    };
    let asked: Vec<String> = std::env::args().skip(1).collect();
    let is_asked = |name: &str| {
        let known = ["throughput", "shares", "claims"];
        let none = !asked.iter().any(|asked| known.contains(&asked.as_str()));
        none || asked.iter().any(|asked| asked == name)
    };
    if is_asked("throughput") {
        throughput(&server).await;
    }
    if is_asked("shares") {
        shares(&server).await;
    }
    if is_asked("claims") {
        long_queue(&server).await;
    }
}
