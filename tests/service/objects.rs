//! Tests of clusters and confidence over HTTP and gRPC, in every format that can hold them.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::{Objects, Preset, Problem, Uncontrolled, estimate};
use fnsf::formats::read_flow;
use tokio_stream::StreamExt;

use crate::clouds::{form, medium_pair};
use crate::grpc::{client, pair, proto};
use crate::server::Server;

/// The objects that the library finds.
fn expected() -> Objects {
    let [source, target] = medium_pair();
    let problem = Problem::pair(source, target);
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let options = Preset::Default.options(None);
    let estimate = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
    estimate.objects().cloned().expect("objects")
}

#[tokio::test]
async fn clusters_and_confidence_are_the_librarys_in_every_format_and_over_grpc() {
    let server = Server::start(&[]);
    let expected = expected();
    assert!(expected.clusters.iter().any(|cluster| cluster.dynamic));
    for media in [
        "application/x-npz",
        "application/vnd.apache.arrow.file",
        "application/x-ply",
        "application/x-pcd",
        "application/json",
    ] {
        let answer = reqwest::Client::new()
            .post(server.url("/v1/flow"))
            .header("accept", media)
            .multipart(form(medium_pair(), "{}"))
            .send()
            .await
            .expect("an answer");
        let bytes = answer.bytes().await.expect("a body");
        let read = read_flow(&bytes, None).expect(media);
        assert_eq!(read.cluster.as_ref(), Some(&expected.cluster), "{media}");
        assert_eq!(
            read.confidence.as_ref(),
            Some(&expected.confidence),
            "{media}"
        );
        assert_eq!(read.moving.as_ref(), Some(&expected.moving), "{media}");
        let whole = ["application/x-npz", "application/json"].contains(&media);
        let clusters = whole.then(|| expected.clusters.clone());
        assert_eq!(read.clusters, clusters, "{media}");
    }

    let answer = client(&server)
        .await
        .estimate_flow(pair(medium_pair(), proto::Options::default()))
        .await;
    let mut answer = answer.expect("an answer").into_inner();
    let (mut clusters, mut cluster) = (Vec::new(), Vec::new());
    let (mut confidence, mut moving): (Vec<f32>, Vec<f32>) = (Vec::new(), Vec::new());
    let mut count = 0;
    while let Some(message) = answer.next().await {
        use proto::estimate_flow_response::Part;
        match message.expect("a message").part.expect("a part") {
            Part::Progress(_) => {}
            Part::Header(header) => match header.method {
                Some(proto::flow_header::Method::Objects(objects)) => count = objects.clusters,
                other => panic!("{other:?}"),
            },
            Part::Chunk(piece) => {
                clusters.extend(piece.clusters);
                let (ids, _) = piece.cluster.as_chunks::<4>();
                cluster.extend(ids.iter().map(|id| i32::from_le_bytes(*id)));
                for (all, bytes) in [
                    (&mut confidence, &piece.confidence),
                    (&mut moving, &piece.moving),
                ] {
                    let (probabilities, _) = bytes.as_chunks::<4>();
                    all.extend(
                        probabilities
                            .iter()
                            .map(|probability| f32::from_le_bytes(*probability)),
                    );
                }
            }
        }
    }
    assert_eq!(
        (cluster, confidence, moving),
        (expected.cluster, expected.confidence, expected.moving)
    );
    assert_eq!(clusters.len(), expected.clusters.len());
    assert_eq!(count as usize, clusters.len());
    for (found, cluster) in clusters.iter().zip(&expected.clusters) {
        assert_eq!(
            (found.points, found.dynamic),
            (cluster.points, cluster.dynamic)
        );
        assert_eq!(found.center, cluster.bounds.center);
        assert_eq!(found.size, cluster.bounds.size);
        assert_eq!(found.velocity, cluster.velocity);
        assert_eq!(
            [found.yaw, found.yaw_rate],
            [cluster.bounds.yaw, cluster.yaw_rate]
        );
        assert_eq!(
            [found.confidence, found.moving],
            [cluster.confidence, cluster.moving]
        );
    }
}
