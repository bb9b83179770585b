//! The start of the server: checks, stores, devices, workers, ports, in this order.

use std::net::SocketAddr;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use anyhow::{Context, anyhow};
use tokio::sync::watch;
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;

use super::devices::Pool;
use super::outbox::Outbox;
use super::settings::{
    admission_limits, deliveries, keys, listen_options, service_limits, sources, webhooks,
};
use super::stores::{Stores, warn_of_stranded_jobs};
use super::{housekeeping, process};
use crate::api::{
    Admission, DeviceView, Hosts, Keys, ListenOptions, Listener, Readiness, Service, ServiceParts,
    TlsSetup, admin_router, public_router, tls_acceptor,
};
use crate::config::{Config, NodeRole};
use crate::cost::CostModel;
use crate::engine::{Device, Health};
use crate::health::Heartbeat;
use crate::job::DeviceKind;
use crate::metrics::Metrics;
use crate::queue::Queue;
use crate::remote::{Deliveries, Remotes, Sources, Webhooks};
use crate::worker::{Drain, IsolationLock, Worker, WorkerOptions};

/// A running server: its ports, devices, workers, stores and background tasks. [`App::drain`]
/// stops it.
pub struct App {
    public: Option<SocketAddr>,
    admin: SocketAddr,
    pub(super) config: Config,
    pub(super) service: Arc<Service>,
    pub(super) devices: Vec<Device>,
    pub(super) workers: JoinSet<()>,
    pub(super) workers_drain: Drain,
    pub(super) draining: watch::Sender<bool>,
    pub(super) queue: Arc<dyn Queue>,
    pub(super) tls: Option<Arc<TlsSetup>>,
    pub(super) listener: JoinHandle<()>,
    pub(super) stop_listening: CancellationToken,
    pub(super) upkeep: JoinSet<()>,
}

impl App {
    /// Starts the server: the stores, the devices, the workers, the public port and the admin port,
    /// in this order. When it returns, both ports answer. The devices may not have passed their
    /// self-tests yet.
    ///
    /// It changes the process: the umask becomes 077, SIGXFSZ no longer ends the process, the limit
    /// of open files is raised to its hard limit, and TLS clients use ring.
    ///
    /// # Errors
    /// - [`App::check`] refuses the configuration.
    /// - The data folder cannot be used, its disk is full, or another process uses it.
    /// - The database or the bucket cannot be reached or used.
    /// - The queue has another schema version.
    /// - The payloads are not those of the queue, or the queue file is missing beside payloads.
    /// - A TLS file cannot be used, or the certificate and the key do not match.
    /// - A port cannot be bound, or a thread cannot be started.
    pub async fn start(config: Config) -> anyhow::Result<Self> {
        config.check()?;
        let pool = Pool::of(&config)?;
        Self::start_on(pool, config).await
    }

