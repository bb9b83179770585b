//! Health of a device with several lanes under losses, panics and failed openings.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::time::timeout;

use super::device::{Device, Lane};
use super::test_gpu::Switches;
use super::types::{EngineError, Health, Work};
use crate::flow::field::BackendError;
use crate::flow::{Point, Preset, Uncontrolled};
use crate::metrics::Metrics;

/// Timeout, long enough for a loaded machine. Only a failing test waits this long.
const PATIENCE: Duration = Duration::from_secs(60);

struct Stand {
    switches: Arc<Switches>,
    device: Device,
    metrics: Arc<Metrics>,
}

fn stand(lanes: usize) -> Stand {
    let switches = Arc::new(Switches::default());
    let metrics = Arc::new(Metrics::new(&["gpu0"]));
    let device = Device::start(switches.gpu("gpu0", lanes), &metrics).expect("threads");
    Stand {
        switches,
        device,
        metrics,
    }
}

impl Stand {
    async fn until(&self, wanted: impl Fn(&Health) -> bool) {
        let mut health = self.device.health();
        let reached = timeout(PATIENCE, health.wait_for(wanted)).await;
        reached.expect("in time").expect("threads live");
    }

    /// Polls as the server's housekeeping does. A lane that is told to look may still be at work, so
    /// it is repeated.
    async fn looked_at_until(&self, wanted: impl Fn(&Health) -> bool) {
        let looks = async {
            loop {
                self.device.look();
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        };
        tokio::select! {
            () = self.until(wanted) => {}
            () = looks => {}
        }
    }

    async fn ready(&self) {
        self.until(|health| *health == Health::Ready).await;
    }

    fn losses(&self) -> bool {
        let page = self.metrics.expose(false);
        page.contains("fnsf_device_lost_total{device=\"gpu0\"} 1")
    }
}

/// A wall of points, and the same wall 0.1 m further along x.
fn work() -> Work {
    let source: Vec<Point> = (0..900u16)
        .map(|i| [8.0, f32::from(i % 30) * 0.2, f32::from(i / 30) * 0.2])
        .collect();
    Work {
        target: source.iter().map(|[x, y, z]| [x + 0.1, *y, *z]).collect(),
        source,
        ground: None,
        before: None,
        neighbors: Vec::new(),
        options: Preset::Neural.options(None),
        snapshot: None,
        control: Arc::new(Uncontrolled),
    }
}

async fn solved(lane: &Lane) -> Result<(), EngineError> {
    let solved = timeout(PATIENCE, lane.estimate(work())).await;
    solved.expect("in time").map(drop)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_loss_costs_every_lane_its_pair_and_the_device_is_opened_again_once() {
    let stand = stand(3);
    stand.ready().await;
    stand.switches.brake.store(true, Ordering::Relaxed);
    let lanes: Vec<_> = stand.device.lanes().collect();
    let running = futures_util::future::join_all(lanes.iter().map(solved));
    let destroyed = async {
        stand.switches.until_at_the_brake(3).await;
        stand.switches.destroy();
        stand.switches.brake.store(false, Ordering::Relaxed);
    };
    let (ended, ()) = tokio::join!(running, destroyed);
    for end in ended {
        assert!(matches!(end, Err(EngineError::Lost(_))), "{end:?}");
    }
    stand.ready().await;
    for lane in &lanes {
        solved(lane).await.expect("it works again");
    }
    assert_eq!(stand.switches.openings.load(Ordering::Relaxed), 2);
    assert!(stand.losses(), "{}", stand.metrics.expose(false));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_that_goes_while_idle_gives_the_next_pair_back_untouched() {
    let stand = stand(1);
    stand.ready().await;
    let lane = stand.device.lanes().next().expect("a lane");
    stand.switches.destroy();
    let given_back = solved(&lane).await;
    assert!(
        matches!(given_back, Err(EngineError::Broken(_))),
        "{given_back:?}"
    );
    stand.ready().await;
    solved(&lane).await.expect("it works again");
    assert!(stand.losses());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_that_goes_while_idle_is_opened_again_when_somebody_looks() {
    let stand = stand(2);
    stand.ready().await;
    stand.device.look();
    stand.switches.destroy();
    let again = || stand.switches.openings.load(Ordering::Relaxed) == 2;
    stand
        .looked_at_until(|health| again() && *health == Health::Ready)
        .await;
    let lane = stand.device.lanes().next().expect("a lane");
    solved(&lane).await.expect("it works again");
    assert!(stand.losses());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_panic_in_one_lane_is_not_felt_in_another() {
    let stand = stand(2);
    stand.ready().await;
    stand.switches.brake.store(true, Ordering::Relaxed);
    let lanes: Vec<_> = stand.device.lanes().collect();
    let undisturbed = solved(&lanes[0]);
    let panics = async {
        stand.switches.until_at_the_brake(1).await;
        stand.switches.panics.store(1, Ordering::Relaxed);
        let panicked = solved(&lanes[1]).await;
        stand.switches.brake.store(false, Ordering::Relaxed);
        panicked
    };
    let (undisturbed, panicked) = tokio::join!(undisturbed, panics);
    undisturbed.expect("it is not felt");
    assert!(matches!(panicked, Err(EngineError::Panicked(_))));
    solved(&lanes[1]).await.expect("it works again");
    assert_eq!(stand.switches.openings.load(Ordering::Relaxed), 1);
    assert!(!stand.losses());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_self_test_that_finds_no_room_beside_other_pairs_does_not_lose_the_device() {
    for lack_of_room in [
        BackendError::Busy,
        BackendError::Memory {
            what: "points",
            needed: 2,
            available: 1,
        },
    ] {
        let stand = stand(1);
        stand.ready().await;
        let lane = stand.device.lanes().next().expect("a lane");
        stand.switches.panics.store(1, Ordering::Relaxed);
        stand.switches.fail_a_self_test(lack_of_room);
        let panicked = solved(&lane).await;
        assert!(matches!(panicked, Err(EngineError::Panicked(_))));
        solved(&lane).await.expect("it works again");
        assert!(stand.switches.no_self_test_fails(), "it was not tried");
        assert_eq!(stand.switches.openings.load(Ordering::Relaxed), 1);
        assert!(!stand.losses());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_that_fails_its_self_test_is_given_up_under_the_other_lanes_too() {
    let stand = stand(2);
    stand.ready().await;
    stand.switches.brake.store(true, Ordering::Relaxed);
    let lanes: Vec<_> = stand.device.lanes().collect();
    // Only the loss of the device lets it continue.
    let at_work = solved(&lanes[0]);
    let slips = async {
        stand.switches.until_at_the_brake(1).await;
        stand.switches.panics.store(1, Ordering::Relaxed);
        let error = BackendError::Device("it computes nonsense".to_owned());
        stand.switches.fail_a_self_test(error);
        solved(&lanes[1]).await
    };
    let (at_work, slipped) = tokio::join!(at_work, slips);
    assert!(matches!(slipped, Err(EngineError::Panicked(_))));
    assert!(matches!(at_work, Err(EngineError::Lost(_))), "{at_work:?}");
    stand.switches.brake.store(false, Ordering::Relaxed);
    stand.ready().await;
    assert_eq!(stand.switches.openings.load(Ordering::Relaxed), 2);
    assert!(stand.losses());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_that_does_not_come_back_is_given_up_and_still_tried() {
    let stand = stand(2);
    stand.ready().await;
    stand.switches.refusals.store(1000, Ordering::Relaxed);
    let lane = stand.device.lanes().next().expect("a lane");
    stand.switches.destroy();
    // It is returned unrun or solved, depending on which lane detects the loss first.
    let given_back_or_done = solved(&lane);
    let driver_comes_back = async {
        stand
            .until(|health| matches!(health, Health::Gone(_)))
            .await;
        let not_ready_reason = stand.device.not_ready_reason().expect("an obstacle");
        assert!(
            not_ready_reason.contains("the driver is away"),
            "{not_ready_reason}"
        );
        stand.switches.refusals.store(0, Ordering::Relaxed);
        stand.ready().await;
    };
    let (_either, ()) = tokio::join!(given_back_or_done, driver_comes_back);
    solved(&lane).await.expect("it works again");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pair_that_comes_while_the_device_is_away_is_given_back() {
    let stand = stand(1);
    stand.ready().await;
    stand.switches.refusals.store(u32::MAX, Ordering::Relaxed);
    stand.switches.destroy();
    stand
        .looked_at_until(|health| matches!(health, Health::Gone(_)))
        .await;
    let lane = stand.device.lanes().next().expect("a lane");
    let given_back = solved(&lane).await;
    assert!(
        matches!(given_back, Err(EngineError::Broken(_))),
        "{given_back:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pair_that_comes_while_another_lane_opens_the_device_is_given_back_at_once() {
    let stand = stand(2);
    stand.ready().await;
    stand.switches.opening_waits.store(true, Ordering::Relaxed);
    stand.switches.destroy();
    let is_opening = async {
        while stand.switches.openings.load(Ordering::Relaxed) < 2 {
            stand.device.look();
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    timeout(PATIENCE, is_opening).await.expect("in time");
    // The first lane was told to look, so it opens the device.
    let lane = stand.device.lanes().nth(1).expect("a second lane");
    let given_back = solved(&lane).await;
    assert!(
        matches!(given_back, Err(EngineError::Broken(_))),
        "{given_back:?}"
    );
    stand.switches.opening_waits.store(false, Ordering::Relaxed);
    stand.ready().await;
    solved(&lane).await.expect("it works again");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_that_never_worked_is_broken_and_not_given_up() {
    let switches = Arc::new(Switches::default());
    switches.refusals.store(5, Ordering::Relaxed);
    let metrics = Arc::new(Metrics::new(&["gpu0"]));
    let device = Device::start(switches.gpu("gpu0", 1), &metrics).expect("threads");
    let mut health = device.health();
    loop {
        timeout(PATIENCE, health.changed())
            .await
            .expect("in time")
            .expect("threads live");
        match &*health.borrow_and_update() {
            Health::Ready => break,
            Health::Starting | Health::Broken(_) => {}
            Health::Gone(reason) => panic!("it was given up: {reason}"),
        }
    }
}
