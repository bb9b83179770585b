//! Attacks on the framing of HTTP/2, written frame by frame.

use std::time::Duration;

use tokio_stream::StreamExt;

use crate::clouds::{form, medium_pair};
use crate::grpc::{client, pair, proto};
use crate::raw_http::{
    Besieged, CONTINUATION, DATA, END_HEADERS, END_STREAM, Frames, GOAWAY, HEADERS, MAX_GROWTH,
    PING, RST_STREAM, SETTINGS, WINDOW_UPDATE, field, frame, head,
};
use crate::server::{PATIENCE, Server, ended};

/// Number of streams of an attack, far above every limit.
const STREAMS: u32 = 5000;

/// Highest stream id that the server may process: its limit of 1,024 streams, plus those in flight.
const LAST: u32 = 2 * 1200;

/// The ids of the first `count` streams of a client.
fn streams(count: u32) -> impl Iterator<Item = u32> {
    (0..count).map(|number| 2 * number + 1)
}

#[tokio::test]
async fn the_settings_say_how_many_streams_and_headers_are_taken() {
    let siege = Besieged::new("").await;
    let mut frames = Frames::open(&siege.server);
    let settings = frames.next().expect("settings");
    assert_eq!((settings.kind, settings.flags), (SETTINGS, 0));
    let value = |name: u16| {
        let mut pairs = settings.payload.chunks_exact(6);
        let found = pairs.find(|pair| pair[..2] == name.to_be_bytes())?;
        Some(u32::from_be_bytes(found[2..].try_into().ok()?))
    };
    const MAX_CONCURRENT_STREAMS: u16 = 3;
    const MAX_HEADER_LIST_SIZE: u16 = 6;
    assert_eq!(value(MAX_CONCURRENT_STREAMS), Some(128));
    assert_eq!(value(MAX_HEADER_LIST_SIZE), Some(16 << 10));
}

#[tokio::test]
async fn streams_that_are_opened_and_reset_at_once_end_the_connection() {
    let siege = Besieged::new("").await;
    for method in ["GET", "POST"] {
        let mut frames = Frames::open(&siege.server);
        let mut bytes = Vec::new();
        for stream in streams(STREAMS) {
            let block = head(method, "/v1/flow");
            bytes.extend(frame(HEADERS, END_HEADERS, stream, &block));
            bytes.extend(frame(RST_STREAM, 0, stream, &8_u32.to_be_bytes()));
        }
        frames.send(bytes);
        let (last, code) = frames.goaway();
        const ENHANCE_YOUR_CALM: u32 = 11;
        assert_eq!(code, ENHANCE_YOUR_CALM);
        assert!(last < LAST, "{last}");
    }
    siege.stands().await;
}

#[tokio::test]
async fn streams_that_make_the_server_reset_them_end_the_connection() {
    let siege = Besieged::new("").await;
    // Each makes the server reset the stream: a window overflow, or more data than declared.
    let overflow = |stream| frame(WINDOW_UPDATE, 0, stream, &0x7fff_ffff_u32.to_be_bytes());
    let lie = |stream| frame(DATA, END_STREAM, stream, &[0; 100]);
    let errors: [&dyn Fn(u32) -> Vec<u8>; 2] = [&overflow, &lie];
    for error in errors {
        let mut frames = Frames::open(&siege.server);
        let mut bytes = Vec::new();
        for stream in streams(STREAMS) {
            let mut block = head("POST", "/v1/flow");
            block.extend(field("content-length", "1"));
            bytes.extend(frame(HEADERS, END_HEADERS, stream, &block));
            bytes.extend(error(stream));
        }
        frames.send(bytes);
        let (last, code) = frames.goaway();
        assert_ne!(code, 0);
        assert!(last < LAST, "{last}");
    }
    siege.stands().await;
}

#[tokio::test]
async fn headers_that_never_end_end_the_connection_or_the_request() {
    let siege = Besieged::new("").await;
    let block = head("GET", "/v1/jobs");
    let pieces: [(&str, Vec<u8>); 3] = [
        ("empty", Vec::new()),
        ("small", field("a", "b")),
        ("large", field("a", &"b".repeat(100)).repeat(150)),
    ];
    for (name, piece) in pieces {
        let mut frames = Frames::open(&siege.server);
        let mut bytes = frame(HEADERS, END_STREAM, 1, &block);
        for _ in 0..10_000_usize.min((32 << 20) / (piece.len() + 9)) {
            bytes.extend(frame(CONTINUATION, 0, 1, &piece));
        }
        bytes.extend(frame(CONTINUATION, END_HEADERS, 1, &[]));
        frames.send(bytes);
        // Each must be refused in some form, and not answered with the requested resource.
        let refused = std::iter::from_fn(|| frames.next()).find_map(|frame| match frame.kind {
            GOAWAY | RST_STREAM => Some(true),
            // ":status: 431" is not in the static table of HPACK. 200, 404 and others are.
            HEADERS => Some(!matches!(frame.payload[0], 0x88..=0x8e)),
            _ => None,
        });
        assert_ne!(refused, Some(false), "{name}");
        siege.has_not_grown();
    }
    siege.stands().await;
}

