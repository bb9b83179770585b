//! Attacks by connections: slow, silent or numerous connections, and bodies without an end.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use fnsf::formats::CloudFormat;

use crate::clouds::{file, small_pair};
use crate::raw_http::{
    Besieged, SMALL, connect, exchange, multipart, post, serves, status, until_closed,
};
use crate::server::Server;

/// Interval between two bytes of a client that is slow on purpose.
const DRIP: Duration = Duration::from_millis(50);

/// Time within which a server with timeouts of one second must give up, on a loaded machine.
const GIVEN_UP: Duration = Duration::from_secs(20);

/// Sends bytes one by one until the server closes the connection, at most for `GIVEN_UP`. Returns
/// the response.
fn drip(mut stream: TcpStream, bytes: impl Iterator<Item = u8>) -> String {
    let began = Instant::now();
    stream.set_read_timeout(Some(DRIP)).expect("a timeout");
    let mut answer = Vec::new();
    let mut piece = [0; 4096];
    for byte in bytes {
        let sent = stream.write_all(&[byte]);
        match stream.read(&mut piece) {
            Ok(0) => break,
            Ok(count) => answer.extend_from_slice(&piece[..count]),
            Err(_) if sent.is_err() => break,
            Err(_) => {}
        }
        assert!(began.elapsed() < GIVEN_UP, "it is still read");
    }
    String::from_utf8_lossy(&answer).into_owned()
}

/// The multipart body of a small pair.
fn pair() -> Vec<u8> {
    let [source, target] = small_pair()
        .each_ref()
        .map(|points| file(CloudFormat::Npy, points));
    multipart(&[
        ("options", SMALL.as_bytes()),
        ("source", &source),
        ("target", &target),
    ])
}

/// A body in the chunked encoding of HTTP/1.1.
fn chunked(body: &[u8], size: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    for piece in body.chunks(size) {
        bytes.extend(format!("{:x}\r\n", piece.len()).as_bytes());
        bytes.extend(piece);
        bytes.extend(b"\r\n");
    }
    bytes.extend(b"0\r\n\r\n");
    bytes
}