    /// The same on devices that are chosen already.
    pub(super) async fn start_on(pool: Pool, config: Config) -> anyhow::Result<Self> {
        let lanes = pool.lanes();
        let names: Vec<_> = pool.devices.iter().map(|device| &device.name).collect();
        let metrics = Arc::new(Metrics::new(&names));
        if pool.fell_back {
            metrics.fell_back();
            tracing::warn!(
                "no GPU was found that works: the CPU does the work; fnsf doctor says why"
            );
        }
        let keys = keys(&config)?;
        let webhooks = webhooks(&config.remote)?;
        let places = sources(&config.remote)?;
        let results = deliveries(&config.remote)?;
        process::keep_files_private();
        process::survive_file_limits();
        process::name_tls_provider();
        let open_files = process::raise_open_files();
        let (stores, events) = Stores::open(&config).await?;
        if config.queue.postgres.is_none() {
            warn_of_stranded_jobs(stores.queue.as_ref(), lanes);
        }

        let mut devices = Vec::new();
        for device in pool.devices {
            devices.push(Device::start(device, &metrics)?);
        }
        let cost = Arc::new(CostModel::new(lanes));
        let workers_drain = Drain::default();
        let workers = start_workers(&devices, &stores, &cost, &metrics, &workers_drain, &config);
        let keys_are_open = keys.is_open();
        let allows_private = config.remote.allow_private_addresses;
        let webhooks = match webhooks {
            None => Webhooks::default(),
            Some((allowed, secret)) => Webhooks::new(allowed, secret, allows_private),
        };
        let sources = Sources::new(places, allows_private).context("remote.sweeps")?;
        let remotes = Remotes {
            webhooks: webhooks.clone(),
            sources,
            deliveries: Deliveries::new(results).context("remote.results")?,
        };
        let parts = (keys, remotes);
        let service = Arc::new(service(&stores, &devices, &cost, &metrics, parts, &config));
        let runtime = Arc::new(Heartbeat::default());
        let outbox = Outbox {
            queue: Arc::clone(&stores.queue),
            blobs: stores.blobs.clone(),
            service: Arc::clone(&service),
            webhooks,
            metrics: Arc::clone(&metrics),
            bell: Arc::default(),
        };
        let mut upkeep = housekeeping::start(
            &stores.queue,
            &stores.blobs,
            &metrics,
            &devices,
            (events, Arc::clone(&outbox.bell)),
            (&stores.probe, &runtime),
        );
        upkeep.spawn(outbox.run());
        upkeep.spawn(housekeeping::exchange(
            Arc::clone(&stores.queue),
            Arc::clone(&cost),
        ));
        let tls = tls(&config)?;
        let listener = match config.role {
            NodeRole::Worker => None,
            _ => {
                let mut options = listen_options(&config.limits);
                options.needs_key = !keys_are_open;
                Some(
                    open_listener(config.listen, tls.clone(), options, open_files, &metrics)
                        .await?,
                )
            }
        };
        let public = listener.as_ref().map(Listener::address).transpose()?;
        let mut loops = vec![("the runtime", runtime)];
        loops.extend(
            listener
                .as_ref()
                .map(|listener| ("the public port", listener.heartbeat())),
        );
        let (draining, drains) = watch::channel(false);
        let readiness = Readiness {
            devices: devices.clone(),
            draining: drains,
            store: stores.health,
            loops,
        };
        let following = housekeeping::follow_readiness(readiness.clone(), Arc::clone(&service));
        upkeep.spawn(following);
        let queue = stores.queue;
        let admin = serve_admin(&config, readiness, &metrics, &queue, &cost)?;
        let stop_listening = CancellationToken::new();
        let router = public_router(&service, config.console);
        let stop = stop_listening.clone();
        let listener = tokio::spawn(async move {
            match listener {
                Some(listener) => listener.serve(router, stop).await,
                None => stop.cancelled().await,
            }
        });
        Ok(Self {
            public,
            admin,
            config,
            service,
            devices,
            workers,
            workers_drain,
            draining,
            queue,
            tls,
            listener,
            stop_listening,
            upkeep,
        })
    }

    /// Checks a configuration without starting the server. GPUs are listed but not opened. Ports,
    /// the data folder, the TLS files, `log.filter` and `otlp_endpoint` are not checked.
    ///
    /// # Errors
    /// - [`Config::check`] refuses a value.
    /// - An entry of `devices` has none of its forms, or names more than 256 or no threads.
    /// - An entry of `devices` names a GPU that the machine does not have.
    /// - An API key is shorter than 16 characters, is given twice, is not printable ASCII, or has
    ///   white space at an end.
    /// - A tenant name is not 1 to 64 letters, digits, `-`, `_` or `.`.
    /// - A prefix of sweeps or results, a prefix or the secret of webhooks is invalid, or the secret is missing.
    pub fn check(config: &Config) -> anyhow::Result<()> {
        config.check()?;
        Pool::unopened(config)?;
        keys(config)?;
        webhooks(&config.remote)?;
        sources(&config.remote)?;
        deliveries(&config.remote)?;
        Ok(())
    }

    /// The bound address of the public port, which serves HTTP and gRPC. `None` for a worker.
    pub fn public_address(&self) -> Option<SocketAddr> {
        self.public
    }

