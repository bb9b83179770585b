//! Tests of `fnsf view`: the page of local files, over a real socket.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use fnsf::formats::{read_cloud, read_flow};
use serde_json::Value;

use crate::program::{fnsf, street};

/// A running `fnsf view`. It is killed on drop.
struct View {
    child: Child,
    address: String,
    /// The path of the scene, with its secret.
    root: String,
}

impl View {
    fn start(folder: &Path, arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_fnsf"))
            .arg("view")
            .args(arguments)
            .current_dir(folder)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("the program starts");
        let mut line = String::new();
        let stdout = child.stdout.take().expect("piped");
        BufReader::new(stdout).read_line(&mut line).expect("a line");
        let shown = line.split("http://").nth(1).expect("an address");
        let shown = shown.split(' ').next().expect("an address");
        let (address, root) = shown.split_once("/#").expect("a page");
        Self {
            child,
            address: address.to_owned(),
            root: root.to_owned(),
        }
    }

    /// The status and the body of a path. `headers` end with a line break each.
    fn get(&self, path: &str, headers: &str) -> (u16, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.address).expect("it listens");
        let address = &self.address;
        let host = match headers.contains("Host:") {
            true => String::new(),
            false => format!("Host: {address}\r\n"),
        };
        write!(
            stream,
            "GET {path} HTTP/1.1\r\n{host}{headers}Connection: close\r\n\r\n"
        )
        .expect("sent");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("an answer");
        let head = answer.windows(4).position(|four| four == b"\r\n\r\n");
        let body = answer.split_off(head.expect("a head") + 4);
        let head = String::from_utf8(answer).expect("text");
        let status = head
            .split(' ')
            .nth(1)
            .and_then(|status| status.parse().ok());
        (status.expect("a status"), body)
    }

    fn scene(&self) -> Value {
        let (status, body) = self.get(&format!("{}/scene", self.root), "");
        assert_eq!(status, 200);
        serde_json::from_slice(&body).expect("JSON")
    }
}

impl Drop for View {
    fn drop(&mut self) {
        let _is_gone = self.child.kill();
        let _ended = self.child.wait();
    }
}

#[test]
fn sweeps_are_shown_with_the_flow_that_is_estimated_and_their_tracks() {
    let folder = tempfile::tempdir().expect("a folder");
    street(folder.path(), "4");
    let names: Vec<String> = (0..4)
        .map(|at| format!("street/sweep_000{at}.pcd"))
        .collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let view = View::start(folder.path(), &names);
    let scene = view.scene();
    assert_eq!(scene["sweep_names"][3], "sweep_0003.pcd");
    let bytes = std::fs::read(folder.path().join(names[1])).expect("a file");
    let sent = read_cloud(&bytes, None).expect("a cloud").points;
    let (_, packed) = view.get(scene["sweeps"][1].as_str().expect("a path"), "");
    assert_eq!(fnsf::payload::points_from_le_bytes(&packed), sent);
    assert_eq!(scene["pairs"].as_array().map(Vec::len), Some(3));
    let (_, flow) = view.get(scene["pairs"][1]["flow"].as_str().expect("a path"), "");
    let flow = read_flow(&flow, None).expect("a flow");
    assert_eq!(flow.flow.len(), sent.len());
    assert!(flow.clusters.is_some() && scene["pairs"][1]["ego"].is_array());
    let root = &view.root;
    let (status, tracks) = view.get(&format!("{root}/tracks"), "");
    assert_eq!(status, 200);
    assert!(fnsf::formats::read_tracks(&tracks).is_ok());
    let (_, page) = view.get("/", "");
    assert!(String::from_utf8_lossy(&page).contains("/console/main.js"));
    for absent in [
        format!("{root}/sweeps/4"),
        format!("{root}/dense"),
        "/v1/jobs".to_owned(),
        // Without the secret of the address.
        "/view/scene".to_owned(),
        format!("/view/{}/scene", "0".repeat(32)),
    ] {
        assert_eq!(view.get(&absent, "").0, 404, "{absent}");
    }
    // Pages of other sites, also those that have rebound a name.
    let scene = format!("{root}/scene");
    for foreign in ["Origin: http://site.example\r\n", "Host: site.example\r\n"] {
        assert_eq!(view.get(&scene, foreign).0, 403, "{foreign}");
    }
}

