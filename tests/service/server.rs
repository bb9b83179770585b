//! Runs the real server on free ports, and stops or kills it.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::process_memory::memory_bytes;

/// Timeout that suffices on a loaded machine. Only a failing test waits this long.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// Arguments of a server that takes free ports.
pub(crate) const FREE_PORTS: [&str; 5] = [
    "serve",
    "--listen",
    "127.0.0.1:0",
    "--admin-listen",
    "127.0.0.1:0",
];

/// A running server. It is killed on drop.
pub(crate) struct Server {
    child: Child,
    pub(crate) public: String,
    pub(crate) admin: String,
    log: Arc<Mutex<String>>,
    folder: Folder,
}

/// A temporary folder for the configuration and the data of a server.
#[derive(Clone)]
pub(crate) struct Folder(Arc<tempfile::TempDir>);

impl Folder {
    pub(crate) fn new() -> Self {
        Self(Arc::new(tempfile::tempdir().expect("a folder")))
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }
}

/// Names the cryptography of all clients of this process, which reqwest leaves to the program.
pub(crate) fn name_cryptography() {
    let _is_named = rustls::crypto::ring::default_provider().install_default();
}

impl Server {
    /// A new server with the default configuration and these additional arguments.
    pub(crate) fn start(arguments: &[&str]) -> Self {
        Self::start_in(&Folder::new(), "", arguments)
    }

    /// A new server with these lines of configuration.
    pub(crate) fn with_config(config: &str) -> Self {
        Self::start_in(&Folder::new(), config, &[])
    }

    /// A server on the data of an earlier one.
    pub(crate) fn start_in(folder: &Folder, config: &str, arguments: &[&str]) -> Self {
        let program = Command::new(env!("CARGO_BIN_EXE_fnsf"));
        Self::start_as(program, folder, config, arguments)
    }

    /// A new server started by a shell after some commands, such as `ulimit -n 100`.
    pub(crate) fn start_after(commands: &str, config: &str) -> Self {
        let mut shell = Command::new("sh");
        let program = env!("CARGO_BIN_EXE_fnsf");
        shell.args(["-c", &format!("{commands}; exec \"$0\" \"$@\""), program]);
        Self::start_as(shell, &Folder::new(), config, &[])
    }

    /// A new node of a queue that others share, with these variables of the environment.
    pub(crate) fn node(config: &str, role: &str, variables: &[(&str, &str)]) -> Self {
        let mut program = Command::new(env!("CARGO_BIN_EXE_fnsf"));
        program.envs(variables.iter().copied());
        let arguments = ["--role", role, "--device", "cpu:1"];
        Self::start_as(program, &Folder::new(), config, &arguments)
    }

    /// A server with these variables of the environment.
    pub(crate) fn start_with(folder: &Folder, config: &str, variables: &[(&str, String)]) -> Self {
        let mut program = Command::new(env!("CARGO_BIN_EXE_fnsf"));
        program.envs(variables.iter().map(|(name, value)| (name, value)));
        Self::start_as(program, folder, config, &[])
    }

    fn start_as(program: Command, folder: &Folder, config: &str, arguments: &[&str]) -> Self {
        Self::start_on(program, &FREE_PORTS, folder, config, arguments)
    }

    /// Kills the server as a crash would, and starts it again on the same public port.
    pub(crate) fn killed_and_started(self, config: &str) -> Self {
        let public = self.public.clone();
        let folder = self.kill();
        let program = Command::new(env!("CARGO_BIN_EXE_fnsf"));
        let mut ports = FREE_PORTS;
        ports[2] = &public;
        Self::start_on(program, &ports, &folder, config, &[])
    }

