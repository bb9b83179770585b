//! Attacks on the gRPC protocol: false lengths, random bytes, unknown enum values, messages out of
//! order.

use std::io::Write;
use std::time::Duration;

use axum::http;
use bytes::Bytes;
use fnsf::flow::Point;
use prost::Message;
use tonic::Code;

use crate::clouds::small_pair;
use crate::grpc::{client, proto};
use crate::raw_http::Besieged;
use crate::server::{PATIENCE, Server};

/// Every method of the public port.
const METHODS: [&str; 15] = [
    "fnsf.v1.SceneFlow/EstimateFlow",
    "fnsf.v1.SceneFlow/EstimateSequence",
    "fnsf.v1.SceneFlow/SubmitJob",
    "fnsf.v1.SceneFlow/GetJob",
    "fnsf.v1.SceneFlow/ListJobs",
    "fnsf.v1.SceneFlow/CancelJob",
    "fnsf.v1.SceneFlow/DeleteJob",
    "fnsf.v1.SceneFlow/RequeueJob",
    "fnsf.v1.SceneFlow/WatchJob",
    "fnsf.v1.SceneFlow/GetTracks",
    "fnsf.v1.SceneFlow/DownloadResult",
    "grpc.health.v1.Health/Check",
    "grpc.health.v1.Health/Watch",
    "grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
    "grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
];

/// The status of a call with raw bytes as its body; none if the stream was reset.
async fn raw(server: &Server, method: &str, bytes: &[u8], ends: bool) -> Option<Code> {
    raw_encoded(server, method, "identity", bytes, ends).await
}

/// As [`raw`], for messages with this `grpc-encoding`.
async fn raw_encoded(
    server: &Server,
    method: &str,
    encoding: &str,
    bytes: &[u8],
    ends: bool,
) -> Option<Code> {
    let stream = tokio::net::TcpStream::connect(&server.public).await;
    let (client, connection) = h2::client::handshake(stream.expect("a connection"))
        .await
        .expect("HTTP/2");
    let driving = tokio::spawn(connection);
    let request = http::Request::post(format!("http://localhost/{method}"))
        .header("content-type", "application/grpc")
        .header("grpc-encoding", encoding)
        .header("te", "trailers")
        .body(())
        .expect("a request");
    let mut client = client.ready().await.expect("open");
    let (response, mut sending) = client.send_request(request, false).expect("sent");
    sending
        .send_data(Bytes::copy_from_slice(bytes), ends)
        .expect("sent");
    let answered = async {
        let response = response.await.ok()?;
        assert_eq!(response.status(), 200, "{method}");
        let code = |headers: &http::HeaderMap| {
            let text = headers.get("grpc-status")?.to_str().ok()?.parse().ok()?;
            Some(Code::from_i32(text))
        };
        if let Some(code) = code(response.headers()) {
            return Some(code);
        }
        let mut body = response.into_body();
        match body.data().await {
            // A response message. Some streams have no end, so only the first message is read.
            Some(piece) => piece.ok().map(|_| Code::Ok),
            None => code(&body.trailers().await.ok()??),
        }
    };
    let answered = tokio::time::timeout(PATIENCE, answered).await;
    driving.abort();
    answered.expect("an answer")
}

/// A message with its gRPC prefix.
fn message(compressed: u8, length: u32, bytes: &[u8]) -> Vec<u8> {
    let mut framed = vec![compressed];
    framed.extend(length.to_be_bytes());
    framed.extend(bytes);
    framed
}

#[tokio::test]
async fn a_length_that_lies_is_refused_before_anything_is_kept_for_it() {
    let siege = Besieged::new("").await;
    for method in METHODS {
        for length in [u32::MAX, 1 << 31, 5 << 20] {
            for _ in 0..3 {
                let bomb = message(0, length, &[0; 16]);
                let code = raw(&siege.server, method, &bomb, false).await;
                let refused = matches!(
                    code,
                    Some(Code::InvalidArgument | Code::OutOfRange | Code::ResourceExhausted)
                );
                // Reflection ends its stream without a status.
                let reflection = method.contains("Reflection");
                assert!(refused || reflection, "{method}: {code:?}");
            }
        }
    }
    siege.stands().await;
}