    /// The bound address of the admin port, which serves health checks and metrics.
    pub fn admin_address(&self) -> SocketAddr {
        self.admin
    }

    /// Waits until a device has been opened and has passed its self-test; not at all without
    /// devices. It waits for the first
    /// try of each device in the order of the configuration, and returns at the first success.
    ///
    /// # Errors
    /// If every device could not be opened or failed its self-test, with the reason of each. They
    /// are still retried in the background.
    pub async fn ready(&self) -> anyhow::Result<()> {
        if self.devices.is_empty() {
            return Ok(());
        }
        let mut reasons = Vec::new();
        for device in &self.devices {
            let mut health = device.health();
            let tried = health
                .wait_for(|health| *health != Health::Starting)
                .await?;
            match &*tried {
                Health::Broken(reason) | Health::Gone(reason) => {
                    reasons.push(format!("{}: {reason}", device.name()));
                }
                _ => return Ok(()),
            }
        }
        Err(anyhow!(
            "no device can be used: {}; fnsf doctor says more, --device cpu does without a GPU",
            reasons.join("; ")
        ))
    }

    /// Waits until only a restart of the process can repair a failure, and returns the reason:
    /// - A device that has worked cannot be reopened ([`Health::Gone`]), and no other device of its
    ///   kind is expected to work ([`Device::may_work`]).
    /// - The thread of the queue has ended.
    /// - The public port has closed.
    /// - A worker or a background task has panicked.
    ///
    /// # Panics
    /// If it is called again after the public port has closed.
    pub async fn given_up(&mut self) -> String {
        let (queue, listener) = (Arc::clone(&self.queue), &mut self.listener);
        let devices = devices_given_up(&self.devices);
        tokio::select! {
            reason = devices => reason,
            () = queue.ended() => "the queue's thread has ended".to_owned(),
            _ = listener => "the public port has closed".to_owned(),
            () = a_panic(&mut self.workers) => "a worker has panicked".to_owned(),
            () = a_panic(&mut self.upkeep) => "a background task has panicked".to_owned(),
        }
    }
}

/// One worker for each lane of the devices.
fn start_workers(
    devices: &[Device],
    stores: &Stores,
    cost: &Arc<CostModel>,
    metrics: &Arc<Metrics>,
    drain: &Drain,
    config: &Config,
) -> JoinSet<()> {
    let isolation = Arc::new(IsolationLock::default());
    let has_cpu = cost.own_lanes().cpu > 0;
    let mut workers = JoinSet::new();
    for lane in devices.iter().flat_map(Device::lanes) {
        let cpu_besides = lane.kind() == DeviceKind::Gpu && has_cpu;
        let worker = Worker {
            queue: Arc::clone(&stores.queue),
            blobs: stores.blobs.clone(),
            lane,
            cost: Arc::clone(cost),
            metrics: Arc::clone(metrics),
            options: WorkerOptions {
                snapshot_interval: Duration::from_millis(config.queue.snapshot_interval_ms),
                overflow_kind: cpu_besides.then_some(DeviceKind::Cpu),
            },
            drain: drain.clone(),
            isolation: Arc::clone(&isolation),
            store: Arc::clone(&stores.probe),
        };
        workers.spawn(worker.run());
    }
    workers
}

/// The service behind both protocols.
fn service(
    stores: &Stores,
    devices: &[Device],
    cost: &Arc<CostModel>,
    metrics: &Arc<Metrics>,
    (keys, remotes): (Keys, Remotes),
    config: &Config,
) -> Service {
    let is_loopback = config.listen.ip().is_loopback();
    let own = devices.to_vec();
    Service::new(ServiceParts {
        queue: Arc::clone(&stores.queue),
        blobs: stores.blobs.clone(),
        devices: Box::new(move || own.iter().map(device_view).collect()),
        admission: Admission::new(
            admission_limits(&config.limits),
            Arc::clone(&stores.queue),
            Arc::clone(cost),
        ),
        metrics: Arc::clone(metrics),
        keys,
        remotes,
        hosts: Hosts(is_loopback.then(|| config.allowed_hosts.clone())),
        store_health: Arc::clone(&stores.health),
        limits: service_limits(&config.limits),
    })
}

