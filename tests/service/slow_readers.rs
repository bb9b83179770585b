//! Clients that read their answers slowly.

use std::time::Duration;

use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::formats::CloudFormat;
use prost::Message;
use reqwest::multipart::{Form, Part as FilePart};
use tokio_stream::StreamExt;
use tonic::transport::Endpoint;

use crate::clouds::{file, form};
use crate::grpc::proto::estimate_sequence_request::{Begin, Part, Sweep};
use crate::grpc::proto::scene_flow_client::SceneFlowClient;
use crate::grpc::{chunk, proto};
use crate::server::{PATIENCE, Server, ended};

/// Time for which the client reads nothing: several times the retention of results.
const PAUSE: Duration = Duration::from_secs(5);

/// A client whose connection takes little that is not read.
async fn slow_client(server: &Server) -> SceneFlowClient<tonic::transport::Channel> {
    let endpoint = Endpoint::from_shared(server.url("")).expect("a good address");
    let endpoint = endpoint
        .initial_stream_window_size(65_535)
        .initial_connection_window_size(65_535);
    SceneFlowClient::new(endpoint.connect().await.expect("a connection"))
}

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
    let mut calls = slow_client(server).await;
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

/// A job that has ended, of a sweep of a street for each of `names`, and the points of the first.
async fn job(server: &Server, path: &str, names: &[&str]) -> (String, usize) {
    let street = Street::new(&StreetOptions {
        beams: 32,
        sweeps: names.len(),
        ..StreetOptions::default()
    });
    let street = street.expect("a street");
    let mut body = Form::new().text("options", r#"{"max_points": 2048}"#);
    let mut rows = 0;
    for (index, name) in names.iter().enumerate() {
        let points = street.sweep(index).expect("a sweep").points;
        rows = if index == 0 { points.len() } else { rows };
        let part = FilePart::bytes(file(CloudFormat::Npy, &points)).file_name("f.npy");
        body = body.part(name.to_string(), part);
    }
    let sent = reqwest::Client::new()
        .post(server.url(path))
        .multipart(body);
    let job: serde_json::Value = sent
        .send()
        .await
        .expect("sent")
        .json()
        .await
        .expect("a job");
    let id = job["id"].as_str().expect("a name").to_owned();
    assert_eq!(ended(server, &id).await["state"], "succeeded");
    (id, rows)
}

/// Fetches a result until there is memory for it, because an answer that is not read has gone.
async fn until_there_is_room(server: &Server, id: &str) {
    let began = std::time::Instant::now();
    loop {
        let other = reqwest::get(server.url(&format!("/v1/jobs/{id}/result"))).await;
        if other.expect("an answer").status().is_success() {
            return;
        }
        assert!(
            began.elapsed() < PATIENCE,
            "the other answer gets no memory"
        );
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_that_made_room_for_others_ends_with_an_error_and_comes_in_small_messages() {
    use proto::download_result_response::Part as Answer;
    /// A frame of the transport may have this and a message, and up to 64 KiB are in no budget.
    const MOST: usize = 32 << 10;
    let server = Server::with_config("[limits]\nmax_answers_mib = 2\n");
    let (id, rows) = job(&server, "/v1/jobs", &["source", "target"]).await;
    let asked = proto::DownloadResultRequest {
        id: id.clone(),
        first_row: 0,
    };
    let answer = slow_client(&server).await.download_result(asked).await;
    let mut answer = answer.expect("an answer").into_inner();
    until_there_is_room(&server, &id).await;
    let (mut got, mut end) = (0, None);
    while let Some(message) = answer.next().await {
        match message {
            Ok(message) => {
                assert!(message.encoded_len() <= MOST, "{}", message.encoded_len());
                if let Some(Answer::Chunk(chunk)) = message.part {
                    got += chunk.flow.len() / 12;
                }
            }
            Err(status) => end = Some(status.code()),
        }
    }
    assert!(0 < got && got < rows, "{got} of {rows}");
    assert_eq!(end, Some(tonic::Code::Unavailable));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_archive_that_made_room_for_others_does_not_end_as_if_it_were_whole() {
    let server = Server::with_config("[limits]\nmax_answers_mib = 2\n");
    let (id, _) = job(&server, "/v1/sequences", &["sweep"; 3]).await;
    let pair = ended(&server, &id).await["pairs"]["jobs"][0]["id"].clone();
    let pair = pair.as_str().expect("the name of a pair").to_owned();
    let stream = tokio::net::TcpStream::connect(&server.public).await;
    let handshake = h2::client::handshake(stream.expect("a connection")).await;
    let (calls, connection) = handshake.expect("HTTP/2 with the smallest windows");
    let driving = tokio::spawn(connection);
    let request = axum::http::Request::get(server.url(&format!("/v1/jobs/{id}/result")));
    let request = request.body(()).expect("a request");
    let mut calls = calls.ready().await.expect("open");
    let (response, _) = calls.send_request(request, true).expect("sent");
    let archive = response.await.expect("an answer");
    assert_eq!(archive.headers()["content-type"], "application/zip");
    until_there_is_room(&server, &pair).await;
    let mut body = archive.into_body();
    let end = loop {
        match body.data().await {
            Some(Ok(bytes)) => {
                let released = body.flow_control().release_capacity(bytes.len());
                released.expect("bytes that have come");
            }
            other => break other,
        }
    };
    assert!(end.is_some(), "it ended as if it were whole");
    driving.abort();
}
