//! Small files of every format, made by hand or by the library's writers.

use fnsf::flow::{Cluster, Objects, OrientedBox, Point, RigidTransform};
use fnsf::formats::{
    CloudFormat, FlowFormat, FlowTable, Ground, Pair, PairTruth, write_cloud, write_flow,
    write_pair_npz,
};

pub(crate) const CLOUD_FORMATS: [(CloudFormat, &str); 5] = [
    (CloudFormat::Npy, "npy"),
    (CloudFormat::Ply, "ply"),
    (CloudFormat::Pcd, "pcd"),
    (CloudFormat::Feather, "feather"),
    (CloudFormat::KittiBin, "kitti.bin"),
];

pub(crate) const FLOW_FORMATS: [FlowFormat; 6] = [
    FlowFormat::Npz,
    FlowFormat::Npy,
    FlowFormat::Feather,
    FlowFormat::Ply,
    FlowFormat::Pcd,
    FlowFormat::Json,
];

/// `count` points on a spiral, all different and none at the origin.
pub(crate) fn points(count: usize) -> Vec<Point> {
    let point = |index: usize| {
        let turn = index as f32 * 0.7;
        [
            turn.cos() * (5.0 + turn),
            turn.sin() * (5.0 + turn),
            turn * 0.01 - 1.0,
        ]
    };
    (0..count).map(point).collect()
}

pub(crate) fn pattern(count: usize, every: usize) -> Vec<bool> {
    (0..count)
        .map(|index| index.is_multiple_of(every))
        .collect()
}

pub(crate) fn ego() -> RigidTransform {
    RigidTransform::new(
        nalgebra::Vector3::new(-0.5, 0.01, 0.02),
        nalgebra::Vector3::new(0.001, -0.002, 0.03),
    )
}

pub(crate) fn pair(count: usize) -> Pair {
    let source = points(count);
    let target = points(count + 3);
    let truth = PairTruth {
        flow: source
            .iter()
            .map(|[x, y, z]| [x * 0.1, -y * 0.1, *z])
            .collect(),
        valid: pattern(count, 2),
        dynamic: Some(pattern(count, 3)),
        foreground: Some(pattern(count, 4)),
        category: Some((0..count).map(|row| (row % 31) as u8).collect()),
    };
    let ground = Ground {
        source: pattern(count, 5),
        target: pattern(count + 3, 6),
    };
    Pair {
        source,
        target,
        truth: Some(truth),
        ground: Some(ground),
        ego: Some(ego()),
    }
}

pub(crate) fn cloud_file(format: CloudFormat, points: &[Point]) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_cloud(format, points, &mut bytes).unwrap();
    bytes
}

pub(crate) fn pair_file(pair: &Pair) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_pair_npz(pair, &mut bytes).unwrap();
    bytes
}

/// Two clusters. One of them moves. Every third point is in no cluster.
pub(crate) fn objects(count: usize) -> Objects {
    let cluster = Cluster {
        points: count as u32 / 3,
        dynamic: true,
        bounds: OrientedBox {
            center: [1.0, 2.0, 3.0],
            size: [4.0, 2.0, 1.5],
            yaw: 0.5,
        },
        velocity: [0.5, -0.25, 0.0],
        yaw_rate: 0.125,
        confidence: 0.75,
        moving: 0.25,
    };
    let still = Cluster {
        dynamic: false,
        velocity: [0.0; 3],
        ..cluster
    };
    Objects {
        cluster: (0..count as i32).map(|row| row % 3 - 1).collect(),
        confidence: (0..count).map(|row| (row % 5) as f32 / 4.0).collect(),
        moving: (0..count).map(|row| (row % 9) as f32 / 8.0).collect(),
        clusters: vec![cluster, still],
    }
}

pub(crate) fn flow_file(format: FlowFormat, pair: &Pair) -> Vec<u8> {
    let truth = pair.truth.as_ref().unwrap();
    let objects = objects(pair.source.len());
    let table = FlowTable {
        source: &pair.source,
        flow: &truth.flow,
        valid: &truth.valid,
        dynamic: truth.dynamic.as_deref(),
        objects: Some(&objects),
        ego: pair.ego.as_ref(),
    };
    let mut bytes = Vec::new();
    write_flow(format, &table, &mut bytes).unwrap();
    bytes
}

/// An `.npy` file with the given header.
pub(crate) fn npy(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let fortran = if fortran { "True" } else { "False" };
    let header = format!("{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(u16::try_from(header.len()).unwrap().to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

/// A zip of arrays, each given by its name and the bytes of an `.npy` file.
pub(crate) fn npz(members: &[(&str, &[u8])]) -> Vec<u8> {
    use std::io::Write;
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in members {
        let options = zip::write::SimpleFileOptions::default();
        zip.start_file(format!("{name}.npy"), options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

pub(crate) fn floats(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

/// A feather file of float32 columns.
pub(crate) fn feather(columns: &[(&str, Vec<Option<f32>>)]) -> Vec<u8> {
    use std::sync::Arc;
    let column = |(name, values): &(&str, Vec<Option<f32>>)| {
        let array = arrow_array::Float32Array::from(values.clone());
        ((*name).to_owned(), Arc::new(array) as arrow_array::ArrayRef)
    };
    let batch = arrow_array::RecordBatch::try_from_iter_with_nullable(
        columns
            .iter()
            .map(column)
            .map(|(name, array)| (name, array, true)),
    )
    .unwrap();
    let mut bytes = Vec::new();
    let mut writer = arrow_ipc::writer::FileWriter::try_new(&mut bytes, &batch.schema()).unwrap();
    writer.write(&batch).unwrap();
    writer.finish().unwrap();
    drop(writer);
    bytes
}

/// An LZF stream of literals only, the simplest valid stream.
pub(crate) fn lzf_literals(bytes: &[u8]) -> Vec<u8> {
    let run = |chunk: &[u8]| [&[chunk.len() as u8 - 1], chunk].concat();
    bytes.chunks(32).flat_map(run).collect()
}
