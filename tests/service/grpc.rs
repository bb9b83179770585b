//! Tests of the gRPC protocol: the flow of a pair compared with HTTP, streamed sequences, and jobs.

use std::time::Duration;

use fnsf::flow::Point;
use fnsf::formats::read_flow;
use fnsf::payload::points_from_le_bytes;
use tokio_stream::{Stream, StreamExt};
use tonic::codec::CompressionEncoding;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request};

use crate::clouds::{form, medium_pair, small_pair};
use crate::server::Server;

/// The gRPC client, generated from the protobuf definitions.
#[expect(unreachable_pub, reason = "generated code is public to its module")]
#[expect(
    clippy::allow_attributes_without_reason,
    reason = "and does not say why"
)]
#[expect(
    unused_qualifications,
    reason = "generated code names everything in full"
)]
pub(crate) mod proto {
    tonic::include_proto!("client/fnsf.v1");
}

use proto::scene_flow_client::SceneFlowClient;

/// Number of points per chunk.
const POINTS: usize = 50_000;

pub(crate) async fn client(server: &Server) -> SceneFlowClient<Channel> {
    let endpoint = Endpoint::from_shared(server.url("")).expect("a good address");
    SceneFlowClient::new(endpoint.connect().await.expect("a connection"))
}

pub(crate) fn chunk(points: &[Point]) -> proto::Chunk {
    let values = points.as_flattened().iter();
    let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
    proto::Chunk {
        points: bytes.into(),
        ground: Vec::new().into(),
    }
}

/// A pair as a stream of request messages.
pub(crate) fn pair(
    clouds: &[Vec<Point>; 2],
    options: proto::Options,
) -> impl Stream<Item = proto::EstimateFlowRequest> + Send + 'static {
    use proto::estimate_flow_request::{Begin, CloudChunk, Part};
    let mut parts = vec![Part::Begin(Begin {
        options: Some(Box::new(options)),
        progress_ms: 20,
    })];
    for (points, cloud) in clouds
        .iter()
        .zip([proto::Cloud::Source, proto::Cloud::Target])
    {
        for points in points.chunks(POINTS) {
            parts.push(Part::Cloud(CloudChunk {
                cloud: cloud.into(),
                chunk: Some(chunk(points)),
            }));
        }
    }
    let message = |part| proto::EstimateFlowRequest { part: Some(part) };
    tokio_stream::iter(parts.into_iter().map(message))
}

#[tokio::test]
async fn messages_may_be_compressed_with_gzip() {
    use proto::estimate_flow_response::Part;
    let server = Server::start(&[]);
    let mut flows = Vec::new();
    for compressed in [false, true] {
        let mut calls = client(&server).await;
        if compressed {
            calls = calls.send_compressed(CompressionEncoding::Gzip);
        }
        let sent = pair(small_pair(), proto::Options::default());
        let answer = calls.estimate_flow(sent).await.expect("an answer");
        let mut answer = answer.into_inner();
        let mut flow = Vec::new();
        while let Some(message) = answer.next().await {
            if let Some(Part::Chunk(piece)) = message.expect("a message").part {
                flow.extend(points_from_le_bytes(&piece.flow));
            }
        }
        flows.push(flow);
    }
    assert!(!flows[0].is_empty() && flows[0] == flows[1]);
}

