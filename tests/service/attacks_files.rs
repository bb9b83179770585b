//! Attacks by files and coordinates: decompression bombs, false counts, pickles and degenerate
//! clouds.

use std::io::Write;

use fnsf::flow::Point;
use fnsf::formats::{CloudFormat, read_flow};
use reqwest::multipart::{Form, Part};
use serde_json::Value;

use crate::clouds::{file, small_pair};
use crate::grpc::{client, pair, proto};
use crate::raw_http::Besieged;
use crate::server::Server;

/// Posts two files with a preset. Returns the flow, or the problem document.
pub(crate) async fn post(
    server: &Server,
    [source, target]: [&[u8]; 2],
    preset: &str,
) -> Result<Vec<Point>, Value> {
    let part = |bytes: &[u8]| Part::bytes(bytes.to_vec()).file_name("cloud");
    let form = Form::new()
        .part("source", part(source))
        .part("target", part(target))
        .text("options", format!(r#"{{"preset": "{preset}"}}"#));
    let sent = reqwest::Client::new()
        .post(server.url("/v1/flow"))
        .multipart(form)
        .send();
    let answer = sent.await.expect("an answer");
    if answer.status() == 200 {
        let bytes = answer.bytes().await.expect("a body");
        return Ok(read_flow(&bytes, None).expect("a flow").flow);
    }
    Err(answer.json().await.expect("a problem"))
}

/// An `.npy` file with the given header.
fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(u16::try_from(header.len()).expect("short").to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

/// A zip of named members.
fn zip(members: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in members {
        let options = zip::write::SimpleFileOptions::default();
        zip.start_file(*name, options).expect("started");
        zip.write_all(bytes).expect("written");
    }
    zip.finish().expect("finished").into_inner()
}

/// 120 MB of zeros in little more than a hundred kilobytes.
fn zip_bomb() -> Vec<u8> {
    let array = npy("'<f4'", "(10000000, 3)", &vec![0; 120_000_000]);
    zip(&[("pc1.npy", &array)])
}

fn pcd(points: &str, data: &str, rest: &[u8]) -> Vec<u8> {
    let mut bytes = format!(
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {points}\n\
         HEIGHT 1\nPOINTS {points}\nDATA {data}\n"
    )
    .into_bytes();
    bytes.extend(rest);
    bytes
}

fn ply(vertices: &str, before: &str) -> Vec<u8> {
    format!(
        "ply\nformat binary_little_endian 1.0\n{before}element vertex {vertices}\nproperty float x\n\
         property float y\nproperty float z\nend_header\n1 2 3\n"
    )
    .into_bytes()
}

/// A stream of LZF back-references. Each one copies 264 earlier bytes.
fn lzf_bomb() -> Vec<u8> {
    let mut packed = vec![0, 7];
    for _ in 0..150_000 {
        packed.extend([0xe0, 0xff, 0]);
    }
    let declared = 1 + 150_000 * 264_u32;
    let packed_length = u32::try_from(packed.len()).expect("small");
    let mut bytes = [packed_length.to_le_bytes(), declared.to_le_bytes()].concat();
    bytes.extend(packed);
    pcd("3300000", "binary_compressed", &bytes)
}

#[tokio::test]
async fn bombs_and_lying_counts_are_refused_again_and_again_in_little_memory() {
    const TRIES: usize = 20;
    let siege = Besieged::new("").await;
    let good = file(CloudFormat::Npy, &small_pair()[0]);
    let nested = zip(&[("pc1.npy", &zip(&[("pc1.npy", &good)]))]);
    let many: Vec<String> = (0..5000).map(|number| format!("{number}.npy")).collect();
    let many: Vec<(&str, &[u8])> = many.iter().map(|name| (name.as_str(), &[][..])).collect();
    let lie = [
        9, 0, 0, 0, 0xff, 0xff, 0xff, 0xff, 1, 2, 3, 4, 5, 6, 7, 8, 9,
    ];
    let huge = "18446744073709551615";
    let bombs = [
        ("zip", zip_bomb()),
        ("nested zip", nested),
        ("zip of many members", zip(&many)),
        ("lzf", lzf_bomb()),
        ("lzf that lies", pcd("40000000", "binary_compressed", &lie)),
        ("pcd", pcd("40000000", "binary", &lie)),
        ("pcd past every limit", pcd(huge, "binary", &lie)),
        ("npy", npy("'<f4'", "(40000000, 3)", &[0; 12])),
        (
            "npy past every limit",
            npy("'<f8'", &format!("({huge}, {huge})"), &[0; 12]),
        ),
        ("ply", ply("4000000000", "")),
        ("ply past every limit", ply(huge, "")),
        (
            "ply with lists",
            ply(
                "1",
                &format!("element face {huge}\nproperty list uint double ids\n"),
            ),
        ),
    ];
    for round in 0..TRIES {
        for (name, bomb) in &bombs {
            let (source, target) = if round % 2 == 0 {
                (bomb, &good)
            } else {
                (&good, bomb)
            };
            let problem = post(&siege.server, [source, target], "default")
                .await
                .expect_err(name);
            let status = problem["status"].as_u64();
            assert!(matches!(status, Some(413 | 422)), "{name}: {problem}");
        }
        siege.has_not_grown();
    }
    siege.stands().await;
}

#[tokio::test]
async fn objects_pickles_and_broken_archives_are_refused() {
    let siege = Besieged::new("").await;
    let good = file(CloudFormat::Npy, &small_pair()[0]);
    let pickle = b"\x80\x04cos\nsystem\n(S'touch /tmp/fnsf-was-here'\ntR.";
    let mut encrypted = zip(&[("pc1.npy", &good), ("pc2.npy", &good)]);
    // Sets the encryption flag in the local header and in the directory entry of each member.
    for at in 0..encrypted.len() - 8 {
        match &encrypted[at..at + 4] {
            b"PK\x03\x04" => encrypted[at + 6] |= 1,
            b"PK\x01\x02" => encrypted[at + 8] |= 1,
            _ => {}
        }
    }
    for (name, bytes) in [
        ("objects", npy("'|O'", "(100, 3)", pickle)),
        (
            "objects in a zip",
            zip(&[("pc1.npy", &npy("'|O'", "(100, 3)", pickle))]),
        ),
        (
            "records of objects",
            npy("[('x', '|O'), ('y', '<f4'), ('z', '<f4')]", "(1,)", pickle),
        ),
        ("text", npy("'<U4'", "(1, 3)", &[0; 48])),
        ("complex numbers", npy("'<c8'", "(1, 3)", &[0; 24])),
        ("a pickle", pickle.to_vec()),
        (
            "a header of code",
            npy("__import__('os')", "(1, 3)", &[0; 12]),
        ),
        (
            "a deep header",
            npy(&"(".repeat(60_000), "(1, 3)", &[0; 12]),
        ),
        ("a negative shape", npy("'<f4'", "(-1, 3)", &[0; 12])),
        ("encrypted", encrypted),
        ("half a file", good[..good.len() / 2].to_vec()),
        ("nothing", Vec::new()),
    ] {
        let problem = post(&siege.server, [&bytes, &good], "default")
            .await
            .expect_err(name);
        assert_eq!(problem["status"], 422, "{name}: {problem}");
        let detail = problem["detail"].as_str().unwrap_or_default();
        assert!(detail.starts_with("source: "), "{name}: {detail}");
        assert_eq!(
            name.starts_with("objects"),
            detail.contains("object"),
            "{name}: {detail}"
        );
    }
    siege.stands().await;
}

/// Sends a pair over gRPC. Returns the flow, or the code of the refusal.
async fn call(
    server: &Server,
    clouds: &[Vec<Point>; 2],
    preset: &str,
) -> Result<Vec<Point>, String> {
    use proto::estimate_flow_response::Part;
    let refusal = |status: tonic::Status| {
        let code = status.metadata().get("fnsf-code");
        code.and_then(|code| code.to_str().ok())
            .unwrap_or_default()
            .to_owned()
    };
    let preset = proto::Preset::from_str_name(&format!("PRESET_{}", preset.to_uppercase()));
    let options = proto::Options {
        preset: preset.expect("it is known").into(),
        ..proto::Options::default()
    };
    let stream = pair(clouds, options);
    let answer = client(server)
        .await
        .estimate_flow(stream)
        .await
        .map_err(refusal)?;
    let mut answer = answer.into_inner();
    let mut flow = Vec::new();
    while let Some(message) = answer.message().await.map_err(refusal)? {
        if let Some(Part::Chunk(piece)) = message.part {
            flow.extend(fnsf::payload::points_from_le_bytes(&piece.flow));
        }
    }
    Ok(flow)
}

#[tokio::test]
async fn clouds_at_the_edge_of_sense_get_the_same_verdict_on_both_doors() {
    const FAR: f32 = 1e6;
    let siege = Besieged::new("").await;
    let cloud: Vec<Point> = small_pair()[0].iter().step_by(10).copied().collect();
    let with = |at: usize, value: f32| {
        let mut broken = cloud.clone();
        broken[at][at % 3] = value;
        broken
    };
    let refused = Err("bad_input");
    let solved = Ok(());
    let row = |x: f32| [[x, 0.0, 0.0], [x, 1.0, 0.0], [x, 0.0, 1.0]];
    let cases = [
        ("not a number", with(1, f32::NAN), cloud.clone(), refused),
        ("infinite", with(2, f32::INFINITY), cloud.clone(), refused),
        (
            "minus infinite",
            cloud.clone(),
            with(3, f32::NEG_INFINITY),
            refused,
        ),
        ("beyond the limit", cloud.clone(), with(4, 1e30), refused),
        (
            "just beyond the limit",
            cloud.clone(),
            with(5, 1.1e6),
            refused,
        ),
        (
            "denormal",
            with(6, f32::MIN_POSITIVE / 4.0),
            with(7, -0.0),
            solved,
        ),
        ("empty", Vec::new(), cloud.clone(), refused),
        ("empty target", cloud.clone(), Vec::new(), refused),
        ("both empty", Vec::new(), Vec::new(), refused),
        (
            "one point",
            cloud[..1].to_vec(),
            cloud[..1].to_vec(),
            refused,
        ),
        (
            "two points",
            cloud[..2].to_vec(),
            cloud[..2].to_vec(),
            refused,
        ),
        (
            "two points far apart",
            vec![[-FAR; 3], [FAR; 3]],
            vec![[-FAR; 3], [FAR; 3]],
            refused,
        ),
        (
            "three points",
            cloud[..3].to_vec(),
            cloud[..3].to_vec(),
            solved,
        ),
        (
            "all the same point",
            vec![cloud[0]; 100],
            vec![cloud[0]; 100],
            solved,
        ),
        ("the same cloud twice", cloud.clone(), cloud.clone(), solved),
        (
            "a box of two thousand kilometres",
            row(-FAR).into_iter().chain(row(FAR)).collect(),
            row(FAR).into_iter().chain(row(-FAR)).collect(),
            refused,
        ),
        (
            "one point a million metres away",
            with(8, FAR),
            with(8, -FAR),
            refused,
        ),
        (
            "clouds a million metres apart",
            row(-FAR).to_vec(),
            row(FAR).to_vec(),
            refused,
        ),
    ];
    let mut wrong = Vec::new();
    let presets = ["neural", "default"].into_iter();
    let cases = presets.flat_map(|preset| cases.iter().map(move |case| (preset, case)));
    for (preset, (name, source, target, expected)) in cases {
        let far = name.contains("a million metres");
        // The object search needs no distance transform, and its memory does not depend on the
        // extent.
        let expected = if far && preset == "default" {
            solved
        } else {
            *expected
        };
        let [first, second] = [source, target].map(|points| {
            // Encoded by hand: the library's writer refuses some of these clouds.
            let values = points.as_flattened().iter();
            let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
            npy("'<f4'", &format!("({}, 3)", points.len()), &bytes)
        });
        let http = post(&siege.server, [&first, &second], preset).await;
        let grpc = call(&siege.server, &[source.clone(), target.clone()], preset).await;
        for flow in [http.as_ref().ok(), grpc.as_ref().ok()]
            .into_iter()
            .flatten()
        {
            assert_eq!(flow.len(), source.len(), "{name}");
            assert!(
                flow.as_flattened().iter().all(|value| value.is_finite()),
                "{name}"
            );
        }
        if far && preset == "neural" {
            let detail = http
                .as_ref()
                .err()
                .map(|problem| problem["detail"].to_string());
            let detail = detail.unwrap_or_default();
            assert!(detail.contains("more than 20000 m on an axis"), "{detail}");
        }
        if let (Ok(http), Ok(grpc)) = (&http, &grpc) {
            assert_eq!(http, grpc, "{name}");
        }
        let told = http.as_ref().err().map_or(String::new(), Value::to_string);
        let http = http
            .map(drop)
            .map_err(|problem| problem["code"].as_str().unwrap_or_default().to_owned());
        let grpc = grpc.map(drop);
        let expected = expected.map_err(str::to_owned);
        if http != expected || grpc != expected {
            wrong.push(format!(
                "{name}, {preset}: {http:?} and {grpc:?}, not {expected:?}; {told}"
            ));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    siege.stands().await;
}

#[tokio::test]
async fn a_file_with_more_points_than_the_server_takes_is_refused_before_it_is_unfolded() {
    // Below the point limit of the readers, and below the maximum decompression ratio of a file of
    // this length.
    const POINTS: usize = 5_000_000;
    let siege = Besieged::new("").await;
    let noise: Vec<u8> = (0..4 << 20_u32)
        .map(|at: u32| (at.wrapping_mul(2_654_435_761) >> 24) as u8)
        .collect();
    let array = npy("'<f2'", &format!("({POINTS}, 3)"), &vec![0; 6 * POINTS]);
    let padding = npy("'|u1'", &format!("({},)", noise.len()), &noise);
    let file = zip(&[
        ("pc1.npy", &array),
        ("pc2.npy", &array),
        ("pad.npy", &padding),
    ]);
    let sent = reqwest::Client::new()
        .post(siege.server.url("/v1/flow"))
        .multipart(Form::new().part("source", Part::bytes(file).file_name("pair.npz")))
        .send();
    let said: Value = sent.await.expect("an answer").json().await.expect("JSON");
    assert_eq!(said["code"], "too_large", "{said}");
    assert!(
        said["detail"]
            .as_str()
            .is_some_and(|text| text.contains("2000000 are taken")),
        "{said}"
    );
    let peak = siege.server.peak_resident_bytes();
    let now = siege.server.resident_bytes();
    // The memory of the compressed file a few times over, but not of its decoded points.
    assert!(peak < now + (40 << 20), "{peak} bytes at most, {now} now");
    siege.stands().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn small_files_that_unfold_to_large_clouds_share_the_room_of_uploads() {
    const POINTS: usize = 2_000_000;
    let siege = Besieged::new("[limits]\nmax_total_upload_mib = 64\nmax_upload_mib = 64\n").await;
    let array = npy("'<f2'", &format!("({POINTS}, 3)"), &vec![0; 6 * POINTS]);
    let file = zip(&[("points.npy", &array)]);
    assert!(file.len() < 1 << 20, "{}", file.len());
    let client = reqwest::Client::new();
    let mut sent = tokio::task::JoinSet::new();
    for _ in 0..40 {
        let part = || Part::bytes(file.clone()).file_name("cloud.npz");
        let form = Form::new()
            .text("options", r#"{"ground": "keep", "ego": "off"}"#)
            .part("source", part())
            .part("target", part());
        let request = client.post(siege.server.url("/v1/jobs")).multipart(form);
        sent.spawn(async move { request.send().await.expect("an answer").status() });
    }
    while let Some(status) = sent.join_next().await {
        let status = status.expect("no panic");
        // Accepted, refused for its content or for lack of space; never an internal error.
        assert!(status != 500, "{status}");
    }
    let peak = siege.server.peak_resident_bytes();
    // Two clouds of 26 MB at a time, the data that one of them is decoded from, and its encoded
    // bytes.
    assert!(peak < 500 << 20, "{peak} bytes");
}
