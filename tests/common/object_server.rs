//! An object store of the test process's own: moto, which speaks the protocol of S3, on a free port.

use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Runs moto on the port given as the argument. Moto's `put_object` checks `If-None-Match` and
/// writes in two steps, so that two clients can both create one object. S3 does both in one step.
/// The lock makes moto do the same.
const MOTO: &str = "
import sys, threading
from moto.s3.responses import S3Response
from moto.server import main

lock, put_object = threading.Lock(), S3Response.put_object

def one_at_a_time(self):
    with lock:
        return put_object(self)

S3Response.put_object = one_at_a_time
main(['-H', '127.0.0.1', '-p', sys.argv[1]])
";

/// A running object store with one empty bucket, `farm`. It is killed on drop.
pub(crate) struct ObjectServer {
    child: Child,
    address: String,
}

impl ObjectServer {
    /// Starts one. Without moto the test is skipped with a message, unless `FNSF_REQUIRE_MOTO=1`
    /// makes it fail.
    pub(crate) fn start() -> Option<Self> {
        let is_there = Command::new("python3")
            .args(["-c", "import moto.server"])
            .stderr(Stdio::null())
            .status()
            .is_ok_and(|status| status.success());
        let is_required = std::env::var_os("FNSF_REQUIRE_MOTO").is_some_and(|value| value == "1");
        assert!(
            is_there || !is_required,
            "FNSF_REQUIRE_MOTO is set and moto is not installed: pip install 'moto[server]'"
        );
        if !is_there {
            eprintln!("moto is not installed: what needs an object store is not tested");
            return None;
        }
        let free = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = free.local_addr().expect("an address").port();
        drop(free);
        let child = Command::new("python3")
            .args(["-c", MOTO, &port.to_string()])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("moto starts");
        let server = Self {
            child,
            address: format!("127.0.0.1:{port}"),
        };
        let began = Instant::now();
        while !server.makes_a_bucket("farm") {
            assert!(
                began.elapsed() < Duration::from_secs(60),
                "it does not answer"
            );
            std::thread::sleep(Duration::from_millis(50));
        }
        Some(server)
    }

    /// Host and port.
    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    /// Makes a bucket. Returns whether it is there then.
    pub(crate) fn makes_a_bucket(&self, name: &str) -> bool {
        let url = format!("http://{}/{name}", self.address());
        let made = Command::new("curl")
            .args(["-sf", "-o", "/dev/null", "-X", "PUT", &url])
            .status();
        made.is_ok_and(|status| status.success())
    }

    fn curl(&self, path: &str, arguments: &[&str]) -> Command {
        let url = format!("http://{}/farm/{path}", self.address());
        let mut curl = Command::new("curl");
        let signed = [
            "-sf",
            "--aws-sigv4",
            "aws:amz:us-east-1:s3",
            "--user",
            "test:test",
        ];
        curl.args(signed).args(arguments).arg(url);
        curl
    }

    /// Reads an object of the bucket.
    pub(crate) fn get(&self, path: &str) -> Vec<u8> {
        let read = self.curl(path, &[]).output().expect("curl starts");
        assert!(read.status.success(), "{path}");
        read.stdout
    }

    /// Writes an object into the bucket.
    pub(crate) fn put(&self, path: &str, bytes: &[u8]) {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), bytes).expect("writable");
        let name = file.path().to_string_lossy().into_owned();
        let written = self.curl(path, &["-T", &name]).status();
        assert!(written.is_ok_and(|status| status.success()), "{path}");
    }

    /// The variables of the environment that lead a client to it.
    pub(crate) fn variables(&self) -> Vec<(&'static str, String)> {
        vec![
            ("AWS_ENDPOINT_URL", format!("http://{}", self.address())),
            ("AWS_ALLOW_HTTP", "true".to_owned()),
            ("AWS_ACCESS_KEY_ID", "test".to_owned()),
            ("AWS_SECRET_ACCESS_KEY", "test".to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
        ]
    }
}

impl Drop for ObjectServer {
    fn drop(&mut self) {
        let _it_may_have_ended = self.child.kill();
        let _reaped = self.child.wait();
    }
}
