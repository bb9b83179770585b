//! A PostgreSQL server of the tests: a new cluster in a temporary folder, on a Unix
//! socket there.

use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// A new server, which the test may crash.
///
/// Without PostgreSQL the test is skipped with a message, unless `FNSF_REQUIRE_POSTGRES=1` makes it
/// fail.
pub(crate) fn start_postgres() -> Option<PostgresServer> {
    let server = programs().map(|programs| PostgresServer::start(&programs));
    let is_required = std::env::var_os("FNSF_REQUIRE_POSTGRES").is_some_and(|value| value == "1");
    assert!(
        server.is_some() || !is_required,
        "FNSF_REQUIRE_POSTGRES is set and PostgreSQL is not installed: apt-get install postgresql"
    );
    if server.is_none() {
        eprintln!("PostgreSQL is not installed: what needs it is not tested");
    }
    server
}

/// The folder of `initdb` and `postgres`: Debian keeps them out of the path.
fn programs() -> Option<PathBuf> {
    let versions = std::fs::read_dir("/usr/lib/postgresql")
        .into_iter()
        .flatten();
    let debian = versions.flatten().map(|version| version.path().join("bin"));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let on_path: Vec<_> = std::env::split_paths(&path).collect();
    let has_both = |folder: &PathBuf| {
        ["initdb", "postgres"]
            .iter()
            .all(|p| folder.join(p).exists())
    };
    debian.chain(on_path).find(has_both)
}

/// A running server.
pub(crate) struct PostgresServer {
    folder: tempfile::TempDir,
    programs: PathBuf,
    databases: AtomicU32,
    /// Holds the pipe at whose end the server is stopped: when this process has ended.
    _keeper: Child,
}

/// Root may not run the server: it runs as the user that its package has made.
fn as_its_user(command: &mut Command) -> &mut Command {
    match user() {
        Some((user, group)) => command.uid(user).gid(group),
        None => command,
    }
}

/// The ids of the user and group `postgres`, if this process is root's.
fn user() -> Option<(u32, u32)> {
    let id = |of: &[&str]| {
        let said = Command::new("id")
            .args(of)
            .output()
            .expect("id runs")
            .stdout;
        String::from_utf8_lossy(&said).trim().parse::<u32>().ok()
    };
    match id(&["-u"]) {
        Some(0) => Some((
            id(&["-u", "postgres"]).expect("a user postgres"),
            id(&["-g", "postgres"]).expect("a group postgres"),
        )),
        _ => None,
    }
}

impl PostgresServer {
    fn start(programs: &Path) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let everybody = std::fs::Permissions::from_mode(0o777);
        std::fs::set_permissions(folder.path(), everybody).expect("a folder for its user");
        let mut initdb = Command::new(programs.join("initdb"));
        initdb.args([
            "--auth=trust",
            "--username=fnsf",
            "--encoding=UTF8",
            "--no-locale",
        ]);
        let made = as_its_user(&mut initdb)
            .arg("--pgdata")
            .arg(folder.path().join("data"))
            .current_dir(folder.path())
            .output()
            .expect("initdb runs");
        assert!(
            made.status.success(),
            "{}",
            String::from_utf8_lossy(&made.stderr)
        );
        let keeper = Self::run(programs, folder.path());
        Self {
            folder,
            programs: programs.to_owned(),
            databases: AtomicU32::new(0),
            _keeper: keeper,
        }
    }

    /// Starts the server and waits until it answers.
    fn run(programs: &Path, folder: &Path) -> Child {
        let script = "trap '' INT TERM; rm -f .ready
            \"$1\"/pg_ctl -D \"$2\"/data -l \"$2\"/log -w -t 60 -o \"-k $2 -c listen_addresses= \
                -c max_connections=400 -c fsync=on\" start >/dev/null 2>&1 && echo up
            read -r _
            \"$1\"/pg_ctl -D \"$2\"/data -m immediate stop >/dev/null 2>&1
            rm -rf \"$2\"/data";
        let mut shell = Command::new("sh");
        shell.args(["-c", script, "sh"]).arg(programs).arg(folder);
        let shell = as_its_user(&mut shell)
            .current_dir(folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            // A signal to the tests must not end it before it has stopped the server.
            .process_group(0);
        let mut keeper = shell.spawn().expect("sh runs");
        let mut said = String::new();
        let out = keeper.stdout.take().expect("its words");
        BufReader::new(out).read_line(&mut said).expect("its words");
        let log = || std::fs::read_to_string(folder.join("log")).unwrap_or_default();
        assert_eq!(said.trim(), "up", "{}", log());
        keeper
    }

    /// Makes a new database and returns its URL.
    pub(crate) fn database(&self) -> String {
        let number = self.databases.fetch_add(1, Ordering::Relaxed);
        let name = format!("test{number}");
        self.sql("postgres", &format!("CREATE DATABASE {name}"));
        self.url(&name)
    }

    /// The URL of a database.
    pub(crate) fn url(&self, name: &str) -> String {
        format!(
            "host={} user=fnsf dbname={name}",
            self.folder.path().display()
        )
    }

    /// Runs a statement and returns what it says.
    pub(crate) fn sql(&self, database: &str, text: &str) -> String {
        let ran = Command::new(self.programs.join("psql"))
            .args([
                "-X",
                "-q",
                "-A",
                "-t",
                "-v",
                "ON_ERROR_STOP=1",
                "-U",
                "fnsf",
                "-d",
                database,
            ])
            .arg("-h")
            .arg(self.folder.path())
            .args(["-c", text])
            .output()
            .expect("psql runs");
        let errors = String::from_utf8_lossy(&ran.stderr);
        assert!(ran.status.success(), "{text}: {errors}");
        String::from_utf8_lossy(&ran.stdout).trim().to_owned()
    }

    /// Stops the server as a crash does, and starts it again.
    pub(crate) fn crash(&self) {
        let folder = self.folder.path();
        let mut restart = Command::new(self.programs.join("pg_ctl"));
        let done = as_its_user(&mut restart)
            .args(["-m", "immediate", "-w", "-t", "60", "-D"])
            .arg(folder.join("data"))
            .arg("-l")
            .arg(folder.join("log"))
            .arg("restart")
            .current_dir(folder)
            .stdout(Stdio::null())
            .status()
            .expect("pg_ctl runs");
        assert!(done.success(), "it starts again");
    }
}