fn until_connections(server: &Server, most: f64) {
    let began = Instant::now();
    while server.metric("fnsf_connections") > most {
        assert!(began.elapsed() < GIVEN_UP, "connections stay open");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[tokio::test]
async fn a_connection_that_is_silent_or_stalls_in_its_headers_is_closed() {
    let siege = Besieged::new("[limits]\nheader_timeout_seconds = 1\n").await;
    let answered = "GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n\r\n";
    let beginnings = [
        "",
        "P",
        "PRI * HTTP/2.0\r\n\r\nSM",
        "GET /openapi.js",
        "GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n",
        answered,
    ];
    let began = Instant::now();
    let streams = beginnings.map(|beginning| {
        let mut stream = connect(&siege.server);
        stream.write_all(beginning.as_bytes()).expect("sent");
        stream
    });
    for (stream, beginning) in streams.into_iter().zip(beginnings) {
        let answer = until_closed(stream);
        let good = if beginning == answered {
            status(&answer) == Some(200)
        } else {
            matches!(status(&answer), None | Some(400 | 408))
        };
        assert!(good, "{beginning:?}: {answer}");
        assert!(began.elapsed() < GIVEN_UP, "{beginning:?} was kept");
    }
    let mut stream = connect(&siege.server);
    stream
        .write_all(b"GET /openapi.json HTTP/1.1\r\n")
        .expect("sent");
    let answer = drip(stream, "a: b\r\n".bytes().cycle());
    assert_ne!(status(&answer), Some(200));
    siege.stands().await;
}

#[tokio::test]
async fn a_body_that_stops_or_drips_is_refused_in_time() {
    let siege = Besieged::new("[limits]\nbody_timeout_seconds = 1\n").await;
    let body = pair();
    let length = body.len();
    let head = post("/v1/flow", &format!("content-length: {length}\r\n\r\n"));
    let lengths = [0, 10, length / 2, length - 10];
    let stopped = lengths.map(|sent| {
        let mut stream = connect(&siege.server);
        stream.write_all(head.as_bytes()).expect("sent");
        stream.write_all(&body[..sent]).expect("sent");
        stream
    });
    for (mut stream, sent) in stopped.into_iter().zip(lengths) {
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).expect("an answer");
        assert_eq!(&answer, b"HTTP/1.1 408", "{sent} bytes");
    }
    let mut stream = connect(&siege.server);
    stream.write_all(head.as_bytes()).expect("sent");
    let answer = drip(stream, body.iter().copied());
    assert_eq!(status(&answer), Some(408), "{answer}");
    siege.stands().await;
}

#[tokio::test]
async fn a_client_that_does_not_read_is_given_up() {
    let siege = Besieged::new("[limits]\nwrite_timeout_seconds = 1\n").await;
    until_connections(&siege.server, 0.0);
    let request = b"GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n\r\n".repeat(10_000);
    let mut stream = connect(&siege.server);
    let mut sender = stream.try_clone().expect("a handle");
    let sending = std::thread::spawn(move || {
        let _cut_off = sender.write_all(&request);
    });
    let mut first = [0; 12];
    stream.read_exact(&mut first).expect("an answer");
    assert_eq!(&first, b"HTTP/1.1 200");
    until_connections(&siege.server, 0.0);
    sending.join().expect("no panic");
    siege.stands().await;
}

#[tokio::test]
async fn a_body_in_chunks_of_one_byte_is_read_or_refused_in_little_memory() {
    // The limit is little more than the body. A chunk of one byte must not be counted as a whole
    // page.
    let siege = Besieged::new("[limits]\nmax_total_upload_mib = 4\nmax_upload_mib = 4\n").await;
    let head = post(
        "/v1/flow",
        "transfer-encoding: chunked\r\nconnection: close\r\n\r\n",
    );
    let send = |body: &[u8]| {
        let mut bytes = head.as_bytes().to_vec();
        bytes.extend(chunked(body, 1));
        exchange(&siege.server, &bytes)
    };
    assert_eq!(status(&send(&pair())), Some(200));
    let noise = vec![7; 3_000_000];
    let noise = multipart(&[("source", &noise), ("target", &noise[..100])]);
    let answer = send(&noise);
    assert_eq!(status(&answer), Some(422), "{answer}");
    siege.stands().await;
}

#[tokio::test]
async fn parts_whose_headers_never_end_are_refused() {
    let siege = Besieged::new("").await;
    let head = post("/v1/flow", "transfer-encoding: chunked\r\n\r\n");
    for beginning in [
        "",
        "--x\r\n",
        "--x\r\ncontent-disposition: form-data; name=\"",
    ] {
        let mut stream = connect(&siege.server);
        stream.write_all(head.as_bytes()).expect("sent");
        let endless = "a".repeat(32 << 20);
        let bytes = chunked(format!("{beginning}{endless}").as_bytes(), 8000);
        let mut sender = stream.try_clone().expect("a handle");
        let sending = std::thread::spawn(move || {
            let _cut_off = sender.write_all(&bytes);
        });
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).expect("an answer");
        assert_eq!(&answer, b"HTTP/1.1 400", "{beginning:?}");
        drop(stream);
        sending.join().expect("no panic");
        siege.has_not_grown();
    }
    siege.stands().await;
}

#[tokio::test]
async fn connections_past_the_limit_are_closed_and_silent_ones_make_room() {
    let config = "[limits]\nmax_connections = 32\nheader_timeout_seconds = 1\n";
    let siege = Besieged::new(config).await;
    let held: Vec<TcpStream> = (0..300).map(|_| connect(&siege.server)).collect();
    assert!(siege.server.metric("fnsf_connections") <= 32.0);
    for stream in held {
        assert_eq!(until_closed(stream), "");
    }
    until_connections(&siege.server, 0.0);
    siege.stands().await;
}

#[tokio::test]
async fn five_thousand_quick_connections_leave_nothing_behind() {
    const ANSWERED_EVERY: usize = 10;
    let siege = Besieged::new("").await;
    let request = b"GET /v1/jobs HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
    for number in 0..5000_usize {
        let mut stream = connect(&siege.server);
        match number % 3 {
            0 => {}
            1 => stream.write_all(b"GET / HTTP/1.1\r\n").expect("sent"),
            _ => stream.write_all(request).expect("sent"),
        }
        if number % ANSWERED_EVERY == 2 && number % 3 == 2 {
            assert_eq!(status(&until_closed(stream)), Some(200));
        }
    }
    until_connections(&siege.server, 0.0);
    siege.stands().await;
}

