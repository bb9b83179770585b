//! Seeds: small valid inputs of every target, from the library's own writers, from texts, and from the
//! beginnings of real sweeps where `FNSF_REAL_DATA` names them.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow_array::{ArrayRef, RecordBatch, StringArray};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::depth::DepthImage;
use fnsf::flow::{Estimate, Point, Preset, Problem, Uncontrolled, estimate};
use fnsf::formats::{
    Cloud, CloudFormat, DenseFormat, FlowFormat, FlowTable, Pair, read_cloud, read_pair,
    write_cloud, write_dense, write_depth_png, write_flow, write_pair_npz, write_timed_pcd,
};
use fnsf::payload::{StoredCloud, StoredDense, StoredFlow};
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::file::properties::WriterProperties;

/// Writes the seeds of all targets into folders of their names.
pub(crate) fn write(folder: &Path) {
    let seeds = Seeds(folder.to_owned());
    let clouds = clouds();
    for (name, cloud) in &clouds {
        seeds.cloud(name, cloud);
    }
    let (source, target) = street();
    let found = found(&source, &target);
    seeds.flows(&source, &target, &found);
    seeds.payloads(&source, &found);
    seeds.recordings();
    seeds.texts();
    seeds.manifests();
    seeds.requests(&source[..20], &target[..20]);
    seeds.steps();
}

struct Seeds(PathBuf);

impl Seeds {
    fn put(&self, target: &str, name: &str, bytes: &[u8]) {
        let folder = self.0.join(target);
        fs::create_dir_all(&folder).expect("a folder");
        fs::write(folder.join(name), bytes).expect("a file");
    }

    fn cloud(&self, name: &str, points: &[Point]) {
        for (format, target) in [
            (CloudFormat::Npy, "npy"),
            (CloudFormat::Ply, "ply"),
            (CloudFormat::Pcd, "pcd"),
            (CloudFormat::Feather, "feather"),
            (CloudFormat::KittiBin, "bin"),
        ] {
            let mut bytes = Vec::new();
            write_cloud(format, points, &mut bytes).expect("a cloud");
            self.put(target, name, &bytes);
        }
        let times: Vec<f32> = (0..points.len()).map(|row| row as f32 * 1e-3).collect();
        let mut bytes = Vec::new();
        write_timed_pcd(points, &times, &mut bytes).expect("a cloud");
        self.put("pcd", &format!("{name}-timed"), &bytes);
        let dense = fnsf::flow::DenseCloud {
            points: points.to_vec(),
            sweep: vec![1; points.len()],
            age: vec![0.5; points.len()],
            dynamic: vec![true; points.len()],
            converged: vec![false; points.len()],
        };
        for (format, target) in [
            (DenseFormat::Las, "las"),
            (DenseFormat::Ply, "ply"),
            (DenseFormat::Pcd, "pcd"),
            (DenseFormat::Npz, "npz"),
        ] {
            let mut bytes = Vec::new();
            write_dense(format, &dense, None, &mut bytes).expect("a cloud");
            self.put(target, &format!("{name}-dense"), &bytes);
        }
        let stored = StoredDense(dense).to_bytes();
        self.put(
            "payload",
            &format!("{name}-dense"),
            &stored[..stored.len() - 16],
        );
        if points.len() < 2 {
            return;
        }
        let image = DepthImage {
            width: 2,
            height: points.len() as u32 / 2,
            metres: points
                .iter()
                .map(|point| point[0].abs())
                .take(points.len() / 2 * 2)
                .collect(),
        };
        let mut bytes = Vec::new();
        write_depth_png(&image, &mut bytes).expect("an image");
        self.put("png", name, &bytes);
    }

    fn flows(&self, source: &[Point], target: &[Point], found: &Estimate) {
        let table = FlowTable::new(source, found);
        for (format, target) in [
            (FlowFormat::Npz, "npz"),
            (FlowFormat::Npy, "npy"),
            (FlowFormat::Feather, "feather"),
            (FlowFormat::Ply, "ply"),
            (FlowFormat::Pcd, "pcd"),
            (FlowFormat::Json, "json"),
        ] {
            let mut bytes = Vec::new();
            write_flow(format, &table, &mut bytes).expect("a flow");
            self.put(target, "flow", &bytes);
        }
        let pair = Pair {
            source: source.to_vec(),
            target: target.to_vec(),
            ..Pair::default()
        };
        let mut bytes = Vec::new();
        write_pair_npz(&pair, &mut bytes).expect("a pair");
        self.put("npz", "pair", &bytes);
    }