#[tokio::test]
async fn floods_of_pings_settings_and_small_data_cost_little() {
    let siege = Besieged::new("[limits]\nwrite_timeout_seconds = 1\n").await;
    let open = frame(HEADERS, END_HEADERS, 1, &head("POST", "/v1/flow"));
    let floods = [
        (Vec::new(), frame(PING, 0, 0, &[0; 8])),
        (Vec::new(), frame(SETTINGS, 0, 0, &[])),
        (open.clone(), frame(DATA, 0, 1, &[])),
        (open, frame(DATA, 0, 1, &[7])),
    ];
    let mut held = Vec::new();
    for (first, flood) in floods {
        let frames = Frames::open(&siege.server);
        let mut bytes = first;
        for _ in 0..200_000 {
            bytes.extend(&flood);
        }
        // The responses are never read.
        frames.send(bytes);
        frames.patience(Duration::from_secs(1));
        held.push(frames);
    }
    siege.stands().await;
    siege.has_not_grown();
    drop(held);
    siege.stands().await;
}

#[tokio::test]
async fn ten_thousand_headers_and_a_mebibyte_of_one_are_refused() {
    let siege = Besieged::new("[limits]\nheader_timeout_seconds = 1\n").await;
    let many: String = (0..10_000)
        .map(|number| format!("h{number}: 1\r\n"))
        .collect();
    let long = format!("long: {}\r\n", "a".repeat(1 << 20));
    for headers in [many, long] {
        let request = format!("GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n");
        let answer = crate::raw_http::exchange(&siege.server, request.as_bytes());
        assert!(
            matches!(crate::raw_http::status(&answer), Some(431) | None),
            "{answer}"
        );
    }
    let path = "a".repeat(1 << 20);
    let request = format!("GET /{path} HTTP/1.1\r\nhost: localhost\r\n\r\n");
    let answer = crate::raw_http::exchange(&siege.server, request.as_bytes());
    assert!(
        matches!(crate::raw_http::status(&answer), Some(414 | 431) | None),
        "{answer}"
    );
    siege.stands().await;
}

#[tokio::test]
async fn requests_that_are_refused_by_their_head_and_hang_up_keep_nothing_busy() {
    const AWAY: [&str; 5] = ["closes", "resets", "sends and resets", "goes", "resets all"];
    let mut siege = Besieged::new("").await;
    let heads: [&[(&str, &str)]; 3] = [
        &[("content-type", "a/b")],
        &[
            ("content-type", "multipart/form-data; boundary=x"),
            ("content-encoding", "gzip"),
        ],
        &[
            ("content-type", "multipart/form-data; boundary=x"),
            ("content-length", "99999999999"),
        ],
    ];
    for fields in heads {
        for away in AWAY {
            // One for each thread of the runtime, and one more.
            for _ in 0..3 {
                let frames = Frames::open(&siege.server);
                let mut block = head("POST", "/v1/flow");
                for (name, value) in fields {
                    block.extend(field(name, value));
                }
                let mut bytes = frame(HEADERS, END_HEADERS, 1, &block);
                let reset = frame(RST_STREAM, 0, 1, &8_u32.to_be_bytes());
                match away {
                    "resets" => bytes.extend(reset),
                    "sends and resets" => {
                        bytes.extend(frame(DATA, 0, 1, &[7; 100]));
                        bytes.extend(reset);
                    }
                    "goes" => bytes.extend(frame(GOAWAY, 0, 0, &[0; 8])),
                    _ => {}
                }
                frames.send(bytes);
                // The client closes while the server is refusing the request.
                std::thread::sleep(Duration::from_millis(20));
                frames.hang_up(away == "resets all");
            }
        }
    }
    tokio::time::timeout(PATIENCE, siege.stands())
        .await
        .expect("it still answers");
    std::thread::sleep(Duration::from_secs(1));
    let before = siege.server.processor_seconds();
    std::thread::sleep(Duration::from_secs(1));
    let busy = siege.server.processor_seconds() - before;
    assert!(busy < 0.5, "it is busy with nobody: {busy} s of a second");
    siege.server.signal("TERM");
    assert!(siege.server.wait(PATIENCE).is_some(), "SIGTERM ends it");
}

/// A connection that asks for a path `times` times and reads none of the responses.
fn asks_and_does_not_read(server: &Server, path: &str, times: u32) -> Frames {
    const INITIAL_WINDOW_SIZE: u16 = 4;
    let mut window = INITIAL_WINDOW_SIZE.to_be_bytes().to_vec();
    window.extend(0_u32.to_be_bytes());
    let frames = Frames::open(server);
    let mut bytes = frame(SETTINGS, 0, 0, &window);
    for stream in streams(times) {
        let mut block = head("GET", path);
        block.extend(field("accept", "application/json"));
        bytes.extend(frame(HEADERS, END_HEADERS | END_STREAM, stream, &block));
    }
    frames.send(bytes);
    frames
}

