//! Helpers for attacks: malformed bytes on the wire, and checks of the server afterwards.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use reqwest::StatusCode;

use crate::clouds::{form, small_pair};
use crate::server::{Folder, PATIENCE, Server};

/// The options of a request of a few hundredths of a second.
pub(crate) const SMALL: &str = r#"{"preset": "neural", "max_points": 512}"#;

/// Maximum memory growth of the server after an attack, bytes.
pub(crate) const MAX_GROWTH: u64 = 64 << 20;

/// A server under attack, and its resident memory before it.
pub(crate) struct Besieged {
    pub(crate) server: Server,
    resident: u64,
}

impl Besieged {
    /// A server that has already solved some pairs, so that its working memory is allocated.
    pub(crate) async fn new(config: &str) -> Self {
        Self::with(config, &[]).await
    }

    /// The same with additional arguments.
    pub(crate) async fn with(config: &str, arguments: &[&str]) -> Self {
        let server = Server::start_in(&Folder::new(), config, arguments);
        for _ in 0..3 {
            serves(&server).await;
        }
        let resident = server.resident_bytes();
        Self { server, resident }
    }

    /// Asserts that the memory has grown little, that a pair is still solved and that nothing
    /// panicked.
    pub(crate) async fn stands(&self) {
        self.has_not_grown();
        self.serves().await;
    }

    /// Asserts that a pair is still solved and that nothing panicked.
    pub(crate) async fn serves(&self) {
        serves(&self.server).await;
        let log = self.server.log();
        assert!(!log.contains("panicked"), "{log}");
    }

    /// Memory growth since the start of the attack, bytes.
    pub(crate) fn grown(&self) -> u64 {
        self.server.resident_bytes().saturating_sub(self.resident)
    }

    pub(crate) fn has_not_grown(&self) {
        let grown = self.grown();
        assert!(grown < MAX_GROWTH, "it has grown by {} MiB", grown >> 20);
    }
}

/// Asserts that a small pair is solved.
pub(crate) async fn serves(server: &Server) {
    let sent = reqwest::Client::new()
        .post(server.url("/v1/flow"))
        .header("connection", "close")
        .multipart(form(small_pair(), SMALL))
        .send();
    let answer = sent.await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::OK, "{}", server.log());
}

/// A connection to the public port.
pub(crate) fn connect(server: &Server) -> TcpStream {
    let stream = TcpStream::connect(&server.public).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    stream.set_write_timeout(Some(PATIENCE)).expect("a timeout");
    stream.set_nodelay(true).expect("an option");
    stream
}

/// Sends bytes and reads until the server closes the connection.
pub(crate) fn exchange(server: &Server, bytes: &[u8]) -> String {
    let mut stream = connect(server);
    // A server that has already refused need not read the rest.
    let _refused_early = stream.write_all(bytes);
    until_closed(stream)
}

/// Reads until the server closes the connection.
pub(crate) fn until_closed(mut stream: TcpStream) -> String {
    let began = Instant::now();
    let mut all = Vec::new();
    let mut piece = [0; 4096];
    loop {
        match stream.read(&mut piece) {
            Ok(0) => break,
            Ok(count) => all.extend_from_slice(&piece[..count]),
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionReset => break,
            Err(error) => panic!("it was not closed: {error}"),
        }
        assert!(began.elapsed() < PATIENCE, "it goes on");
    }
    String::from_utf8_lossy(&all).into_owned()
}

/// The status of an HTTP/1.1 response; none if there is no status line.
pub(crate) fn status(answer: &str) -> Option<u16> {
    answer
        .strip_prefix("HTTP/1.1 ")
        .or_else(|| answer.strip_prefix("HTTP/1.0 "))?
        .get(..3)?
        .parse()
        .ok()
}

/// A multipart body of named parts, with the boundary `x`.
pub(crate) fn multipart(parts: &[(&str, &[u8])]) -> Vec<u8> {
    let mut body = Vec::new();
    for (name, bytes) in parts {
        let file = if *name == "options" {
            ""
        } else {
            "; filename=\"a.npy\""
        };
        let head = format!("--x\r\ncontent-disposition: form-data; name=\"{name}\"{file}\r\n\r\n");
        body.extend(head.as_bytes());
        body.extend(*bytes);
        body.extend(b"\r\n");
    }
    body.extend(b"--x--\r\n");
    body
}

/// The head of a request with a multipart body, without the blank line.
pub(crate) fn post(path: &str, headers: &str) -> String {
    format!(
        "POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: multipart/form-data; boundary=x\r\n\
         {headers}"
    )
}