#[tokio::test]
async fn a_pair_gives_the_bits_that_http_gives() {
    use proto::estimate_flow_response::Part;
    let server = Server::start(&[]);
    let mut calls = client(&server).await;
    let options = proto::Options {
        preset: proto::Preset::Neural.into(),
        ..proto::Options::default()
    };
    let answer = calls.estimate_flow(pair(small_pair(), options)).await;
    let mut answer = answer.expect("an answer").into_inner();
    let (mut header, mut flow, mut flags, mut progress) = (None, Vec::new(), Vec::new(), 0);
    while let Some(message) = answer.next().await {
        match message.expect("a message").part.expect("a part") {
            Part::Progress(news) => progress = news.done.max(progress),
            Part::Header(found) => header = Some(found),
            Part::Chunk(piece) => {
                flow.extend(points_from_le_bytes(&piece.flow));
                flags.extend(piece.flags);
            }
        }
    }
    let header = header.expect("a header");
    assert_eq!(header.stop_reason(), proto::StopReason::MaxIterations);
    assert_eq!(header.points as usize, flow.len());
    assert_eq!(flags.len(), flow.len());
    assert!(progress > 0, "no progress was told");
    let http = reqwest::Client::new()
        .post(server.url("/v1/flow"))
        .multipart(form(small_pair(), r#"{"preset": "neural"}"#))
        .send()
        .await
        .expect("an answer");
    let http = read_flow(&http.bytes().await.expect("a body"), None).expect("a flow");
    assert_eq!(flow, http.flow);
    let valid: Vec<bool> = flags.iter().map(|flag| flag & 1 != 0).collect();
    let dynamic: Vec<bool> = flags.iter().map(|flag| flag & 2 != 0).collect();
    assert_eq!((Some(valid), Some(dynamic)), (http.valid, http.dynamic));
}

#[tokio::test]
async fn a_sequence_is_answered_pair_by_pair_while_it_is_still_coming() {
    use proto::estimate_sequence_request::{Begin, Part, Sweep};
    use proto::estimate_sequence_response::{Part as Answer, pair::Outcome};
    let server = Server::start(&[]);
    let mut calls = client(&server).await;
    let (send, sweeps) = tokio::sync::mpsc::channel(8);
    let message = |part| proto::EstimateSequenceRequest { part: Some(part) };
    let options = proto::Options {
        max_points: Some(2048),
        ..proto::Options::default()
    };
    let begin = Part::Begin(Begin {
        options: Some(Box::new(options)),
    });
    send.send(message(begin)).await.expect("open");
    let sweep = async |number: usize| {
        let cloud = &small_pair()[number % 2];
        let head = Sweep {
            name: format!("sweep {number}"),
            points: Some(cloud.len() as u64),
            ..Sweep::default()
        };
        send.send(message(Part::Sweep(head))).await.expect("open");
        for points in cloud.chunks(1000) {
            send.send(message(Part::Chunk(chunk(points))))
                .await
                .expect("open");
        }
    };
    let stream = tokio_stream::wrappers::ReceiverStream::new(sweeps);
    let (answer, ()) = tokio::join!(calls.estimate_sequence(stream), async {
        sweep(0).await;
        sweep(1).await;
    });
    let mut answer = answer.expect("an answer").into_inner();
    let mut next_pair = async |expected: u32| {
        let mut rows = 0;
        let cloud = &small_pair()[expected as usize % 2];
        while rows < cloud.len() {
            match answer.next().await.expect("more").expect("a message").part {
                Some(Answer::Pair(pair)) => {
                    assert!(matches!(pair.outcome, Some(Outcome::Header(_))), "{pair:?}");
                    assert_eq!(pair.index, expected);
                    assert_eq!(pair.source, format!("sweep {expected}"));
                    assert_eq!(pair.target, format!("sweep {}", expected + 1));
                }
                Some(Answer::Chunk(piece)) => rows += piece.flow.len() / 12,
                None => panic!("an empty message"),
            }
        }
    };
    // Each flow arrives before the next sweep is sent.
    next_pair(0).await;
    sweep(2).await;
    next_pair(1).await;
    drop(send);
    assert!(answer.next().await.is_none());
}

#[tokio::test]
async fn jobs_are_submitted_watched_listed_and_downloaded() {
    use proto::download_result_response::Part as Result;
    use proto::submit_job_request::{Begin, NextCloud, Part};
    /// The second sweep is 50 ms later.
    const NAMES: [&str; 2] = ["1700000000000", "1700000000050"];
    let server = Server::start(&[]);
    let mut calls = client(&server).await;
    let message = |part| proto::SubmitJobRequest { part: Some(part) };
    let submission = || {
        let mut parts = vec![Part::Begin(Begin {
            options: None,
            idempotency_key: "key".to_owned(),
        })];
        for (points, name) in small_pair().iter().zip(NAMES) {
            parts.push(Part::Next(NextCloud {
                name: name.to_owned(),
                ..NextCloud::default()
            }));
            parts.extend(points.chunks(1000).map(|points| Part::Chunk(chunk(points))));
        }
        tokio_stream::iter(parts.into_iter().map(message))
    };
    let job = calls
        .submit_job(submission())
        .await
        .expect("accepted")
        .into_inner();
    let again = calls
        .submit_job(submission())
        .await
        .expect("accepted")
        .into_inner();
    assert_eq!(job.id, again.id);
    let id = job.id.clone();
    let watch = calls
        .watch_job(proto::WatchJobRequest { id: id.clone() })
        .await;
    let news: Vec<_> = watch.expect("news").into_inner().collect().await;
    let last = news.last().expect("something").as_ref().expect("a job");
    assert_eq!(last.state(), proto::State::Succeeded);
    let listed = calls.list_jobs(proto::ListJobsRequest::default()).await;
    assert_eq!(listed.expect("a list").into_inner().jobs.len(), 1);
    for first_row in [0, 100] {
        let asked = proto::DownloadResultRequest {
            id: id.clone(),
            first_row,
        };
        let mut parts = calls
            .download_result(asked)
            .await
            .expect("it is there")
            .into_inner();
        let mut rows = 0;
        while let Some(part) = parts.next().await {
            match part.expect("a part").part {
                Some(Result::Chunk(piece)) => rows += piece.flow.len() as u64 / 12,
                Some(Result::Header(header)) => {
                    assert_eq!((header.dt_s, header.dt_assumed), (0.05, false));
                }
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(rows, small_pair()[0].len() as u64 - first_row);
    }
}

#[tokio::test]
async fn a_row_of_three_nan_is_a_beam_without_return() {
    use proto::estimate_flow_response::Part;
    let server = Server::start(&[]);
    let mut clouds = small_pair().clone();
    clouds[0][7] = [f32::NAN; 3];
    let sent = pair(&clouds, proto::Options::default());
    let answer = client(&server).await.estimate_flow(sent).await;
    let mut answer = answer.expect("an answer").into_inner();
    let (mut flow, mut flags) = (Vec::new(), Vec::new());
    while let Some(message) = answer.next().await {
        if let Some(Part::Chunk(piece)) = message.expect("a message").part {
            flow.extend(points_from_le_bytes(&piece.flow));
            flags.extend(piece.flags);
        }
    }
    assert_eq!((flow.len(), flow[7]), (clouds[0].len(), [0.0; 3]));
    let invalid: Vec<usize> = (0..flags.len())
        .filter(|&row| flags[row] & 1 == 0)
        .collect();
    assert_eq!(invalid, [7]);
}

#[tokio::test]
async fn a_calls_deadline_goes_into_the_optimization() {
    use proto::estimate_flow_response::Part;
    let server = Server::start(&[]);
    let mut calls = client(&server).await;
    let options = proto::Options {
        preset: proto::Preset::Paper.into(),
        ..proto::Options::default()
    };
    let mut request = Request::new(pair(medium_pair(), options));
    request.set_timeout(Duration::from_secs(1));
    let mut answer = calls
        .estimate_flow(request)
        .await
        .expect("an answer")
        .into_inner();
    let mut reason = None;
    while let Some(message) = answer.next().await {
        if let Some(Part::Header(header)) = message.expect("in time").part {
            reason = Some(header.stop_reason());
        }
    }
    assert_eq!(reason, Some(proto::StopReason::Deadline));
}

#[tokio::test]
async fn refusals_carry_their_reason() {
    let server = Server::start(&[]);
    let mut calls = client(&server).await;
    let asked = proto::GetJobRequest {
        id: "0192f0c1-7b7a-7000-8000-000000000000".to_owned(),
    };
    let status = calls.get_job(asked).await.expect_err("a refusal");
    assert_eq!(status.code(), Code::NotFound);
    let code = status.metadata().get("fnsf-code").expect("a code");
    assert_eq!(code, "not_found");
    let nan = [vec![[0.0, 0.0, f32::NAN]; 10], vec![[0.0; 3]; 10]];
    let stream = pair(&nan, proto::Options::default());
    let status = calls.estimate_flow(stream).await.expect_err("a refusal");
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(
        status.message().contains("source: row 0"),
        "{}",
        status.message()
    );
}
