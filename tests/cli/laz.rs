//! Tests of compressed LAS files, which the command line alone reads.

use fnsf::flow::Point;
use fnsf::formats::{DenseFormat, read_cloud, read_pair};

use super::dense_file::dense_file as file;
use super::program::{fnsf, json, street};

#[test]
fn sweeps_as_laz_have_the_flow_of_the_same_sweeps_as_las() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let pair = std::fs::read(folder.join("street/pair_0000.npz")).expect("a pair");
    let pair = read_pair(&pair).expect("a pair");
    let flow = |format: DenseFormat, ending: &str| {
        let names = [format!("a.{ending}"), format!("b.{ending}")];
        for (name, points) in names.iter().zip([&pair.source, &pair.target]) {
            std::fs::write(folder.join(name), file(format, points)).expect("a file");
        }
        let out = format!("{ending}.npy");
        json(
            folder,
            &["flow", &names[0], &names[1], "--json", "-o", &out],
        );
        std::fs::read(folder.join(out)).expect("a flow")
    };
    assert!(flow(DenseFormat::Laz, "laz") == flow(DenseFormat::Las, "las"));
    // The library's readers, which the service uses, refuse it.
    assert!(read_cloud(&file(DenseFormat::Laz, &pair.source), None).is_err());
}

#[test]
fn a_damaged_laz_file_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let points: Vec<Point> = (0..5000)
        .map(|row| [row as f32 * 0.01, (row % 70) as f32, 0.5])
        .collect();
    let whole = file(DenseFormat::Laz, &points);
    std::fs::write(folder.join("b.laz"), &whole).expect("a file");
    let damaged = [
        ("cut", whole[..whole.len() / 2].to_vec()),
        ("header", whole[..230].to_vec()),
        ("count", {
            let mut lies = whole.clone();
            // The numbers of points of the older and the newer versions.
            lies[107..111].copy_from_slice(&u32::MAX.to_le_bytes());
            lies[247..255].copy_from_slice(&u64::MAX.to_le_bytes());
            lies
        }),
    ];
    for (name, bytes) in damaged {
        std::fs::write(folder.join("a.laz"), bytes).expect("a file");
        let ended = fnsf(folder, &["flow", "a.laz", "b.laz", "-o", "flow.npz"]);
        assert_eq!(ended.code, 65, "{name}: {}", ended.stderr);
        assert!(ended.stderr.contains("a.laz"), "{name}: {}", ended.stderr);
        assert!(
            !ended.stderr.contains("panicked"),
            "{name}: {}",
            ended.stderr
        );
    }
}
