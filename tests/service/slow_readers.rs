//! Clients that read their answers slowly.

use std::time::Duration;

use fnsf::flow::simulate::{Street, StreetOptions};
use tokio_stream::StreamExt;
use tonic::transport::Endpoint;

use crate::grpc::proto::scene_flow_client::SceneFlowClient;
use crate::grpc::{chunk, proto};
use crate::server::Server;

/// Time for which the client reads nothing: several times the retention of results.
const PAUSE: Duration = Duration::from_secs(5);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_pairs_of_a_stream_are_there_however_slowly_its_client_reads() {
    use proto::estimate_sequence_request::{Begin, Part, Sweep};
    use proto::estimate_sequence_response::{Part as Answer, pair::Outcome};
    let server = Server::with_config("[queue]\nsync_result_retention_seconds = 1\n");
    let street = Street::new(&StreetOptions {
        beams: 32,
        azimuth_steps: 600,
        sweeps: 7,
        ..StreetOptions::default()
    });
    let street = street.expect("a street");
    let mut parts = vec![Part::Begin(Begin::default())];
    for index in 0..7 {
        let sweep = street.sweep(index).expect("a sweep");
        parts.push(Part::Sweep(Sweep::default()));
        parts.push(Part::Chunk(chunk(&sweep.points)));
    }
    let message = |part| proto::EstimateSequenceRequest { part: Some(part) };
    let stream = tokio_stream::iter(parts.into_iter().map(message));
    // No flow fits into the windows of the connection.
    let endpoint = Endpoint::from_shared(server.url("")).expect("a good address");
    let endpoint = endpoint
        .initial_stream_window_size(65_535)
        .initial_connection_window_size(65_535);
    let mut calls = SceneFlowClient::new(endpoint.connect().await.expect("a connection"));
    let answer = calls.estimate_sequence(stream).await.expect("an answer");
    let mut answer = answer.into_inner();
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
