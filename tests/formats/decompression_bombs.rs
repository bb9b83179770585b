//! Tests of files that declare far more data than they contain. They are read in a separate
//! process, whose peak memory is checked: a file must be refused before memory is allocated for it.

use std::io::Write;

use fnsf::formats::{read_cloud, read_flow, read_pair};

use crate::process_memory::memory_bytes;
use crate::samples::npy;

/// Maximum resident memory of the process that reads the files, bytes.
const MAX_RESIDENT: u64 = 100 << 20;

/// Environment variable that is set in the process that reads the files.
const CHILD: &str = "FNSF_BOMBS_CHILD";

#[test]
fn hostile_files_are_refused_in_little_memory() {
    if std::env::var_os(CHILD).is_none() {
        let child = std::process::Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "decompression_bombs::hostile_files_are_refused_in_little_memory",
            ])
            .env(CHILD, "1")
            .output()
            .unwrap();
        let log = String::from_utf8_lossy(&child.stdout);
        assert!(child.status.success() && log.contains("1 passed"), "{log}");
        return;
    }
    for (name, bytes) in bombs() {
        assert!(bytes.len() < 4 << 20, "{name} is not small");
        let refused = read_cloud(&bytes, None).is_err()
            && read_flow(&bytes, None).is_err()
            && read_pair(&bytes).is_err();
        assert!(refused, "{name}");
        if let Some(resident) = memory_bytes(std::process::id(), "VmHWM:") {
            assert!(resident < MAX_RESIDENT, "{name}: {resident} bytes");
        }
    }
}

fn bombs() -> Vec<(&'static str, Vec<u8>)> {
    let text = |text: &str| text.as_bytes().to_vec();
    let ply = |encoding: &str, vertices: &str, before: &str| {
        text(&format!(
            "ply\nformat {encoding} 1.0\n{before}element vertex {vertices}\nproperty float x\n\
             property float y\nproperty float z\nend_header\n1 2 3\n"
        ))
    };
    let pcd = |width: &str, height: &str, count: &str, data: &str| {
        let mut bytes = text(&format!(
            "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 {count}\nWIDTH {width}\n\
             HEIGHT {height}\nDATA {data}\n"
        ));
        bytes.extend([
            9, 0, 0, 0, 0xff, 0xff, 0xff, 0xff, 1, 2, 3, 4, 5, 6, 7, 8, 9,
        ]);
        bytes
    };
    let huge = "18446744073709551615";
    vec![
        (
            "npy of many rows",
            npy("'<f4'", false, "(40000000, 3)", &[0; 12]),
        ),
        (
            "npy that overflows",
            npy("'<f8'", false, &format!("({huge}, {huge})"), &[0; 12]),
        ),
        (
            "npy of no columns",
            npy("'<f4'", false, "(40000000, 0)", &[]),
        ),
        (
            "ply of many rows",
            ply("binary_little_endian", "49000000", ""),
        ),
        (
            "ply past every limit",
            ply("binary_little_endian", huge, ""),
        ),
        ("ascii ply of many rows", ply("ascii", "49000000", "")),
        (
            "ply with a long element before",
            ply(
                "binary_big_endian",
                "1",
                &format!("element face {huge}\nproperty list uint double ids\n"),
            ),
        ),
        ("pcd of many rows", pcd("49000000", "1", "1", "binary")),
        ("pcd that overflows", pcd(huge, huge, "1", "binary")),
        (
            "pcd of many numbers",
            pcd("40000000", "1", "9999999999", "ascii"),
        ),
        (
            "compressed pcd that lies",
            pcd("40000000", "1", "1", "binary_compressed"),
        ),
        ("npz that unfolds a thousandfold", zip_bomb(40_000_000)),
        ("npz of many members", many_members()),
        ("feather whose buffers lie", feather_bomb()),
        (
            "feather whose columns share a long name",
            feather_of_one_name(),
        ),
        ("ply whose header has no end", endless(b"ply\ncomment ")),
        (
            "pcd whose header has no end",
            endless(b"VERSION .7\nFIELDS "),
        ),
    ]
}

/// A zip of two arrays of `rows` zero points each. With 40 million rows, about a gigabyte in about
/// a megabyte.
fn zip_bomb(rows: usize) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for name in ["pc1.npy", "flow.npy"] {
        zip.start_file(name, zip::write::SimpleFileOptions::default())
            .unwrap();
        zip.write_all(&npy("'<f4'", false, &format!("({rows}, 3)"), &[]))
            .unwrap();
        let zeros = vec![0; 1 << 16];
        let mut left = rows * 12;
        while left > 0 {
            let chunk = left.min(zeros.len());
            zip.write_all(&zeros[..chunk]).unwrap();
            left -= chunk;
        }
    }
    zip.finish().unwrap().into_inner()
}

fn many_members() -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for index in 0..20_000 {
        zip.start_file(
            format!("{index}.npy"),
            zip::write::SimpleFileOptions::default(),
        )
        .unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// A valid file whose compressed buffers are changed to declare 2^62 bytes each.
fn feather_bomb() -> Vec<u8> {
    let mut bytes = Vec::new();
    let zeros = vec![[0.0; 3]; 1000];
    fnsf::formats::write_cloud(fnsf::formats::CloudFormat::Feather, &zeros, &mut bytes).unwrap();
    let declared = 4000_u64.to_le_bytes();
    let indices: Vec<usize> = (0..bytes.len() - 8)
        .filter(|&index| bytes[index..index + 8] == declared)
        .collect();
    assert!(
        indices.len() >= 3,
        "compressed buffers begin with their length"
    );
    for index in indices {
        bytes[index..index + 8].copy_from_slice(&(1_u64 << 62).to_le_bytes());
    }
    bytes
}

/// A header whose line goes on for megabytes, in short words.
fn endless(beginning: &[u8]) -> Vec<u8> {
    let mut bytes = beginning.to_vec();
    bytes.extend(b"a ".repeat(1_900_000));
    bytes
}

/// A file of 900 columns that share one field, whose name has a megabyte.
fn feather_of_one_name() -> Vec<u8> {
    let mut builder = flatbuffers::FlatBufferBuilder::new();
    let name = builder.create_string(&"n".repeat(1 << 20));
    let float = arrow_ipc::FloatingPointBuilder::new(&mut builder).finish();
    let mut field = arrow_ipc::FieldBuilder::new(&mut builder);
    field.add_name(name);
    field.add_type_type(arrow_ipc::Type::FloatingPoint);
    field.add_type_(float.as_union_value());
    let field = field.finish();
    let fields = builder.create_vector(&[field; 900]);
    let mut schema = arrow_ipc::SchemaBuilder::new(&mut builder);
    schema.add_fields(fields);
    let schema = schema.finish();
    let mut footer = arrow_ipc::FooterBuilder::new(&mut builder);
    footer.add_schema(schema);
    let footer = footer.finish();
    builder.finish(footer, None);
    let footer = builder.finished_data();
    let mut bytes = b"ARROW1\0\0".to_vec();
    bytes.extend(footer);
    bytes.extend((footer.len() as i32).to_le_bytes());
    bytes.extend(b"ARROW1");
    bytes
}