    fn payloads(&self, source: &[Point], found: &Estimate) {
        let cloud = StoredCloud {
            points: source.to_vec(),
            ground: Some(vec![true; source.len()]),
            pose: Some(fnsf::flow::RigidTransform::identity()),
            ..StoredCloud::default()
        };
        let bytes = cloud.to_bytes();
        self.put("payload", "cloud", &bytes[..bytes.len() - 16]);
        let bytes = StoredFlow::from(found.clone()).to_bytes();
        self.put("payload", "flow", &bytes[..bytes.len() - 16]);
        let bytes = found.motion.to_bytes();
        self.put("snapshot", "objects", &bytes[..bytes.len() - 8]);
        let still = b"FNSFFILD\x01\0\0\0\0";
        let identity = [0.0_f64, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
        let identity = identity.iter().flat_map(|value| value.to_le_bytes());
        for kind in 0..5 {
            let mut bytes = still.to_vec();
            bytes.extend(identity.clone());
            bytes.push(kind);
            bytes.extend([0; 64]);
            self.put("snapshot", &format!("kind-{kind}"), &bytes);
        }
        let mut bytes = b"FNSFSNAP\x05\0\0\0".to_vec();
        bytes.extend([0; 8 * 3 + 4 + 1 + 4 + 8 + 4 + 1 + 4]);
        bytes.extend(4_u64.to_le_bytes());
        bytes.extend([0; 4 * 4 * 4]);
        self.put("snapshot", "fit", &bytes);
    }

    /// Manifests as Parquet: two columns of text, with each compression.
    fn manifests(&self) {
        let text = |rows: [&str; 3]| Arc::new(StringArray::from(rows.to_vec())) as ArrayRef;
        let columns = [
            ("drive", text(["d", "d", "e"])),
            ("sweep", text(["0.pcd", "1.pcd", "s3://lake/2.pcd"])),
        ];
        let batch = RecordBatch::try_from_iter(columns).expect("columns");
        for (name, compression) in [
            ("plain", Compression::UNCOMPRESSED),
            ("snappy", Compression::SNAPPY),
            ("lz4", Compression::LZ4_RAW),
        ] {
            let properties = WriterProperties::builder().set_compression(compression);
            let mut bytes = Vec::new();
            let mut writer =
                ArrowWriter::try_new(&mut bytes, batch.schema(), Some(properties.build()))
                    .expect("a writer");
            writer.write(&batch).expect("written");
            writer.close().expect("closed");
            self.put("parquet", name, &bytes);
        }
    }

    fn recordings(&self) {
        self.put(
            "mcap",
            "ros1",
            include_bytes!("../tests/formats/recordings/ros1_lz4.mcap"),
        );
        self.put(
            "mcap",
            "ros2",
            include_bytes!("../tests/formats/recordings/ros2_zstd.mcap"),
        );
        self.put(
            "mcap",
            "plain",
            include_bytes!("../tests/formats/recordings/ros2_none.mcap"),
        );
        self.put(
            "scene",
            "plain",
            include_bytes!("../tests/formats/scenes/plain.h5"),
        );
        self.put(
            "scene",
            "gzip",
            include_bytes!("../tests/formats/scenes/gzip.h5"),
        );
        self.put(
            "scene",
            "lzf",
            include_bytes!("../tests/formats/scenes/lzf.h5"),
        );
    }

    fn texts(&self) {
        let poses = "1 0 0 0.5 0 1 0 0 0 0 1 0\n1 0 0 0.5 0 1 0 0 0 0 1 0\n";
        let camera = "P2: 700 0 600 40 0 700 180 0.2 0 0 1 0.003\nR0_rect: 1 0 0 0 1 0 0 0 1\n\
                      Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n";
        let matrix = "1 0 0 0.5 0 1 0 0 0 0 1 0 0 0 0 1\n";
        for (name, text) in [("poses", poses), ("camera", camera), ("motion", matrix)] {
            self.put("calibration", name, &[b"\0\0", text.as_bytes()].concat());
        }
        let json = "{\"width\":1242,\"height\":375,\"K\":[[700,0,600],[0,700,180],[0,0,1]],\
                    \"camera_from_lidar\":[[0,-1,0,0],[0,0,-1,0],[1,0,0,0],[0,0,0,1]]}";
        self.put("calibration", "json", &[b"\0\0", json.as_bytes()].concat());
        let place = "{\"R\":[1.0,0.0,0.0,1.0],\"t\":[10.0,20.0],\"s\":3.333}";
        let mut heights = Vec::new();
        write_cloud(CloudFormat::Npy, &[[1.0, 2.0, 3.0]; 4], &mut heights).expect("an array");
        let length = (place.len() as u16).to_le_bytes();
        self.put(
            "raster",
            "raster",
            &[&length, place.as_bytes(), &heights].concat(),
        );
        for (name, text) in [
            ("numbers", "0000000001.bin\n0000000002.bin\n10.bin\n9.bin\n"),
            (
                "nuscenes",
                "n015__LIDAR_TOP__1532402927647951.pcd.bin\nn015__LIDAR_TOP__1532402927697731.pcd.bin\n",
            ),
            (
                "argoverse",
                "315966265259836000.feather\n315966265360032000.feather\n",
            ),
        ] {
            self.put("names", name, text.as_bytes());
        }
        let csv = "drive,sweep,time_s,timestamp_ns,pose\na,0.pcd,0.0,,\"[1,0,0,0,0,1,0,0,0,0,1,0]\"\na,1.pcd,0.1,,\n";
        self.put("manifest", "sweeps", csv.as_bytes());
        self.put(
            "manifest",
            "pairs",
            b"source,target,drive,id\na.pcd,b.pcd,d,1\n",
        );
        let tracks = "{\"tracks\":[{\"id\":1,\"states\":[]}]}";
        self.put("json", "tracks", tracks.as_bytes());
        self.put(
            "json",
            "poses",
            b"[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]",
        );
        for (name, text) in [
            (
                "preset",
                "{\"preset\":\"paper\",\"seed\":7,\"max_points\":8192,\"ego\":\"auto\",\"ground\":\"keep\"}",
            ),
            (
                "field",
                "{\"preset\":\"neural\",\"field\":{\"max_iterations\":50,\"cell_m\":0.2},\"precision\":\"f16\",\"device\":\"gpu\"}",
            ),
            (
                "job",
                "{\"labels\":{\"a\":\"b\"},\"webhook\":\"https://hooks.example/a\",\"priority\":\"high\",\"deadline_ms\":500,\"densify\":{\"reference_time\":1.5}}",
            ),
            (
                "motion",
                "{\"ego\":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]],\"dt_s\":0.1,\"crop_m\":50,\"min_range_m\":2,\"force\":true}",
            ),
        ] {
            self.put("options", name, text.as_bytes());
        }
        let example = include_bytes!("../deploy/fnsf.example.toml");
        self.put("config", "example", example);
        let keys = "listen = \"127.0.0.1:0\"\n[limits]\nmax_points = 100\n[[keys]]\ntenant = \"a\"\nrole = \"write\"\nkey = \"0123456789abcdef\"\n";
        self.put("config", "keys", keys.as_bytes());
        for (name, url) in [
            ("hook", "https://hooks.example/a/b/c?x=1"),
            ("bucket", "s3://bucket/sweeps/a/0.pcd"),
            ("up", "https://hooks.example/a/b/../c"),
        ] {
            self.put("urls", name, url.as_bytes());
        }
    }

    fn requests(&self, source: &[Point], target: &[Point]) {
        let file = |points: &[Point]| {
            let mut bytes = Vec::new();
            write_cloud(CloudFormat::Npy, points, &mut bytes).expect("a cloud");
            bytes
        };
        let part = |name: &str, bytes: &[u8]| {
            let head = format!(
                "--x\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"0.npy\"\r\n\r\n"
            );
            [head.as_bytes(), bytes, b"\r\n"].concat()
        };
        let multipart = "content-type: multipart/form-data; boundary=x\n\n";
        let end = b"--x--\r\n".to_vec();
        let (one, two) = (file(source), file(target));
        let options = part("options", b"{\"ground\":\"keep\"}");
        let pair = [
            part("source", &one),
            part("target", &two),
            options,
            end.clone(),
        ]
        .concat();
        let sweeps = [
            part("sweep", &one),
            part("sweep", &two),
            part("sweep", &one),
            end,
        ]
        .concat();
        for (name, first, body) in [
            ("flow", "POST /v1/flow\n", &pair),
            (
                "job",
                "POST /v1/jobs\nidempotency-key: k\nprefer: wait=0\n",
                &pair,
            ),
            ("sequence", "POST /v1/sequences\n", &sweeps),
        ] {
            self.put(
                "http",
                name,
                &[first.as_bytes(), multipart.as_bytes(), body].concat(),
            );
        }
        let id = "01890a5d-ac96-774b-bcce-b302099a8057";
        for (name, line) in [
            (
                "list",
                "GET /v1/jobs?limit=2&state=queued&label=a%3Db\n\n".to_owned(),
            ),
            ("get", format!("GET /v1/jobs/{id}?wait=1\n\n")),
            (
                "result",
                format!(
                    "GET /v1/jobs/{id}/result\naccept: application/x-ply\nrange: bytes=0-9\n\n"
                ),
            ),
            ("delete", format!("DELETE /v1/jobs/{id}\n\n")),
            ("share", format!("POST /v1/jobs/{id}/share?seconds=9\n\n")),
            ("street", "GET /v1/street/0?seed=1\n\n".to_owned()),
            ("page", "GET /\nif-none-match: \"a\"\n\n".to_owned()),
        ] {
            self.put("http", name, line.as_bytes());
        }
        let bytes = |points: &[Point]| fnsf::payload::points_to_le_bytes(points);
        // Messages of protobuf: a tag, a length, and the fields.
        let field = |number: u8, body: &[u8]| {
            let mut message = vec![number << 3 | 2];
            let mut length = body.len();
            while length > 127 {
                message.push(length as u8 | 128);
                length >>= 7;
            }
            message.push(length as u8);
            message.extend(body);
            message
        };
        let call = |method: u8, messages: &[Vec<u8>]| {
            let mut call = vec![method];
            for message in messages {
                call.extend((message.len() as u16).to_le_bytes());
                call.extend(message);
            }
            call
        };
        let begin = field(1, &field(1, &[8, 1]));
        let chunk = |cloud: &[u8], points: &[Point]| {
            field(2, &[cloud, &field(2, &field(1, &bytes(points)))].concat())
        };
        let messages = [
            begin.clone(),
            chunk(&[8, 1], source),
            chunk(&[8, 2], target),
        ];
        for method in 0..3 {
            self.put(
                "grpc",
                &format!("stream-{method}"),
                &call(method, &messages),
            );
        }
        let sweep = field(2, &field(1, b"0.pcd"));
        let chunk = field(3, &field(1, &bytes(source)));
        let messages = [begin, sweep.clone(), chunk.clone(), sweep, chunk];
        for method in 0..3 {
            self.put(
                "grpc",
                &format!("sweeps-{method}"),
                &call(method, &messages),
            );
        }
        for method in 3..11 {
            self.put(
                "grpc",
                &format!("job-{method}"),
                &call(method, &[field(1, id.as_bytes())]),
            );
        }
    }

    fn steps(&self) {
        // Any bytes are a schedule, a pair of clouds, or changes of rows.
        let mut state = 1_u64;
        let mut byte = move || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 56) as u8
        };
        for target in ["queue", "rows", "pair", "sequence"] {
            for number in 0..12 {
                let bytes: Vec<u8> = (0..40 + number * 40).map(|_| byte()).collect();
                self.put(target, &format!("random-{number}"), &bytes);
            }
        }
    }
}

