//! A device and the one thread that owns it.
//!
//! The thread takes one pair at a time and publishes the device's health. A panic costs the pair
//! that it happened in: the device is opened again and must pass its trial. It must not know
//! queues, stores or doors.

mod trial;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use tokio::sync::{mpsc, oneshot, watch};

use crate::flow::backend::{Backend, BackendError};
use crate::flow::{
    self, Estimate, FlowError, Interrupt, Options, Point, Problem, Progress, Snapshot, Watch,
};

/// One pair for a device.
pub struct Work {
    /// N points, metres.
    pub source: Vec<Point>,
    /// M points, metres.
    pub target: Vec<Point>,
    /// N and M flags: which points are ground, where that is known.
    pub ground: Option<[Vec<bool>; 2]>,
    /// How the flow is found.
    pub options: Options,
    /// Where an earlier attempt was put down.
    pub snapshot: Option<Snapshot>,
    /// Looks in on the optimization.
    pub watch: Arc<dyn Watch + Send + Sync>,
}

/// What a device can do now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Health {
    /// It is being opened, or tried.
    Starting,
    /// It has passed its trial.
    Ready,
    /// It cannot be used.
    Broken(String),
}

/// Why a device gave no flow.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The solver refused or failed.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// The solver panicked; the device was opened again.
    #[error("the solver panicked: {0}")]
    Panicked(String),
    /// The device cannot be used.
    #[error("the device cannot be used: {0}")]
    Broken(String),
}

/// Opens a device's backend; called again after a panic.
pub type Opener = Box<dyn Fn() -> Result<Box<dyn Backend>, BackendError> + Send>;

/// What a device gives.
#[derive(Debug)]
pub struct Solved {
    /// The flow.
    pub estimate: Estimate,
    /// What the device is, as reports show it.
    pub device: String,
}

struct Command {
    work: Work,
    reply: oneshot::Sender<Result<Solved, EngineError>>,
}

/// The way to a device's thread.
#[derive(Clone, Debug)]
pub struct Device {
    name: Arc<str>,
    commands: mpsc::Sender<Command>,
    health: watch::Receiver<Health>,
    busy: Arc<Busy>,
}

impl Device {
    /// Starts the thread that opens the device and owns it from then on.
    ///
    /// # Errors
    /// Where the thread cannot be started.
    pub fn start(name: &str, open: Opener) -> std::io::Result<Self> {
        let (commands, inbox) = mpsc::channel(1);
        let (tell, health) = watch::channel(Health::Starting);
        let busy = Arc::new(Busy::default());
        let thread_busy = Arc::clone(&busy);
        thread::Builder::new()
            .name(format!("device {name}"))
            .spawn(move || run(&open, inbox, &tell, &thread_busy))?;
        Ok(Self {
            name: Arc::from(name),
            commands,
            health,
            busy,
        })
    }

    /// The device's name in metrics and logs.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The device's health, now and as it changes.
    pub fn health(&self) -> watch::Receiver<Health> {
        self.health.clone()
    }

    /// What stands in the way of work; nothing where the device has passed its trial and, if it
    /// works, has given a sign of life a moment ago.
    pub fn obstacle(&self) -> Option<String> {
        match &*self.health.borrow() {
            Health::Starting => Some(format!("{} is being tried", self.name)),
            Health::Broken(reason) => Some(format!("{}: {reason}", self.name)),
            Health::Ready => {
                let silence = self.busy.silence();
                (silence > LONGEST_SILENCE).then(|| {
                    format!(
                        "{} gave no sign of life for {} s",
                        self.name,
                        silence.as_secs()
                    )
                })
            }
        }
    }

    /// How long the device has worked in all.
    pub fn busy(&self) -> Duration {
        self.busy.total()
    }

    /// Estimates one pair's flow on the device.
    ///
    /// # Errors
    /// [`EngineError`]; the device is ready for the next pair, or says otherwise in its health.
    pub async fn solve(&self, work: Work) -> Result<Solved, EngineError> {
        let gone = || EngineError::Broken("its thread has ended".to_owned());
        let (reply, answer) = oneshot::channel();
        let command = Command { work, reply };
        self.commands.send(command).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }
}

/// Silence in the middle of work after which a device is not taken for ready.
const LONGEST_SILENCE: Duration = Duration::from_secs(30);

/// Time at work, the current piece of it included.
#[derive(Debug)]
struct Busy {
    epoch: Instant,
    /// Microseconds after `epoch` of the latest sign of life.
    alive: AtomicU64,
    before_micros: AtomicU64,
    /// Microseconds after `epoch` at which the current piece began, plus one; zero when idle.
    since: AtomicU64,
}

impl Default for Busy {
    fn default() -> Self {
        Self {
            epoch: Instant::now(),
            alive: AtomicU64::new(0),
            before_micros: AtomicU64::new(0),
            since: AtomicU64::new(0),
        }
    }
}

impl Busy {
    fn now(&self) -> u64 {
        u64::try_from(self.epoch.elapsed().as_micros()).unwrap_or(u64::MAX - 1)
    }

