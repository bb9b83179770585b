//! Tests of TLS on the public port, with a certificate that openssl makes for the test.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use crate::raw_http::{connect, exchange, status, until_closed};
use crate::server::{FREE_PORTS, Folder, Server};

const REQUEST: &[u8] = b"GET /v1/jobs HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";

/// Makes a self-signed certificate of localhost and its key; false if there is no `openssl`.
fn certificate(folder: &Path) -> bool {
    let made = Command::new("openssl")
        .args([
            "req",
            "-x509",
            "-newkey",
            "ec",
            "-pkeyopt",
            "ec_paramgen_curve:prime256v1",
        ])
        .args(["-nodes", "-days", "2", "-subj", "/CN=localhost"])
        .args(["-addext", "subjectAltName=DNS:localhost"])
        .args(["-addext", "basicConstraints=critical,CA:FALSE"])
        .arg("-keyout")
        .arg(folder.join("key.pem"))
        .arg("-out")
        .arg(folder.join("certificate.pem"))
        .output();
    match made {
        Ok(made) => {
            let log = String::from_utf8_lossy(&made.stderr);
            assert!(made.status.success(), "{log}");
            true
        }
        Err(_) => {
            eprintln!("there is no openssl: TLS is not tested");
            false
        }
    }
}

fn config(folder: &Folder) -> String {
    let path = folder.path().display();
    format!(
        "[tls]\ncertificate = \"{path}/certificate.pem\"\nkey = \"{path}/key.pem\"\n\
         [limits]\nheader_timeout_seconds = 1\n"
    )
}

/// A TLS connection that trusts the certificate and offers these ALPN protocols.
async fn secure(server: &Server, folder: &Folder, protocols: &[&str]) -> TlsStream<TcpStream> {
    let certificate = CertificateDer::from_pem_file(folder.path().join("certificate.pem"));
    let mut roots = rustls::RootCertStore::empty();
    roots
        .add(certificate.expect("a certificate"))
        .expect("a root");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = rustls::ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_root_certificates(roots)
        .with_no_client_auth();
    config.alpn_protocols = protocols
        .iter()
        .map(|name| name.as_bytes().to_vec())
        .collect();
    let stream = TcpStream::connect(&server.public)
        .await
        .expect("a connection");
    let name = ServerName::try_from("localhost").expect("a name");
    let connector = TlsConnector::from(Arc::new(config));
    connector.connect(name, stream).await.expect("a handshake")
}

#[tokio::test]
async fn both_protocols_are_served_over_tls_and_neither_without_it() {
    let folder = Folder::new();
    if !certificate(folder.path()) {
        return;
    }
    let server = Server::start_in(&folder, &config(&folder), &[]);

    let mut stream = secure(&server, &folder, &["http/1.1"]).await;
    let chosen = stream.get_ref().1.alpn_protocol().map(<[u8]>::to_vec);
    assert_eq!(chosen.as_deref(), Some(&b"http/1.1"[..]));
    stream.write_all(REQUEST).await.expect("sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.expect("an answer");
    let answer = String::from_utf8_lossy(&answer).into_owned();
    assert_eq!(status(&answer), Some(200), "{answer}");

    let stream = secure(&server, &folder, &["h2", "http/1.1"]).await;
    assert_eq!(stream.get_ref().1.alpn_protocol(), Some(&b"h2"[..]));
    let (client, connection) = h2::client::handshake(stream).await.expect("HTTP/2");
    let driving = tokio::spawn(connection);
    let request = axum::http::Request::get("https://localhost/v1/jobs").body(());
    let mut client = client.ready().await.expect("open");
    let sent = client.send_request(request.expect("a request"), true);
    let (answer, _) = sent.expect("sent");
    assert_eq!(answer.await.expect("an answer").status(), 200);
    driving.abort();

    let plain = exchange(&server, REQUEST);
    assert_ne!(status(&plain), Some(200), "{plain}");
    // A TLS handshake that does not start is subject to the timeout of request headers.
    let _alert = until_closed(connect(&server));
    let mut stalled = secure(&server, &folder, &["http/1.1"]).await;
    let mut nothing = Vec::new();
    let _cut_off = stalled.read_to_end(&mut nothing).await;
    assert!(nothing.is_empty());
}

#[test]
fn a_certificate_that_cannot_be_used_refuses_to_start() {
    let folder = Folder::new();
    let path = folder.path();
    std::fs::write(path.join("certificate.pem"), "nothing of the kind").expect("a file");
    let file = path.join("fnsf.toml");
    std::fs::write(&file, config(&folder)).expect("a file");
    let ended = Command::new(env!("CARGO_BIN_EXE_fnsf"))
        .args(FREE_PORTS)
        .arg("--data-dir")
        .arg(path.join("data"))
        .arg("--config")
        .arg(&file)
        .output()
        .expect("it runs");
    let log = String::from_utf8_lossy(&ended.stderr);
    assert!(matches!(ended.status.code(), Some(2 | 70)), "{log}");
    assert!(log.contains(".pem"), "{log}");
}

#[tokio::test]
async fn a_certificate_is_exchanged_without_a_restart() {
    let folder = Folder::new();
    if !certificate(folder.path()) {
        return;
    }
    let server = Server::start_in(&folder, &config(&folder), &[]);
    drop(secure(&server, &folder, &["http/1.1"]).await);
    // A client that trusts the new certificate alone finds it.
    certificate(folder.path());
    server.signal("HUP");
    server.until("it has read the files", || {
        server.log().contains("are read again")
    });
    drop(secure(&server, &folder, &["http/1.1"]).await);
    // A key that does not belong to the certificate changes nothing.
    let kept = std::fs::read(folder.path().join("certificate.pem")).expect("a file");
    certificate(folder.path());
    std::fs::write(folder.path().join("certificate.pem"), &kept).expect("written");
    server.signal("HUP");
    server.until("it has refused the files", || {
        server.log().contains("stay as they were")
    });
    drop(secure(&server, &folder, &["http/1.1"]).await);
}
