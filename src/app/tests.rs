//! Device failures end to end: a whole server in this process, over HTTP, with GPUs that a test can
//! destroy.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::devices::Pool;
use super::shared_threads::SharedThreads;
use super::start::App;
use crate::config::Config;
use crate::engine::{DeviceOptions, Health, Opened, ReopenPolicy, Switches};
use crate::flow::gpu;
use crate::flow::gpu::{Gpu, GpuOptions};
use crate::flow::simulate::{Street, StreetOptions};
use crate::formats::{Pair, write_pair_npz};
use crate::gpu_in_tests;
use crate::job::DeviceKind;

/// Timeout, long enough for a loaded machine and a software GPU. Only a failing test waits this
/// long.
const PATIENCE: Duration = Duration::from_secs(240);

/// A server with its client and data folder.
struct Stand {
    app: App,
    client: reqwest::Client,
    _folder: tempfile::TempDir,
}

/// Starts a server on these GPUs, with one CPU thread in addition if `cpu` is set.
async fn serve(gpus: Vec<DeviceOptions>, cpu: bool) -> Stand {
    let folder = tempfile::tempdir().expect("a folder");
    let any_port = std::net::SocketAddr::from(([127, 0, 0, 1], 0));
    let config = Config {
        listen: any_port,
        admin_listen: any_port,
        data_dir: folder.path().to_owned(),
        devices: vec!["cpu:1".to_owned()],
        ..Config::default()
    };
    let mut pool = Pool::of(&config).expect("a CPU");
    pool.devices.retain(|_| cpu);
    pool.devices.extend(gpus);
    let app = App::start_on(pool, config).await.expect("a server");
    for device in &app.devices {
        let mut health = device.health();
        let ready = timeout(PATIENCE, health.wait_for(|health| *health == Health::Ready)).await;
        drop(ready.expect("in time").expect("threads live"));
    }
    Stand {
        app,
        client: reqwest::Client::new(),
        _folder: folder,
    }
}

impl Stand {
    fn url(&self, path: &str) -> String {
        let address = self.app.public_address().expect("a public port");
        format!("http://{address}{path}")
    }

    async fn submit(&self, options: Value) -> String {
        let street = Street::new(&StreetOptions {
            beams: 16,
            azimuth_steps: 300,
            ..StreetOptions::default()
        });
        let street = street.and_then(|street| street.pair(0)).expect("a street");
        let pair = Pair {
            source: street.source,
            target: street.target,
            ..Pair::default()
        };
        let mut file = Vec::new();
        write_pair_npz(&pair, &mut file).expect("written");
        let form = Form::new()
            .text("options", options.to_string())
            .part("source", Part::bytes(file).file_name("pair.npz"));
        let url = self.url("/v1/jobs");
        let sent = self.client.post(url).multipart(form).send().await;
        let job: Value = sent.expect("an answer").json().await.expect("a job");
        job["id"]
            .as_str()
            .unwrap_or_else(|| panic!("{job}"))
            .to_owned()
    }

    async fn job(&self, id: &str, wait: u32) -> Value {
        let url = self.url(&format!("/v1/jobs/{id}?wait={wait}"));
        let sent = self.client.get(url).send().await;
        sent.expect("an answer").json().await.expect("a job")
    }

    /// The final state of a job, its number of attempts, and the device that ran it.
    async fn end(&self, id: &str) -> (String, u64, String) {
        let ended = timeout(PATIENCE, async {
            loop {
                let job = self.job(id, 20).await;
                if !matches!(job["state"].as_str(), Some("queued" | "running")) {
                    return job;
                }
            }
        });
        let job = ended.await.expect("in time");
        let device = job["report"]["device"].as_str().unwrap_or_default();
        (
            job["state"].as_str().unwrap_or_default().to_owned(),
            job["attempt"].as_u64().unwrap_or_default(),
            device.to_owned(),
        )
    }