/// An HTTP/2 connection that is written frame by frame.
pub(crate) struct Frames {
    stream: TcpStream,
}

/// A received frame.
pub(crate) struct Frame {
    pub(crate) kind: u8,
    pub(crate) flags: u8,
    pub(crate) payload: Vec<u8>,
}

pub(crate) const DATA: u8 = 0;
pub(crate) const HEADERS: u8 = 1;
pub(crate) const RST_STREAM: u8 = 3;
pub(crate) const SETTINGS: u8 = 4;
pub(crate) const PING: u8 = 6;
pub(crate) const GOAWAY: u8 = 7;
pub(crate) const WINDOW_UPDATE: u8 = 8;
pub(crate) const CONTINUATION: u8 = 9;
pub(crate) const END_STREAM: u8 = 1;
pub(crate) const END_HEADERS: u8 = 4;

impl Frames {
    pub(crate) fn open(server: &Server) -> Self {
        let mut stream = connect(server);
        stream
            .write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n")
            .expect("sent");
        stream.write_all(&frame(SETTINGS, 0, 0, &[])).expect("sent");
        Self { stream }
    }

    /// Sends bytes from a separate thread, since the server may respond before it has read them.
    pub(crate) fn send(&self, bytes: Vec<u8>) {
        let mut stream = self.stream.try_clone().expect("a handle");
        std::thread::spawn(move || {
            let _cut_off_is_fine = stream.write_all(&bytes);
        });
    }

    /// The next frame; none if the connection is closed.
    pub(crate) fn next(&mut self) -> Option<Frame> {
        let mut head = [0; 9];
        self.stream.read_exact(&mut head).ok()?;
        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
        let mut payload = vec![0; length as usize];
        self.stream.read_exact(&mut payload).ok()?;
        Some(Frame {
            kind: head[3],
            flags: head[4],
            payload,
        })
    }

    /// The last stream id and the error code of the next GOAWAY frame. Panics if none arrives.
    pub(crate) fn goaway(&mut self) -> (u32, u32) {
        while let Some(frame) = self.next() {
            if frame.kind == GOAWAY {
                let word = |at: usize| {
                    let bytes = frame.payload[at..at + 4].try_into();
                    u32::from_be_bytes(bytes.expect("four bytes"))
                };
                return (word(0), word(4));
            }
        }
        panic!("it was closed without a GOAWAY")
    }

    /// Answers pings and settings, and nothing else, from a separate thread until the server closes
    /// the connection. The thread returns the time until then.
    pub(crate) fn answer_pings(mut self) -> std::thread::JoinHandle<Duration> {
        const ACK: u8 = 1;
        std::thread::spawn(move || {
            let began = Instant::now();
            while let Some(frame) = self.next() {
                assert!(began.elapsed() < PATIENCE, "it is kept open");
                let answer = match (frame.kind, frame.flags & ACK) {
                    (PING, 0) => self::frame(PING, ACK, 0, &frame.payload),
                    (SETTINGS, 0) => self::frame(SETTINGS, ACK, 0, &[]),
                    _ => continue,
                };
                if self.stream.write_all(&answer).is_err() {
                    break;
                }
            }
            assert!(began.elapsed() < PATIENCE, "it is kept open");
            began.elapsed()
        })
    }

    /// Closes the connection, by a reset if `by_reset`.
    pub(crate) fn hang_up(self, by_reset: bool) {
        if !by_reset {
            // Without the shutdown, unread data makes the system send a reset.
            let _gone_is_fine = self.stream.shutdown(std::net::Shutdown::Both);
        }
    }

    /// Sets the timeout of a read.
    pub(crate) fn patience(&self, patience: Duration) {
        let set = self.stream.set_read_timeout(Some(patience));
        set.expect("a timeout");
    }
}

/// The bytes of a frame.
pub(crate) fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).expect("a small frame");
    let mut bytes = length.to_be_bytes()[1..].to_vec();
    bytes.extend([kind, flags]);
    bytes.extend(stream.to_be_bytes());
    bytes.extend(payload);
    bytes
}

/// A header field as a literal without indexing.
pub(crate) fn field(name: &str, value: &str) -> Vec<u8> {
    let mut bytes = vec![0];
    for text in [name, value] {
        bytes.push(u8::try_from(text.len()).expect("short"));
        bytes.extend(text.as_bytes());
    }
    bytes
}

/// The header block of a request.
pub(crate) fn head(method: &str, path: &str) -> Vec<u8> {
    let fields = [
        (":method", method),
        (":scheme", "http"),
        (":path", path),
        (":authority", "localhost"),
    ];
    fields
        .iter()
        .flat_map(|(name, value)| field(name, value))
        .collect()
}