#[tokio::test]
async fn garbage_is_refused_by_every_method() {
    let siege = Besieged::new("").await;
    let mut state = 1_u64;
    let mut random = move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (state >> 33) as u8
    };
    for method in METHODS {
        for round in 0..12_u32 {
            let bytes: Vec<u8> = (0..round * round).map(|_| random()).collect();
            let length = round * round;
            for (framed, good) in [
                (message(0, length, &bytes), true),
                (message(1, length, &bytes), false),
                (message(7, length, &bytes), false),
                (message(0, length + 1, &bytes), false),
                (bytes.clone(), false),
            ] {
                let code = raw(&siege.server, method, &framed, true).await;
                // Some random bytes are a valid message. A list or a health check may then succeed.
                let plain = good || framed.is_empty();
                let refused = matches!(
                    code,
                    Some(
                        Code::InvalidArgument
                            | Code::NotFound
                            | Code::Internal
                            | Code::OutOfRange
                            | Code::Unimplemented
                    )
                );
                let answered = plain && code == Some(Code::Ok);
                let broken_off = framed.len() < 5 || method.contains("Reflection");
                assert!(
                    refused || answered || broken_off,
                    "{method} {framed:?}: {code:?}"
                );
            }
        }
    }
    siege.stands().await;
}

#[tokio::test]
async fn a_compressed_message_may_not_hold_more_than_an_uncompressed_one() {
    let siege = Besieged::new("").await;
    // Gigabytes of zeros are megabytes of gzip.
    let mut bomb = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    let zeros = vec![0; 16 << 20];
    for _ in 0..16 {
        bomb.write_all(&zeros).expect("memory");
    }
    let bomb = bomb.finish().expect("memory");
    for method in METHODS {
        // A part that fits, as the limit is on what comes over the network too.
        let length = bomb.len().min(1 << 20);
        let framed = message(1, length as u32, &bomb[..length]);
        let code = raw_encoded(&siege.server, method, "gzip", &framed, true).await;
        let refused = matches!(
            code,
            Some(
                Code::InvalidArgument
                    | Code::OutOfRange
                    | Code::ResourceExhausted
                    | Code::Internal
                    | Code::Unimplemented
            )
        );
        assert!(
            refused || method.contains("Reflection"),
            "{method}: {code:?}"
        );
    }
    siege.stands().await;
}

fn chunk(points: &[Point]) -> proto::Chunk {
    let values = points.as_flattened().iter();
    let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
    proto::Chunk {
        points: bytes.into(),
        ground: Bytes::new(),
    }
}

#[tokio::test]
async fn numbers_that_are_no_values_and_messages_out_of_order_are_refused() {
    use proto::estimate_flow_request::{Begin, CloudChunk, Part};
    let siege = Besieged::new("").await;
    let mut calls = client(&siege.server).await;
    let begin = |change: fn(&mut proto::Options)| {
        let mut options = proto::Options::default();
        change(&mut options);
        Some(Part::Begin(Begin {
            options: Some(Box::new(options)),
            progress_ms: u32::MAX,
        }))
    };
    let cloud = |number: i32, points: usize, ground: usize| {
        Some(Part::Cloud(CloudChunk {
            cloud: number,
            chunk: Some(proto::Chunk {
                points: vec![0; points].into(),
                ground: vec![1; ground].into(),
            }),
        }))
    };
    let good = begin(|_| {});
    let cases: Vec<Vec<Option<Part>>> = vec![
        vec![],
        vec![None],
        vec![good.clone()],
        vec![good.clone(), None],
        vec![good.clone(), good.clone()],
        vec![cloud(1, 12, 0), good.clone()],
        vec![begin(|o| o.preset = 99)],
        vec![begin(|o| o.preset = -1)],
        vec![begin(|o| o.ground = i32::MAX)],
        vec![begin(|o| o.priority = i32::MIN)],
        vec![begin(|o| o.ego = 99)],
        vec![begin(|o| o.ego_motion = vec![f64::NAN; 16])],
        vec![begin(|o| o.ego_motion = vec![1e308; 16])],
        vec![begin(|o| o.ego_motion = vec![0.0; 100_000])],
        vec![begin(|o| o.crop_m = Some(f32::INFINITY))],
        vec![begin(|o| o.min_range_m = Some(f32::INFINITY))],
        vec![begin(|o| o.max_points = Some(0))],
        vec![begin(|o| o.deadline_ms = Some(u64::MAX))],
        vec![begin(|o| o.device = 1_000_000)],
        vec![good.clone(), cloud(0, 12, 0)],
        vec![good.clone(), cloud(99, 12, 0)],
        vec![good.clone(), cloud(-1, 12, 0)],
        vec![good.clone(), cloud(1, 11, 0)],
        vec![good.clone(), cloud(1, 12, 2)],
        vec![good.clone(), cloud(1, 12, 1), cloud(1, 12, 0)],
        vec![good.clone(), cloud(1, 120, 0)],
        vec![good.clone(), cloud(2, 120, 0)],
    ];
    for case in cases {
        let told = format!("{case:?}").chars().take(200).collect::<String>();
        let messages = case
            .into_iter()
            .map(|part| proto::EstimateFlowRequest { part });
        let refused = calls.estimate_flow(tokio_stream::iter(messages)).await;
        let status = refused.expect_err("a refusal");
        assert_eq!(status.code(), Code::InvalidArgument, "{told}: {status}");
    }
    let odd = [
        String::new(),
        "../../etc/passwd".to_owned(),
        "a\r\nb\0".to_owned(),
        "a".repeat(100_000),
        "0192f0c1-7b7a-7000-8000-000000000000".to_owned(),
    ];
    for id in odd {
        let one = calls.get_job(proto::GetJobRequest { id: id.clone() }).await;
        let two = calls
            .cancel_job(proto::CancelJobRequest { id: id.clone() })
            .await;
        let three = calls
            .requeue_job(proto::RequeueJobRequest { id: id.clone() })
            .await;
        let four = calls
            .watch_job(proto::WatchJobRequest { id: id.clone() })
            .await;
        let six = calls
            .delete_job(proto::DeleteJobRequest { id: id.clone() })
            .await;
        let first_row = u64::MAX;
        let five = calls
            .download_result(proto::DownloadResultRequest { id, first_row })
            .await;
        let codes = [
            one.map(drop),
            two.map(drop),
            three.map(drop),
            four.map(drop),
            five.map(drop),
            six.map(drop),
        ];
        for code in codes {
            assert_eq!(code.expect_err("a refusal").code(), Code::NotFound);
        }
    }
    let list = |state, page_size, page_token: &str| proto::ListJobsRequest {
        state,
        page_size,
        page_token: page_token.to_owned(),
        label: String::new(),
    };
    calls
        .list_jobs(list(0, u32::MAX, ""))
        .await
        .expect("a list");
    let refused = calls
        .list_jobs(list(99, 0, ""))
        .await
        .expect_err("a refusal");
    assert_eq!(refused.code(), Code::InvalidArgument);
    let refused = calls.list_jobs(list(0, 0, "../..")).await;
    let refused = refused.expect_err("a refusal");
    assert_eq!(refused.code(), Code::InvalidArgument);
    siege.stands().await;
}