#[tokio::test]
async fn answers_that_nobody_reads_are_bounded_and_given_up() {
    let config = "[limits]\nwrite_timeout_seconds = 2\nmax_answers_mib = 32\n";
    let siege = Besieged::new(config).await;
    let client = reqwest::Client::new();
    let sent = client
        .post(siege.server.url("/v1/jobs"))
        .multipart(form(medium_pair(), "{}"))
        .send()
        .await
        .expect("an answer");
    let job: serde_json::Value = sent.json().await.expect("a job");
    let id = job["id"].as_str().expect("a name").to_owned();
    assert_eq!(ended(&siege.server, &id).await["state"], "succeeded");
    let result = format!("/v1/jobs/{id}/result");
    // The allocator may keep the budget of one attack. A leak of it by each of four would be seen.
    let mut kept = Vec::new();
    for _ in 0..4 {
        let answering: Vec<_> = (0..4)
            .map(|_| asks_and_does_not_read(&siege.server, &result, 60).answer_pings())
            .collect();
        // 240 responses of some megabytes each. Together they may use at most a tenth of that.
        let began = std::time::Instant::now();
        while began.elapsed() < Duration::from_secs(2) {
            let grown = siege.grown();
            assert!(grown < 150 << 20, "{} MiB", grown >> 20);
            std::thread::sleep(Duration::from_millis(20));
        }
        for connection in answering {
            // Each connection is closed by the server although its pings are answered.
            connection.join().expect("no panic");
        }
        // Their memory is available again.
        let url = siege.server.url(&result);
        let answer = client.get(url).send().await.expect("an answer");
        assert_eq!(answer.status(), 200);
        kept.push(siege.grown());
    }
    assert!(kept[3] < kept[0] + MAX_GROWTH, "{kept:?} bytes");
    siege.serves().await;
}

#[tokio::test]
async fn pages_that_nobody_reads_take_no_room_of_the_results_of_others() {
    let siege = Besieged::new("").await;
    // As many as two connections may have; together they are larger than all responses may be.
    let held: Vec<_> = ["/docs/swagger-ui-bundle.js", "/docs/swagger-ui.css"]
        .map(|path| asks_and_does_not_read(&siege.server, path, 128))
        .into();
    std::thread::sleep(Duration::from_secs(1));
    let options = proto::Options::default();
    let mut calls = client(&siege.server).await;
    let answer = calls.estimate_flow(pair(medium_pair(), options)).await;
    let mut answer = answer.expect("an answer").into_inner();
    let mut bytes = 0;
    while let Some(message) = answer.next().await {
        use proto::estimate_flow_response::Part;
        if let Some(Part::Chunk(chunk)) = message.expect("no error").part {
            bytes += chunk.flow.len();
        }
    }
    assert!(bytes > 64 << 10, "{bytes}");
    siege.has_not_grown();
    drop(held);
}

#[tokio::test]
async fn connections_that_only_answer_pings_make_room() {
    let keys = "api_key = \"0123456789abcdef\"\n";
    let config = format!("{keys}[limits]\nmax_connections = 16\nheader_timeout_seconds = 2\n");
    let server = Server::with_config(&config);
    let idle: Vec<_> = (0..16)
        .map(|_| Frames::open(&server).answer_pings())
        .collect();
    let list = || {
        let sent = reqwest::Client::new()
            .get(server.url("/v1/jobs"))
            .bearer_auth("0123456789abcdef");
        sent.timeout(PATIENCE).send()
    };
    // A connection without a key is closed at once to admit a new one.
    assert_eq!(list().await.expect("an answer").status(), 200);
    for connection in idle {
        connection.join().expect("no panic");
    }
    assert_eq!(list().await.expect("an answer").status(), 200);
}

#[tokio::test]
async fn a_call_without_a_key_does_not_keep_a_connection() {
    let keys = "api_key = \"0123456789abcdef\"\n";
    let config = format!("{keys}[limits]\nheader_timeout_seconds = 1\n");
    let server = Server::with_config(&config);
    let frames = Frames::open(&server);
    // Health may be watched without a key and without a time limit.
    let mut block = head("POST", "/grpc.health.v1.Health/Watch");
    block.extend(field("content-type", "application/grpc"));
    block.extend(field("te", "trailers"));
    let mut bytes = frame(HEADERS, END_HEADERS, 1, &block);
    bytes.extend(frame(DATA, END_STREAM, 1, &[0; 5]));
    frames.send(bytes);
    let ended = frames.answer_pings().join().expect("no panic");
    assert!(ended >= Duration::from_secs(1), "{ended:?}");
}
