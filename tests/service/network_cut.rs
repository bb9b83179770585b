//! A test of a worker whose network is cut: its packets are lost while its connections stay open.
//!
//! The worker runs in a network namespace of its own. One link leads to the database and the object store,
//! and is taken down. It needs root and `ip`; elsewhere the test is left out with a message.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tokio::net::{TcpListener, TcpStream, UnixStream};

use crate::clouds::{accepted, form, small_pair};
use crate::crash_recovery::{end_undisturbed, list_all, options};
use crate::fleet::Farm;
use crate::server::{FREE_PORTS, Folder, PATIENCE, plain_get};

const JOBS: usize = 20;
const CUTS: usize = 2;
/// Longer than a lease of the farm.
const CUT: Duration = Duration::from_secs(8);

/// A network namespace with one link to this one.
struct Namespace {
    name: String,
    link: String,
    address: String,
}

fn ip(arguments: &str) -> bool {
    let run = Command::new("ip")
        .args(arguments.split(' '))
        .stderr(Stdio::null())
        .status();
    run.is_ok_and(|status| status.success())
}

impl Namespace {
    /// `None` where this process may not make one.
    fn new() -> Option<Self> {
        let id = std::process::id();
        let (name, link, other) = (format!("fnsf-{id}"), format!("fl{id}"), format!("fn{id}"));
        let network = format!("10.213.{}", id % 250);
        let made = Self {
            address: format!("{network}.1"),
            name,
            link,
        };
        let Self { name, link, .. } = &made;
        let is_made = ip(&format!("netns add {name}"))
            && ip(&format!(
                "link add {link} type veth peer name {other} netns {name}"
            ))
            && ip(&format!("address add {network}.1/30 dev {link}"))
            && ip(&format!("link set {link} up"))
            && ip(&format!("-n {name} address add {network}.2/30 dev {other}"))
            && ip(&format!("-n {name} link set {other} up"))
            && ip(&format!("-n {name} link set lo up"));
        if !is_made {
            eprintln!("no network namespace can be made: a cut of the network is not tested");
            return None;
        }
        Some(made)
    }

    fn cut(&self) {
        assert!(ip(&format!("link set {} down", self.link)));
    }

    fn mend(&self) {
        assert!(ip(&format!("link set {} up", self.link)));
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        ip(&format!("link delete {}", self.link));
        ip(&format!("netns delete {}", self.name));
    }
}

/// Where connections are led to.
#[derive(Clone)]
enum Goal {
    Socket(PathBuf),
    Address(String),
}

/// Listens on the link, and leads each connection on.
async fn lead(address: &str, goal: Goal) -> SocketAddr {
    let listener = TcpListener::bind((address, 0)).await.expect("a port");
    let bound = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        loop {
            let (mut from, _) = listener.accept().await.expect("a connection");
            let goal = goal.clone();
            tokio::spawn(async move {
                let copied = match goal {
                    Goal::Socket(path) => {
                        let mut to = UnixStream::connect(path).await?;
                        tokio::io::copy_bidirectional(&mut from, &mut to).await
                    }
                    Goal::Address(to) => {
                        let mut to = TcpStream::connect(to).await?;
                        tokio::io::copy_bidirectional(&mut from, &mut to).await
                    }
                };
                copied.map(drop)
            });
        }
    });
    bound
}

/// A worker in the namespace. It is killed on drop.
struct Worker {
    child: Child,
    _folder: Folder,
}

impl Worker {
    async fn start(farm: &Farm, within: &Namespace) -> Self {
        let url = farm.url();
        let folder_of_socket = url.split(['=', ' ']).nth(1).expect("a folder");
        let socket = PathBuf::from(folder_of_socket).join(".s.PGSQL.5432");
        let database = lead(&within.address, Goal::Socket(socket)).await;
        let objects = Goal::Address(farm.objects.address().to_owned());
        let objects = lead(&within.address, objects).await;
        let (host, port) = (database.ip(), database.port());
        let through = url.replace(
            &format!("host={folder_of_socket}"),
            &format!("host={host} port={port}"),
        );
        let folder = Folder::new();
        let config = folder.path().join("fnsf.toml");
        std::fs::write(&config, farm.config.replace(url, &through)).expect("a file");
        let child = Command::new("ip")
            .args(["netns", "exec", &within.name, env!("CARGO_BIN_EXE_fnsf")])
            .args(FREE_PORTS)
            .args(["--role", "worker", "--device", "cpu:1", "--config"])
            .arg(&config)
            .arg("--data-dir")
            .arg(folder.path().join("data"))
            .envs(farm.objects.variables())
            .env("AWS_ENDPOINT_URL", format!("http://{objects}"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the worker starts");
        Self {
            child,
            _folder: folder,
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        let _it_may_have_ended = self.child.kill();
        let _reaped = self.child.wait();
    }
}

/// Waits until a count in the database is at least this.
async fn until(farm: &Farm, what: &str, query: &str, least: i64) {
    let began = Instant::now();
    while farm.sql(query).parse::<i64>().expect("a number") < least {
        assert!(began.elapsed() < PATIENCE * 3, "not in time: {what}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_worker_that_is_cut_off_loses_its_jobs_to_others_and_every_job_ends_once() {
    let Some(farm) = Farm::start("lease_seconds = 5\n") else {
        return;
    };
    let Some(namespace) = Namespace::new() else {
        return;
    };
    let api = farm.node("api");
    let cut_off = Worker::start(&farm, &namespace).await;
    api.until("it knows the worker", || {
        let page = plain_get(&api.admin, "/nodes").expect("an answer");
        let body = page.split("\r\n\r\n").nth(1).expect("a body");
        let view: Value = serde_json::from_str(body).expect("JSON");
        view["nodes"]
            .as_array()
            .is_some_and(|nodes| nodes.len() == 2)
    });
    let client = reqwest::Client::new();
    let mut ids = Vec::new();
    for job in 0..JOBS {
        let request = client
            .post(api.url("/v1/jobs"))
            .header("idempotency-key", format!("job-{job}"))
            .multipart(form(small_pair(), &options(job)));
        let view = accepted(request).await;
        ids.push(view["id"].as_str().expect("an id").to_owned());
    }
    // The worker that will be cut off is alone at first, so it holds a job when that happens.
    until(
        &farm,
        "it runs one",
        "SELECT count(*) FROM jobs WHERE state = 1",
        1,
    )
    .await;
    namespace.cut();
    let _other = farm.node("worker");
    for turn in 0..CUTS {
        if turn > 0 {
            namespace.cut();
        }
        tokio::time::sleep(CUT).await;
        namespace.mend();
        tokio::time::sleep(CUT / 4).await;
    }
    let ended = "SELECT count(*) FROM jobs WHERE state > 1";
    until(&farm, "all end", ended, JOBS as i64).await;
    let again: i64 = farm
        .sql("SELECT count(*) FROM jobs WHERE attempt > 1")
        .parse()
        .expect("a number");
    assert!(
        again > 0,
        "no job was taken from the worker that was cut off"
    );
    assert_eq!(list_all(&api, &client).await, JOBS);
    let attempts = end_undisturbed(&api, &client, &ids).await;
    println!("{JOBS} jobs, {attempts} attempts, {again} jobs began again");
    drop(cut_off);
}