#[tokio::test]
async fn submissions_and_sequences_out_of_order_are_refused() {
    use proto::submit_job_request::{Begin, NextCloud, Part};
    let siege = Besieged::new("").await;
    let mut calls = client(&siege.server).await;
    let begin = |key: &str| {
        Some(Part::Begin(Begin {
            options: None,
            idempotency_key: key.to_owned(),
        }))
    };
    let named = |name: &str| {
        let name = name.to_owned();
        Some(Part::Next(NextCloud {
            name,
            ..NextCloud::default()
        }))
    };
    let next = named("");
    let piece = Some(Part::Chunk(chunk(&small_pair()[0])));
    for case in [
        vec![],
        vec![None],
        vec![begin(""), None],
        vec![next.clone()],
        vec![begin(""), piece.clone()],
        vec![begin(""), begin("")],
        vec![begin(&"a".repeat(256)), next.clone()],
        vec![begin("")],
        vec![begin(""), next.clone()],
        vec![begin(""), next.clone(), piece.clone()],
        vec![begin(""), next.clone(), next.clone(), next.clone()],
        vec![
            begin(""),
            named(&"1".repeat(256)),
            piece.clone(),
            next.clone(),
            piece.clone(),
        ],
        vec![begin(""), next.clone(), piece.clone(), next.clone()],
        vec![
            begin(""),
            named("1"),
            piece.clone(),
            named("10"),
            piece.clone(),
            named("2"),
            piece.clone(),
        ],
    ] {
        let told = format!("{case:?}").chars().take(200).collect::<String>();
        let messages = case
            .into_iter()
            .map(|part| proto::SubmitJobRequest { part });
        let refused = calls.submit_job(tokio_stream::iter(messages)).await;
        let status = refused.expect_err(&told);
        assert_eq!(status.code(), Code::InvalidArgument, "{told}: {status}");
    }
    use proto::estimate_sequence_request as sequence;
    let begin = Some(sequence::Part::Begin(sequence::Begin { options: None }));
    let piece = Some(sequence::Part::Chunk(chunk(&small_pair()[0])));
    for case in [
        vec![],
        vec![None],
        vec![piece.clone()],
        vec![begin.clone(), begin.clone()],
        vec![begin.clone(), piece],
        vec![begin, None],
    ] {
        let told = format!("{case:?}").chars().take(200).collect::<String>();
        let messages = case
            .into_iter()
            .map(|part| proto::EstimateSequenceRequest { part });
        let answers = calls.estimate_sequence(tokio_stream::iter(messages)).await;
        let status = match answers {
            Ok(answers) => answers.into_inner().message().await.expect_err(&told),
            Err(status) => status,
        };
        assert_eq!(status.code(), Code::InvalidArgument, "{told}: {status}");
    }
    siege.stands().await;
}