#[tokio::test]
async fn lengths_that_lie_are_refused_or_end_with_the_connection() {
    let times = "header_timeout_seconds = 1\nbody_timeout_seconds = 1\n";
    let siege = Besieged::new(&format!("[limits]\nmax_upload_mib = 4\n{times}")).await;
    let body = pair();
    let ask = |headers: &str| {
        let mut bytes = post("/v1/flow", &format!("{headers}\r\n\r\n")).into_bytes();
        bytes.extend(&body);
        exchange(&siege.server, &bytes)
    };
    let longer = body.len() + 1;
    for (headers, expected) in [
        ("content-length: -1".to_owned(), 400),
        ("content-length: 99999999999999999999".to_owned(), 400),
        ("content-length: 4, 5".to_owned(), 400),
        ("content-length: 4\r\ncontent-length: 5".to_owned(), 400),
        ("content-length: 0x10".to_owned(), 400),
        ("content-length: 1099511627776".to_owned(), 413),
        ("content-length: 10".to_owned(), 400),
        // The body is complete at its last boundary; the server does not wait for the rest.
        (format!("content-length: {longer}"), 200),
    ] {
        let answer = ask(&headers);
        assert_eq!(status(&answer), Some(expected), "{headers}: {answer}");
    }
    siege.stands().await;
}

#[tokio::test]
async fn a_request_is_never_smuggled_in_anothers_body() {
    let siege = Besieged::new("[limits]\nheader_timeout_seconds = 1\n").await;
    let hidden = "GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n\r\n";
    let both = format!(
        "content-length: {}\r\ntransfer-encoding: chunked",
        5 + hidden.len()
    );
    for (headers, body) in [
        (both.clone(), format!("0\r\n\r\n{hidden}")),
        (
            "transfer-encoding: xchunked".to_owned(),
            format!("0\r\n\r\n{hidden}"),
        ),
        (
            "transfer-encoding: chunked, identity".to_owned(),
            format!("0\r\n\r\n{hidden}"),
        ),
        (
            "transfer-encoding : chunked".to_owned(),
            format!("0\r\n\r\n{hidden}"),
        ),
        (
            " transfer-encoding: chunked".to_owned(),
            format!("0\r\n\r\n{hidden}"),
        ),
        (
            "transfer-encoding: chunked\0".to_owned(),
            format!("0\r\n\r\n{hidden}"),
        ),
        (
            "transfer-encoding: chunked".to_owned(),
            format!("-1\r\n\r\n{hidden}"),
        ),
        (
            "transfer-encoding: chunked".to_owned(),
            format!("fffffffffffffffff\r\n{hidden}"),
        ),
        (
            "transfer-encoding: chunked".to_owned(),
            format!("0;{}\r\n\r\n{hidden}", "a".repeat(1 << 20)),
        ),
    ] {
        let request = post("/v1/flow", &format!("{headers}\r\n\r\n{body}"));
        let answer = exchange(&siege.server, request.as_bytes());
        assert!(!answer.contains("\"openapi\""), "{headers:?}: {answer}");
        assert!(
            matches!(status(&answer), None | Some(400..500)),
            "{headers:?}: {answer}"
        );
    }
    let old =
        format!("POST /v1/flow HTTP/1.0\r\ntransfer-encoding: chunked\r\n\r\n0\r\n\r\n{hidden}");
    let answer = exchange(&siege.server, old.as_bytes());
    assert!(!answer.contains("\"openapi\""), "{answer}");
    siege.stands().await;
}

#[tokio::test]
async fn compressed_bodies_are_refused_before_they_are_read() {
    let siege = Besieged::new("").await;
    for encoding in ["gzip", "br", "zstd", "deflate", "gzip, gzip", "identity"] {
        let head = post(
            "/v1/flow",
            &format!(
                "content-encoding: {encoding}\r\ncontent-length: 4\r\nconnection: close\r\n\r\nabcd"
            ),
        );
        let answer = exchange(&siege.server, head.as_bytes());
        assert_eq!(status(&answer), Some(415), "{answer}");
    }
    serves(&siege.server).await;
}

#[tokio::test]
async fn the_admin_port_answers_whatever_hangs_on_it() {
    let server = Server::start(&[]);
    let half = |bytes: &[u8]| {
        let stream = TcpStream::connect(&server.admin).expect("a connection");
        let mut one = stream.try_clone().expect("a handle");
        one.write_all(bytes).expect("sent");
        stream.set_read_timeout(Some(GIVEN_UP)).expect("a timeout");
        stream
    };
    let mut held = Vec::new();
    for number in 0..300 {
        held.push(half(match number % 3 {
            0 => b"",
            1 => b"GET /livez HTTP/1.1\r\nhost:",
            _ => b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        }));
    }
    for path in ["/livez", "/readyz", "/metrics"] {
        let answer = crate::server::plain_get(&server.admin, path).expect("an answer");
        assert_eq!(status(&answer), Some(200), "{path}");
    }
    for stream in held {
        until_closed(stream);
    }
}