/// Few points of a simulated street.
fn street() -> (Vec<Point>, Vec<Point>) {
    let options = fnsf::flow::simulate::StreetOptions {
        beams: 16,
        azimuth_steps: 100,
        ..fnsf::flow::simulate::StreetOptions::default()
    };
    let pair = fnsf::flow::simulate::Street::new(&options).and_then(|street| street.pair(0));
    let pair = pair.expect("a street");
    (pair.source, pair.target)
}

fn found(source: &[Point], target: &[Point]) -> Estimate {
    let backend = CpuBackend::new(Some(1)).expect("a backend");
    let mut options = Preset::Default.options(None);
    options.force = true;
    let problem = Problem::pair(source, target);
    estimate(&backend, &problem, &options, &Uncontrolled).expect("an estimate")
}

/// Clouds of a few points: of our own, and the beginnings of real sweeps.
fn clouds() -> Vec<(String, Vec<Point>)> {
    let mut clouds = vec![
        ("none".to_owned(), Vec::new()),
        ("one".to_owned(), vec![[1.0, -2.0, 0.5]]),
        (
            "line".to_owned(),
            (0..9).map(|x| [x as f32, 0.25, -1.5]).collect(),
        ),
    ];
    let Some(data) = std::env::var_os("FNSF_REAL_DATA").map(PathBuf::from) else {
        return clouds;
    };
    for file in [
        "av2_7fab/315966265259836000.feather",
        "kitti_0000/0000000000.pcd",
    ] {
        let bytes = fs::read(data.join(file)).expect("real data");
        let Cloud { mut points, .. } = read_cloud(&bytes, Some(file)).expect("a sweep");
        points.truncate(24);
        clouds.push((file.replace('/', "-"), points));
    }
    let bytes = fs::read(data.join("small_gicp/pair.npz")).expect("real data");
    let mut pair = read_pair(&bytes).expect("a pair");
    pair.source.truncate(24);
    clouds.push(("small_gicp".to_owned(), pair.source));
    clouds
}