#[tokio::test]
async fn a_stream_that_stops_is_refused_in_time() {
    let siege = Besieged::new("[limits]\nbody_timeout_seconds = 1\n").await;
    for method in ["EstimateFlow", "SubmitJob", "EstimateSequence"] {
        let method = format!("fnsf.v1.SceneFlow/{method}");
        let code = raw(&siege.server, &method, &[0, 0], false);
        let code = tokio::time::timeout(Duration::from_secs(20), code).await;
        assert_eq!(
            code.expect("in time"),
            Some(Code::DeadlineExceeded),
            "{method}"
        );
    }
    // Calls that take no clouds, half of whose message has come. Reflection answers with a message.
    let others = METHODS.iter().skip(3);
    for method in others.filter(|method| !method.contains("Reflection")) {
        let half = message(0, 100, &[0; 50]);
        let code = raw(&siege.server, method, &half, false);
        let code = tokio::time::timeout(Duration::from_secs(20), code).await;
        assert_eq!(
            code.expect("in time"),
            Some(Code::DeadlineExceeded),
            "{method}"
        );
    }
    siege.stands().await;
}

#[tokio::test]
async fn the_messages_of_streams_that_pause_are_in_the_budget_of_their_caller() {
    use proto::estimate_sequence_request::{Begin, Part};
    const CALLS: usize = 32;
    let limits = "max_upload_mib = 8\nmax_total_upload_mib = 8\nbody_timeout_seconds = 60\n";
    let siege = Besieged::new(&format!("[limits]\n{limits}")).await;
    let method = "fnsf.v1.SceneFlow/EstimateSequence";
    let begin = proto::EstimateSequenceRequest {
        part: Some(Part::Begin(Begin::default())),
    };
    let begin = begin.encode_to_vec();
    // A field that no message has, of nearly a mebibyte.
    let mut unknown = vec![0xfa, 0x3f, 0x80, 0x80, 0x3c];
    unknown.resize(5 + (15 << 16), 0);
    unknown.extend(&begin);
    let begin = message(0, begin.len() as u32, &begin);
    let whole = message(0, 1 << 20, &vec![0; 1 << 20]);
    let incomplete = [&begin, &whole[..1 << 20]].concat();
    let large = message(0, unknown.len() as u32, &unknown);
    let mut zipped = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    zipped.write_all(&unknown).expect("compressed");
    let zipped = zipped.finish().expect("compressed");
    let small = message(1, zipped.len() as u32, &zipped);
    for (encoding, bytes) in [
        ("identity", &incomplete),
        ("identity", &large),
        ("gzip", &small),
    ] {
        // What has memory pauses until the caller goes.
        let calls = (0..CALLS).map(|_| {
            let call = raw_encoded(&siege.server, method, encoding, bytes, false);
            tokio::time::timeout(Duration::from_secs(5), call)
        });
        let codes = futures_util::future::join_all(calls).await;
        let paused = codes.iter().filter(|code| code.is_err()).count();
        let refused = |code: &&Result<Option<Code>, _>| **code == Ok(Some(Code::Unavailable));
        let refused = codes.iter().filter(refused).count();
        assert_eq!(paused + refused, CALLS, "{codes:?}");
        assert!(0 < paused && paused <= 8, "{codes:?}");
    }
    // Small messages are in no budget, and such a stream may pause while others have none left.
    let paused = raw(&siege.server, method, &begin, false);
    let paused = tokio::time::timeout(Duration::from_secs(3), paused).await;
    assert!(paused.is_err(), "{paused:?}");
    siege.stands().await;
}

#[tokio::test]
async fn messages_that_never_end_take_no_memory() {
    let siege = Besieged::new("").await;
    // Nearly as much as each message says it has, on as many streams as a connection may have.
    let piece = message(0, 1 << 20, &vec![0; 1 << 20])[..(1 << 20) - 1].to_vec();
    for method in ["grpc.health.v1.Health/Check", "fnsf.v1.SceneFlow/GetJob"] {
        let calls = (0..128).map(|_| raw(&siege.server, method, &piece, false));
        for code in futures_util::future::join_all(calls).await {
            assert_ne!(code, Some(Code::Ok), "{method}");
        }
        siege.has_not_grown();
    }
    siege.stands().await;
}
