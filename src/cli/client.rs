//! A minimal HTTP/1.1 client for the demo: requests to one server, each over a new TCP connection.

use std::net::SocketAddr;

use anyhow::{Context, anyhow};
use bytes::Bytes;
use http_body_util::{BodyExt, Full};
use hyper::body::Incoming;
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use serde_json::Value;
use tokio::net::TcpStream;

/// The boundary between the parts of a multipart body. The files that are sent must not contain it.
const BOUNDARY: &str = "fnsf-2f1d9c7e5b3a-boundary";

/// One part of a `multipart/form-data` body.
pub(super) struct Part<'a> {
    /// The form field's name.
    pub(super) name: &'a str,
    /// The file name, for parts that are files.
    pub(super) file: Option<&'a str>,
    /// The content.
    pub(super) bytes: &'a [u8],
}

/// A client of one server.
pub(super) struct Client {
    server: SocketAddr,
}

impl Client {
    pub(super) fn new(server: SocketAddr) -> Self {
        Self { server }
    }

    async fn send(&self, request: Request<Full<Bytes>>) -> anyhow::Result<Response<Incoming>> {
        let stream = TcpStream::connect(self.server).await?;
        let (mut sender, connection) =
            hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
        tokio::spawn(connection);
        let response = sender.send_request(request).await?;
        if response.status().is_success() {
            return Ok(response);
        }
        let status = response.status();
        let problem = response.into_body().collect().await?.to_bytes();
        let problem: Value = serde_json::from_slice(&problem).unwrap_or_default();
        let detail = problem["detail"].as_str().unwrap_or("without a word");
        Err(anyhow!("the service answered {status}: {detail}"))
    }

    /// Posts a multipart form and returns the JSON of the accepted job. Any status except 202
    /// Accepted is an error.
    pub(super) async fn post(&self, path: &str, parts: &[Part<'_>]) -> anyhow::Result<Value> {
        let mut body = Vec::new();
        for part in parts {
            let file = part.file.map(|file| format!("; filename=\"{file}\""));
            let head = format!(
                "--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"{}\"{}\r\n\r\n",
                part.name,
                file.unwrap_or_default()
            );
            body.extend(head.as_bytes());
            body.extend(part.bytes);
            body.extend(b"\r\n");
        }
        body.extend(format!("--{BOUNDARY}--\r\n").as_bytes());
        let request = Request::post(path)
            .header("host", self.server.to_string())
            .header(
                "content-type",
                format!("multipart/form-data; boundary={BOUNDARY}"),
            )
            .body(Full::from(body))?;
        let response = self.send(request).await?;
        if response.status() != StatusCode::ACCEPTED {
            return Err(anyhow!("the service answered {}", response.status()));
        }
        let body = response.into_body().collect().await?.to_bytes();
        serde_json::from_slice(&body).context("the answer is no JSON")
    }

    /// Fetches the body at a path.
    pub(super) async fn get(&self, path: &str) -> anyhow::Result<Bytes> {
        let request = Request::get(path)
            .header("host", self.server.to_string())
            .body(Full::default())?;
        Ok(self
            .send(request)
            .await?
            .into_body()
            .collect()
            .await?
            .to_bytes())
    }

    /// Reads server-sent events until the stream ends, and calls `tell` with the name and data of
    /// each.
    pub(super) async fn follow(
        &self,
        path: &str,
        mut tell: impl FnMut(&str, &Value),
    ) -> anyhow::Result<()> {
        let request = Request::get(path)
            .header("host", self.server.to_string())
            .body(Full::default())?;
        let mut body = self.send(request).await?.into_body();
        let mut text = String::new();
        while let Some(frame) = body.frame().await {
            if let Ok(piece) = frame?.into_data() {
                text.push_str(&String::from_utf8_lossy(&piece));
            }
            while let Some(end) = text.find("\n\n") {
                let event: String = text.drain(..end + 2).collect();
                let field = |key: &str| {
                    let mut lines = event.lines();
                    lines.find_map(|line| Some(line.strip_prefix(key)?.trim_start()))
                };
                if let (Some(name), Some(data)) = (field("event:"), field("data:")) {
                    tell(name, &serde_json::from_str(data)?);
                }
            }
        }
        Ok(())
    }
}
