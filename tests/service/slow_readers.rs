//! Clients that read their answers slowly.

use std::time::Duration;

use fnsf::flow::simulate::{Street, StreetOptions};
use tokio_stream::StreamExt;
use tonic::transport::Endpoint;

use crate::clouds::form;
use crate::grpc::proto::estimate_sequence_request::{Begin, Part, Sweep};
use crate::grpc::proto::scene_flow_client::SceneFlowClient;
use crate::grpc::{chunk, proto};
use crate::server::{PATIENCE, Server};

/// Time for which the client reads nothing: several times the retention of results.
const PAUSE: Duration = Duration::from_secs(5);

/// Starts a call with the first sweeps of a street. No flow fits into the windows of its connection.
async fn estimate(
    server: &Server,
    begin: Begin,
    street: &Street,
    sweeps: usize,
) -> tonic::Streaming<proto::EstimateSequenceResponse> {
    let mut parts = vec![Part::Begin(begin)];
    for index in 0..sweeps {
        let sweep = street.sweep(index).expect("a sweep");
        parts.push(Part::Sweep(Sweep::default()));
        parts.push(Part::Chunk(chunk(&sweep.points)));
    }
    let message = |part| proto::EstimateSequenceRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    let endpoint = Endpoint::from_shared(server.url("")).expect("a good address");
    let endpoint = endpoint
        .initial_stream_window_size(65_535)
        .initial_connection_window_size(65_535);
    let mut calls = SceneFlowClient::new(endpoint.connect().await.expect("a connection"));
    let answer = calls.estimate_sequence(stream).await.expect("an answer");
    answer.into_inner()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_pairs_of_a_stream_are_there_however_slowly_its_client_reads() {
    use proto::estimate_sequence_response::{Part as Answer, pair::Outcome};
    let server = Server::with_config("[queue]\nsync_result_retention_seconds = 1\n");
    let street = Street::new(&StreetOptions {
        beams: 32,
        azimuth_steps: 600,
        sweeps: 7,
        ..StreetOptions::default()
    });
    let street = street.expect("a street");
    let mut answer = estimate(&server, Begin::default(), &street, 7).await;
    let mut pairs = 0;
    while let Some(message) = answer.next().await {
        if let Answer::Pair(pair) = message.expect("a message").part.expect("a part") {
            assert!(
                matches!(pair.outcome, Some(Outcome::Header(_))),
                "{:?}",
                pair.outcome
            );
            if pairs == 0 {
                tokio::time::sleep(PAUSE).await;
            }
            pairs += 1;
        }
    }
    assert_eq!(pairs, 6);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_whose_memory_others_need_leaves_no_pair_out_before_its_end() {
    use proto::estimate_sequence_response::Part as Answer;
    const SWEEPS: usize = 24;
    let limits = "max_upload_mib = 1\nmax_total_upload_mib = 2\nbody_timeout_seconds = 1\n\
                  stream_prefetch_pairs = 1\n";
    let server = Server::with_config(&format!("[limits]\n{limits}"));
    let street = Street::new(&StreetOptions {
        beams: 32,
        azimuth_steps: 600,
        sweeps: SWEEPS,
        ..StreetOptions::default()
    });
    let street = street.expect("a street");
    let options = proto::Options {
        preset: proto::Preset::Label.into(),
        ..proto::Options::default()
    };
    let begin = Begin {
        options: Some(Box::new(options)),
    };
    let mut answer = estimate(&server, begin, &street, SWEEPS).await;
    // While nothing is read, another upload needs the memory of the sweeps that are held.
    let sweep = street.sweep(0).expect("a sweep").points;
    let large = [sweep.repeat(2), sweep.repeat(2)];
    let began = std::time::Instant::now();
    loop {
        let sent = reqwest::Client::new()
            .post(server.url("/v1/flow"))
            .multipart(form(&large, r#"{"preset": "neural", "max_points": 512}"#));
        if sent.send().await.expect("an answer").status().is_success() {
            break;
        }
        assert!(began.elapsed() < PATIENCE, "the upload gets no memory");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    let (mut indices, mut end) = (Vec::new(), None);
    while let Some(message) = answer.next().await {
        match message {
            Ok(message) => {
                if let Some(Answer::Pair(pair)) = message.part {
                    indices.push(pair.index as usize);
                }
            }
            Err(status) => end = Some(status.code()),
        }
    }
    assert_eq!(end, Some(tonic::Code::DeadlineExceeded));
    assert!(
        !indices.is_empty() && indices.len() + 1 < SWEEPS,
        "{indices:?}"
    );
    assert_eq!(indices, (0..indices.len()).collect::<Vec<_>>());
}