    /// Starts a server with the command and the ports that `serve` names.
    fn start_on(
        mut program: Command,
        serve: &[&str],
        folder: &Folder,
        config: &str,
        arguments: &[&str],
    ) -> Self {
        name_cryptography();
        let file: PathBuf = folder.path().join("fnsf.toml");
        std::fs::write(&file, config).expect("a file");
        let mut child = program
            .args(serve)
            .arg("--data-dir")
            .arg(folder.path().join("data"))
            .arg("--config")
            .arg(&file)
            // The CPU by default, for identical results on every machine. A test may override it.
            .env("FNSF_SERVE_DEVICES", "[\"cpu\"]")
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let log = Arc::new(Mutex::new(String::new()));
        keep(child.stderr.take().expect("piped"), Arc::clone(&log));
        let mut said = String::new();
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        stdout.read_line(&mut said).expect("a line");
        let mut words = said.split([' ', ',', '\n']);
        let addresses: Vec<String> = words
            .by_ref()
            .filter(|word| word.starts_with("127.0.0.1:"))
            .map(str::to_owned)
            .collect();
        let (public, admin) = match addresses.as_slice() {
            [public, admin] => (public.clone(), admin.clone()),
            // A worker.
            [admin] => (String::new(), admin.clone()),
            _ => {
                let log = log.lock().expect("no panic holds it");
                panic!("it said {said:?} and logged {log}")
            }
        };
        let server = Self {
            child,
            public,
            admin,
            log,
            folder: folder.clone(),
        };
        server.until_ready();
        server
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// The URL of a path on the public port.
    pub(crate) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.public)
    }

    pub(crate) fn log(&self) -> String {
        self.log.lock().expect("no panic holds it").clone()
    }

    pub(crate) fn until_ready(&self) {
        self.until("it is ready", || self.is_ready());
    }

    /// Waits until a condition holds. Fails after `PATIENCE`.
    pub(crate) fn until(&self, what: &str, is_so: impl Fn() -> bool) {
        let began = Instant::now();
        while !is_so() {
            let log = self.log();
            assert!(
                began.elapsed() < PATIENCE,
                "it is not so that {what}: {log}"
            );
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// The data directory of the server.
    pub(crate) fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    /// CPU time used by the server, seconds.
    pub(crate) fn processor_seconds(&self) -> f64 {
        let about =
            std::fs::read_to_string(format!("/proc/{}/stat", self.id())).expect("it runs on Linux");
        // User and system time are fields 14 and 15. Counting starts after the program's name in
        // parentheses.
        let fields = about.rsplit(')').next().unwrap_or_default();
        let ticks = fields.split_whitespace().skip(11).take(2);
        let ticks = ticks.filter_map(|ticks| ticks.parse::<f64>().ok());
        ticks.sum::<f64>() / 100.0
    }

    /// Whether the admin port reports readiness.
    pub(crate) fn is_ready(&self) -> bool {
        plain_get(&self.admin, "/readyz").is_some_and(|answer| answer.starts_with("HTTP/1.1 200"))
    }

    /// Resident memory of the server, bytes.
    pub(crate) fn resident_bytes(&self) -> u64 {
        memory_bytes(self.id(), "VmRSS:").expect("it runs on Linux")
    }

    /// The largest resident memory of the server so far, bytes.
    pub(crate) fn peak_resident_bytes(&self) -> u64 {
        memory_bytes(self.id(), "VmHWM:").expect("it runs on Linux")
    }

    /// Sends a signal to the server.
    pub(crate) fn signal(&self, name: &str) {
        let id = self.id().to_string();
        let sent = Command::new("kill")
            .args([&format!("-{name}"), &id])
            .status();
        assert!(sent.expect("kill is there").success());
    }

    /// Kills the server as a crash would, and waits until it has exited.
    pub(crate) fn kill(mut self) -> Folder {
        self.child.kill().expect("it runs");
        self.child.wait().expect("it ends");
        self.folder.clone()
    }

    /// Waits for the exit of the server, at most for `longest`.
    pub(crate) fn wait(&mut self, longest: Duration) -> Option<ExitStatus> {
        let began = Instant::now();
        while began.elapsed() < longest {
            if let Some(status) = self.child.try_wait().expect("it can be asked") {
                return Some(status);
            }
            thread::sleep(Duration::from_millis(10));
        }
        None
    }

    /// The value of a metric, summed over its series.
    pub(crate) fn metric(&self, name: &str) -> f64 {
        let page = plain_get(&self.admin, "/metrics").expect("metrics");
        let series = page.lines().filter(|line| {
            line.strip_prefix(name)
                .is_some_and(|rest| rest.starts_with(['{', ' ']) || name.ends_with('}'))
        });
        series
            .filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok())
            .sum()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _it_may_have_ended = self.child.kill();
        let _reaped = self.child.wait();
    }
}

/// Collects the log of a server.
fn keep(mut from: impl Read + Send + 'static, log: Arc<Mutex<String>>) {
    thread::spawn(move || {
        let mut piece = [0; 4096];
        while let Ok(count) = from.read(&mut piece) {
            if count == 0 {
                return;
            }
            let text = String::from_utf8_lossy(&piece[..count]).into_owned();
            log.lock().expect("no panic holds it").push_str(&text);
        }
    });
}

/// A GET request over a plain socket, for the admin port. Returns the whole response.
pub(crate) fn plain_get(address: &str, path: &str) -> Option<String> {
    use std::io::Write;
    let mut stream = std::net::TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(PATIENCE)).ok()?;
    let request = format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    Some(answer)
}

/// Waits until a job has ended, by long polling. Returns its JSON document. Fails if the job stands
/// still for three times `PATIENCE`, however long it takes on a loaded machine.
pub(crate) async fn ended(server: &Server, id: &str) -> Value {
    let mut moved = Instant::now();
    let mut before = Value::Null;
    loop {
        let url = server.url(&format!("/v1/jobs/{id}?wait=20"));
        let job: Value = reqwest::get(url)
            .await
            .expect("an answer")
            .json()
            .await
            .expect("a job");
        let state = job["state"].as_str().unwrap_or_else(|| panic!("{job}"));
        if !matches!(state, "queued" | "running") {
            return job;
        }
        if job != before {
            moved = Instant::now();
        }
        assert!(moved.elapsed() < PATIENCE * 3, "it stands still: {job}");
        before = job;
    }
}