#[test]
fn a_dense_cloud_takes_no_argument_of_sweeps() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "2");
    let [a, b] = [0, 1].map(|at| format!("street/sweep_000{at}.pcd"));
    let dense = ["--reference-time", "0", "-o", "dense.npz"];
    let made = fnsf(folder, &[&["densify", &a, &b], &dense[..]].concat());
    assert_eq!(made.code, 0, "{}", made.stderr);
    for more in [
        ["--flow", "flow.npz"],
        ["--tracks", "tracks.json"],
        ["--poses", "poses.txt"],
    ] {
        let refused = fnsf(folder, &[&["view", "dense.npz"], &more[..]].concat());
        assert_eq!(refused.code, 2, "{more:?}");
        let said = "a dense cloud is shown alone";
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }
}

/// An array as numpy writes it: `kind` of the values, and whether the columns come first.
fn npy(kind: &str, columns_first: bool, shape: &str, values: &[u8]) -> Vec<u8> {
    let order = if columns_first { "True" } else { "False" };
    let head = format!("{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}, }}\n");
    let length = u16::try_from(head.len()).expect("a short head");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(length.to_le_bytes());
    bytes.extend(head.as_bytes());
    bytes.extend(values);
    bytes
}

#[test]
fn a_flow_of_doubles_in_columns_is_served_in_the_form_that_the_page_reads() {
    let folder = tempfile::tempdir().expect("a folder");
    street(folder.path(), "2");
    let [a, b] = [0, 1].map(|at| format!("street/sweep_000{at}.pcd"));
    let bytes = std::fs::read(folder.path().join(&a)).expect("a file");
    let rows = read_cloud(&bytes, None).expect("a cloud").points.len();
    let value = |row: usize, axis: usize| (row % 100) as f64 * 0.01 + axis as f64;
    let columns = (0..3).flat_map(|axis| (0..rows).map(move |row| value(row, axis)));
    let columns: Vec<u8> = columns.flat_map(f64::to_le_bytes).collect();
    let path = folder.path().join("doubles.npz");
    let mut file = zip::ZipWriter::new(std::fs::File::create(path).expect("a file"));
    for (name, array) in [
        (
            "flow.npy",
            npy("<f8", true, &format!("({rows}, 3)"), &columns),
        ),
        (
            "valid.npy",
            npy("|b1", false, &format!("({rows},)"), &vec![1; rows]),
        ),
    ] {
        let options = zip::write::SimpleFileOptions::default();
        file.start_file(name, options).expect("an entry");
        file.write_all(&array).expect("written");
    }
    file.finish().expect("written");
    let view = View::start(folder.path(), &[&a, &b, "--flow", "doubles.npz"]);
    let (_, served) = view.get(&format!("{}/flows/0", view.root), "");
    let shown = read_flow(&served, None).expect("a flow").flow;
    let expected = |row: usize| [0, 1, 2].map(|axis| value(row, axis) as f32);
    assert!(
        shown
            .iter()
            .enumerate()
            .all(|(row, flow)| *flow == expected(row))
    );
    let served = std::io::Cursor::new(served);
    let mut served = zip::ZipArchive::new(served).expect("an archive");
    let mut head = Vec::new();
    let mut flow = served.by_name("flow.npy").expect("the flow");
    flow.read_to_end(&mut head).expect("its bytes");
    let head = String::from_utf8_lossy(&head[..128]).into_owned();
    assert!(head.contains("'<f4'") && head.contains("False"), "{head}");
}

#[test]
fn a_given_flow_is_shown_as_it_is_and_one_of_other_sweeps_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    street(folder.path(), "3");
    let [a, b, c] = [0, 1, 2].map(|at| format!("street/sweep_000{at}.pcd"));
    for flow in ["flow.npz", "flow.ply", "flow.feather"] {
        let ended = fnsf(folder.path(), &["flow", &a, &b, "-o", flow]);
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        let view = View::start(folder.path(), &[&a, &b, "--flow", flow]);
        let (_, shown) = view.get(&format!("{}/flows/0", view.root), "");
        let shown = read_flow(&shown, None).expect("a flow");
        let given = std::fs::read(folder.path().join(flow)).expect("a file");
        let given = read_flow(&given, None).expect("a flow");
        assert_eq!(shown.flow, given.flow, "{flow}");
        assert_eq!(shown.confidence, given.confidence, "{flow}");
        assert!(shown.moving.is_some(), "{flow}");
    }
    let too_few = fnsf(folder.path(), &["view", &a, &b, &c, "--flow", "flow.npz"]);
    assert_eq!(too_few.code, 2);
    assert!(too_few.stderr.contains("2 pairs"), "{}", too_few.stderr);
    let other = fnsf(folder.path(), &["view", &c, &b, "--flow", "flow.npz"]);
    assert_eq!(other.code, 65);
    assert!(other.stderr.contains("rows"), "{}", other.stderr);
    let alone = View::start(folder.path(), &[&a, &b, "--no-flow"]);
    assert_eq!(alone.scene()["pairs"].as_array().map(Vec::len), Some(0));
}