    async fn has_metric(&self, line: &str) -> bool {
        let url = format!("http://{}/metrics", self.app.admin_address());
        let page = self.client.get(url).send().await.expect("an answer");
        let page = page.text().await.expect("text");
        page.lines().any(|found| found == line)
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_card_that_dies_costs_its_jobs_one_attempt_and_the_others_nothing() {
    let switches = Arc::new(Switches::default());
    let stand = serve(vec![switches.gpu("gpu0", 2)], true).await;
    switches.brake.store(true, Ordering::Relaxed);
    let on_the_card = [
        stand
            .submit(json!({"device": "gpu", "preset": "neural"}))
            .await,
        stand
            .submit(json!({"device": "gpu", "preset": "neural", "seed": 1}))
            .await,
    ];
    let elsewhere = stand
        .submit(json!({"device": "cpu", "preset": "neural"}))
        .await;
    timeout(PATIENCE, switches.until_at_the_brake(2))
        .await
        .expect("in time");
    switches.destroy();
    switches.brake.store(false, Ordering::Relaxed);
    for id in on_the_card {
        let (state, attempts, device) = stand.end(&id).await;
        assert_eq!((state.as_str(), attempts), ("succeeded", 2));
        assert_eq!(device, "a card of the tests");
    }
    let (state, attempts, _) = stand.end(&elsewhere).await;
    assert_eq!((state.as_str(), attempts), ("succeeded", 1));
    assert!(
        stand
            .has_metric("fnsf_device_lost_total{device=\"gpu0\"} 1")
            .await
    );
    assert!(
        stand
            .has_metric("fnsf_device_lost_total{device=\"cpu0\"} 0")
            .await
    );
    assert!(
        stand
            .has_metric("fnsf_device_lanes{device=\"gpu0\"} 2")
            .await
    );
    stand.app.drain().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_real_card_that_is_destroyed_in_the_middle_of_a_job_is_opened_again_and_does_it() {
    let mut gpus = gpu::adapters();
    if !gpu_in_tests::is_there(gpus.len()) {
        return;
    }
    let adapter = gpus.swap_remove(0);
    let opened: Arc<Mutex<Vec<Gpu>>> = Arc::default();
    let known = Arc::clone(&opened);
    let gpu = DeviceOptions {
        name: "gpu0".to_owned(),
        kind: DeviceKind::Gpu,
        lanes: 2,
        open: Box::new(move || {
            let options = GpuOptions {
                lanes: 2,
                ..GpuOptions::default()
            };
            let gpu = Gpu::open(&adapter, &options)?;
            known.lock().expect("no panic holds it").push(gpu.clone());
            Ok(Box::new(SharedThreads::new(gpu, 2)) as Box<dyn Opened>)
        }),
        reopening: ReopenPolicy::default(),
    };
    let stand = serve(vec![gpu], true).await;
    let id = stand
        .submit(json!({
            "device": "gpu", "preset": "paper", "max_points": 500, "crop_m": 15.0,
            "field": {"max_iterations": 40}
        }))
        .await;
    let elsewhere = stand
        .submit(json!({"device": "cpu", "preset": "neural"}))
        .await;
    let under_way = async {
        while stand.job(&id, 0).await["progress"]["done"].as_u64() < Some(2) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    timeout(PATIENCE, under_way).await.expect("in time");
    // The test drops its handle as well, since the new device needs the memory.
    let first = opened
        .lock()
        .expect("no panic holds it")
        .pop()
        .expect("it is open");
    first.destroy();
    drop(first);
    let (state, attempts, device) = stand.end(&id).await;
    assert_eq!((state.as_str(), attempts), ("succeeded", 2));
    assert_ne!(device, "");
    let (state, attempts, _) = stand.end(&elsewhere).await;
    assert_eq!((state.as_str(), attempts), ("succeeded", 1));
    assert!(
        stand
            .has_metric("fnsf_device_lost_total{device=\"gpu0\"} 1")
            .await
    );
    stand.app.drain().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pair_too_large_for_the_card_is_done_by_the_cpu_unless_its_caller_wants_the_card() {
    let switches = Arc::new(Switches::default());
    switches.room.store(10, Ordering::Relaxed);
    let stand = serve(vec![switches.gpu("gpu0", 1)], true).await;
    let anywhere = stand.submit(json!({"preset": "neural"})).await;
    let (state, _, device) = stand.end(&anywhere).await;
    assert_eq!(state, "succeeded");
    assert_ne!(device, "a card of the tests");
    let there = stand
        .submit(json!({"device": "gpu", "preset": "neural"}))
        .await;
    let (state, attempts, _) = stand.end(&there).await;
    assert_eq!((state.as_str(), attempts), ("failed", 1));
    let error = &stand.job(&there, 0).await["error"];
    assert_eq!(error["code"], "input_refused", "{error}");
    assert_eq!(error["retryable"], false);
    stand.app.drain().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_gives_up_when_the_last_card_does_not_come_back_and_not_before() {
    const A_MOMENT: Duration = Duration::from_millis(500);
    let switches = [Arc::new(Switches::default()), Arc::new(Switches::default())];
    let gpus = vec![switches[0].gpu("gpu0", 1), switches[1].gpu("gpu1", 1)];
    let mut stand = serve(gpus, true).await;
    for (index, switches) in switches.iter().enumerate() {
        switches.refusals.store(u32::MAX, Ordering::Relaxed);
        switches.destroy();
        let job = stand
            .submit(json!({"device": "gpu", "preset": "neural"}))
            .await;
        let given_up = timeout(A_MOMENT, stand.app.given_up()).await;
        if index == 0 {
            assert!(given_up.is_err(), "there was another card");
            assert_eq!(stand.end(&job).await.0, "succeeded");
        } else {
            let reason = timeout(PATIENCE, stand.app.given_up())
                .await
                .expect("in time");
            assert!(reason.contains("the driver is away"), "{reason}");
        }
    }
    stand.app.drain().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_does_not_give_up_while_another_card_is_being_opened_again() {
    const A_MOMENT: Duration = Duration::from_millis(500);
    let switches = [Arc::new(Switches::default()), Arc::new(Switches::default())];
    let mut comes_back = switches[1].gpu("gpu1", 1);
    // Enough tries for the whole test.
    comes_back.reopening.tries = u32::MAX;
    let mut stand = serve(vec![switches[0].gpu("gpu0", 1), comes_back], true).await;
    for (switches, device) in switches.iter().zip(stand.app.devices.iter().skip(1)) {
        switches.refusals.store(u32::MAX, Ordering::Relaxed);
        switches.destroy();
        device.look();
    }
    let mut health = stand.app.devices[1].health();
    let gone = health.wait_for(|health| matches!(health, Health::Gone(_)));
    drop(
        timeout(PATIENCE, gone)
            .await
            .expect("in time")
            .expect("threads live"),
    );
    let given_up = timeout(A_MOMENT, stand.app.given_up()).await;
    assert!(given_up.is_err(), "the other card still had tries left");
    switches[1].refusals.store(0, Ordering::Relaxed);
    let job = stand
        .submit(json!({"device": "gpu", "preset": "neural"}))
        .await;
    assert_eq!(stand.end(&job).await.0, "succeeded");
    stand.app.drain().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_with_a_task_that_has_panicked_is_given_up() {
    let mut stand = serve(Vec::new(), true).await;
    let given_up = timeout(Duration::from_millis(100), stand.app.given_up()).await;
    assert_eq!(given_up.ok(), None);
    stand
        .app
        .upkeep
        .spawn(async { panic!("a fault of the outbox") });
    let reason = timeout(PATIENCE, stand.app.given_up()).await;
    assert_eq!(reason.expect("in time"), "a background task has panicked");
    stand.app.drain().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_whose_port_has_closed_is_given_up() {
    let mut stand = serve(Vec::new(), true).await;
    assert!(
        timeout(Duration::from_millis(100), stand.app.given_up())
            .await
            .is_err()
    );
    stand.app.stop_listening.cancel();
    let reason = timeout(PATIENCE, stand.app.given_up()).await;
    assert_eq!(reason.expect("in time"), "the public port has closed");
    // It still shuts down normally.
    stand.app.drain().await;
}