    fn sign_of_life(&self) {
        self.alive.store(self.now(), Ordering::Relaxed);
    }

    /// How long nothing has been heard in the middle of work.
    fn silence(&self) -> Duration {
        if self.since.load(Ordering::Relaxed) == 0 {
            return Duration::ZERO;
        }
        let heard = self.alive.load(Ordering::Relaxed);
        Duration::from_micros(self.now().saturating_sub(heard))
    }

    fn begin(&self) {
        self.sign_of_life();
        self.since.store(self.now() + 1, Ordering::Relaxed);
    }

    fn end(&self) {
        let since = self.since.swap(0, Ordering::Relaxed);
        let took = (self.now() + 1).saturating_sub(since);
        self.before_micros.fetch_add(took, Ordering::Relaxed);
    }

    fn total(&self) -> Duration {
        let before = self.before_micros.load(Ordering::Relaxed);
        let current = match self.since.load(Ordering::Relaxed) {
            0 => 0,
            since => (self.now() + 1).saturating_sub(since),
        };
        Duration::from_micros(before + current)
    }
}

/// The thread: opens, tries, works, and opens again after a panic.
fn run(
    open: &Opener,
    mut inbox: mpsc::Receiver<Command>,
    tell: &watch::Sender<Health>,
    busy: &Busy,
) {
    const FIRST_PAUSE: Duration = Duration::from_millis(200);
    const LONGEST_PAUSE: Duration = Duration::from_secs(30);
    let mut pause = FIRST_PAUSE;
    loop {
        tell.send_replace(Health::Starting);
        match open_and_try(open) {
            Ok(backend) => {
                pause = FIRST_PAUSE;
                tell.send_replace(Health::Ready);
                if work_until_panic(backend.as_ref(), &mut inbox, busy).is_none() {
                    return;
                }
            }
            Err(reason) => {
                tracing::error!(%reason, "the device cannot be used");
                tell.send_replace(Health::Broken(reason));
                if inbox.is_closed() {
                    return;
                }
                thread::sleep(pause);
                pause = (pause * 2).min(LONGEST_PAUSE);
            }
        }
    }
}

fn open_and_try(open: &Opener) -> Result<Box<dyn Backend>, String> {
    let tried = catch_unwind(AssertUnwindSafe(|| {
        let backend = open().map_err(|error| error.to_string())?;
        trial::run(backend.as_ref())?;
        Ok(backend)
    }));
    tried.unwrap_or_else(|panic| Err(message(panic.as_ref())))
}

/// Works until there is no more work, or until a panic.
fn work_until_panic(
    backend: &dyn Backend,
    inbox: &mut mpsc::Receiver<Command>,
    busy: &Busy,
) -> Option<()> {
    while let Some(Command { work, reply }) = inbox.blocking_recv() {
        busy.begin();
        let solved = catch_unwind(AssertUnwindSafe(|| solve(backend, work, busy)));
        busy.end();
        let (answer, panicked) = match solved {
            Ok(answer) => {
                let solved = answer.map(|estimate| Solved {
                    estimate,
                    device: backend.name(),
                });
                (solved.map_err(EngineError::from), None)
            }
            Err(panic) => {
                let message = message(panic.as_ref());
                (Err(EngineError::Panicked(message)), Some(()))
            }
        };
        let _nobody_waits_is_fine = reply.send(answer);
        if panicked.is_some() {
            return panicked;
        }
    }
    None
}

/// Passes everything on, and hears the signs of life.
struct Heard<'a> {
    watch: &'a dyn Watch,
    busy: &'a Busy,
}

impl Watch for Heard<'_> {
    fn seconds(&self) -> f64 {
        self.watch.seconds()
    }

    fn seconds_left(&self) -> Option<f64> {
        self.watch.seconds_left()
    }

    fn interrupt(&self) -> Option<Interrupt> {
        self.busy.sign_of_life();
        self.watch.interrupt()
    }

    fn progress(&self, progress: Progress) {
        self.watch.progress(progress);
    }

    fn snapshot_due(&self) -> bool {
        self.watch.snapshot_due()
    }

    fn snapshot(&self, snapshot: Snapshot) {
        self.watch.snapshot(snapshot);
    }
}

fn solve(backend: &dyn Backend, work: Work, busy: &Busy) -> Result<Estimate, FlowError> {
    let watch = Heard {
        watch: work.watch.as_ref(),
        busy,
    };
    let ground = work.ground.as_ref();
    let problem = Problem {
        source: &work.source,
        target: &work.target,
        ground: ground.map(|[source, target]| [source.as_slice(), target.as_slice()]),
    };
    if let Some(snapshot) = work.snapshot {
        match flow::resume(backend, &problem, &work.options, snapshot, &watch) {
            Err(FlowError::Snapshot(error)) => {
                tracing::warn!(%error, "a snapshot is of no use: the job starts afresh");
            }
            resumed => return resumed,
        }
    }
    flow::estimate(backend, &problem, &work.options, &watch)
}

/// What a panic said.
fn message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "without a word".to_owned())
}