fn device_view(device: &Device) -> DeviceView {
    DeviceView {
        name: device.name().to_owned(),
        kind: device.kind().name(),
        lanes: device.lanes().len(),
        not_ready: device.not_ready_reason(),
    }
}

/// The certificate and the key of the public port.
fn tls(config: &Config) -> anyhow::Result<Option<Arc<TlsSetup>>> {
    let Some(tls) = &config.tls else {
        return Ok(None);
    };
    let acceptor = tls_acceptor(&tls.certificate, &tls.key)?;
    Ok(Some(Arc::new(TlsSetup::new(acceptor))))
}

/// The public port, with no more connections than the system allows open files.
async fn open_listener(
    address: SocketAddr,
    tls: Option<Arc<TlsSetup>>,
    mut options: ListenOptions,
    open_files: Option<usize>,
    metrics: &Arc<Metrics>,
) -> anyhow::Result<Listener> {
    if let Some(most) = open_files.filter(|&most| most < options.max_connections) {
        tracing::warn!(
            connections = most,
            "fewer connections than max_connections: the system allows no more open files \
             (ulimit -n)"
        );
        options.max_connections = most.max(1);
    }
    let listener = Listener::bind(address, tls, options, Some(Arc::clone(metrics)));
    listener
        .await
        .with_context(|| format!("cannot listen on {address}"))
}

/// Waits until one of the tasks panics.
async fn a_panic(tasks: &mut JoinSet<()>) {
    while let Some(ended) = tasks.join_next().await {
        if ended.is_err_and(|error| error.is_panic()) {
            return;
        }
    }
    std::future::pending::<()>().await;
}

/// Waits until the last device of a kind has worked, is lost, and does not come back.
async fn devices_given_up(devices: &[Device]) -> String {
    let mut healths: Vec<_> = devices.iter().map(Device::health).collect();
    if healths.is_empty() {
        return std::future::pending().await;
    }
    loop {
        if let Some(reason) = last_of_its_kind_is_gone(devices) {
            return reason;
        }
        let changes = healths.iter_mut().map(|health| Box::pin(health.changed()));
        let (changed, ..) = futures_util::future::select_all(changes).await;
        if changed.is_err() {
            return "a device's threads have ended".to_owned();
        }
    }
}

fn last_of_its_kind_is_gone(devices: &[Device]) -> Option<String> {
    DeviceKind::ALL.into_iter().find_map(|kind| {
        let of_kind = || devices.iter().filter(move |device| device.kind() == kind);
        let may_work = of_kind().any(Device::may_work);
        of_kind().find_map(|device| match &*device.health().borrow() {
            Health::Gone(reason) if !may_work => Some(format!("{}: {reason}", device.name())),
            _ => None,
        })
    })
}

/// Serves the admin port from a thread with a runtime of its own, to the end of the process.
fn serve_admin(
    config: &Config,
    readiness: Readiness,
    metrics: &Arc<Metrics>,
    queue: &Arc<dyn Queue>,
    cost: &Arc<CostModel>,
) -> anyhow::Result<SocketAddr> {
    let address = config.admin_listen;
    let socket = std::net::TcpListener::bind(address)
        .with_context(|| format!("cannot listen on {address}"))?;
    let bound = socket.local_addr()?;
    let is_loopback = bound.ip().is_loopback();
    let router = admin_router(
        Hosts(is_loopback.then(|| config.allowed_hosts.clone())),
        readiness,
        Arc::clone(metrics),
        Arc::clone(queue),
        Arc::clone(cost),
    );
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let serve = move || {
        let served = runtime.block_on(async move {
            let options = ListenOptions::of_admin();
            let listener = Listener::on(socket, options)?;
            listener.serve(router, CancellationToken::new()).await;
            std::io::Result::Ok(())
        });
        if let Err(error) = served {
            tracing::error!(%error, "the admin port has closed");
        }
    };
    thread::Builder::new()
        .name("admin".to_owned())
        .spawn(serve)?;
    Ok(bound)
}
