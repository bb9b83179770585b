//! The HTTP client of the commands that talk to a server.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use reqwest::multipart::Form;
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde_json::Value;
use url::Url;

use super::failure::Failure;
use crate::text::without_user;

/// Which server to talk to.
#[derive(Debug, Args)]
pub(super) struct ServerFlags {
    /// Address of the server
    #[arg(
        long,
        global = true,
        value_name = "URL",
        env = "FNSF_SERVER",
        default_value = "http://127.0.0.1:8080",
        value_parser = address
    )]
    server: Url,
    /// File with the API key; otherwise it is taken from FNSF_API_KEY
    #[arg(long, global = true, value_name = "FILE")]
    key_file: Option<PathBuf>,
}

/// Parses the address of a server.
fn address(text: &str) -> Result<Url, String> {
    let address = Url::parse(text).ok();
    let address = address.filter(|url| matches!(url.scheme(), "http" | "https"));
    address.ok_or_else(|| "an address such as http://127.0.0.1:8080 is needed".to_owned())
}

impl ServerFlags {
    /// A client of this server.
    pub(super) fn client(&self) -> Result<Client, Failure> {
        let key = match &self.key_file {
            None => std::env::var("FNSF_API_KEY").ok(),
            Some(path) => Some(
                std::fs::read_to_string(path)
                    .with_context(|| format!("cannot read {}", path.display()))
                    .map_err(Failure::usage)?,
            ),
        };
        let key = key.map(|key| key.trim().to_owned());
        Client::new(self.server.clone(), key.filter(|key| !key.is_empty())).map_err(Failure::usage)
    }
}

/// Runs a command that talks to a server.
///
/// # Errors
/// That of the command, or an internal one if the runtime cannot be started.
pub(super) fn block_on<T>(command: impl Future<Output = Result<T, Failure>>) -> Result<T, Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.map_err(Failure::internal)?.block_on(command)
}

/// An answer of the server other than 2xx.
#[derive(Debug, thiserror::Error)]
#[error("the server answered {status}: {detail}")]
struct Refused {
    status: StatusCode,
    code: String,
    detail: String,
}

/// The failure of a command by an error of the client: wrong options are an error of usage, and sweeps
/// that the server refuses are bad input.
pub(super) fn failure(error: anyhow::Error) -> Failure {
    let refused = error.downcast_ref::<Refused>();
    let refused = refused.map(|refused| (refused.status, refused.code.as_str()));
    match refused {
        Some((_, "bad_request" | "invalid_options")) => Failure::usage(error),
        Some((
            StatusCode::PAYLOAD_TOO_LARGE
            | StatusCode::UNSUPPORTED_MEDIA_TYPE
            | StatusCode::UNPROCESSABLE_ENTITY,
            _,
        )) => Failure::bad_input(error),
        _ => Failure::internal(error),
    }
}

/// Whether a request may succeed when it is repeated: the server was not reached, or it starts or stops.
pub(super) fn may_pass(error: &anyhow::Error) -> bool {
    match error.downcast_ref::<Refused>() {
        Some(refused) => refused.status == StatusCode::SERVICE_UNAVAILABLE,
        None => error.is::<reqwest::Error>(),
    }
}

/// A client of one server.
pub(super) struct Client {
    server: Url,
    key: Option<String>,
    http: reqwest::Client,
}

impl Client {
    pub(super) fn new(server: Url, key: Option<String>) -> anyhow::Result<Self> {
        let _named_already = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder()
            .user_agent(concat!("fnsf/", env!("CARGO_PKG_VERSION")))
            .build()?;
        Ok(Self { server, key, http })
    }

    /// A request to a path, which may have a query.
    pub(super) fn request(&self, method: Method, path: &str) -> anyhow::Result<RequestBuilder> {
        let request = self.http.request(method, self.server.join(path)?);
        Ok(match &self.key {
            None => request,
            Some(key) => request.bearer_auth(key),
        })
    }

    /// Sends a request. An answer other than 2xx is an error with the reason that the server gives.
    pub(super) async fn send(&self, request: RequestBuilder) -> anyhow::Result<Response> {
        let unreachable = || format!("cannot reach {}", without_user(self.server.as_str()));
        let response = request.send().await.with_context(unreachable)?;
        if response.status().is_success() {
            return Ok(response);
        }
        let status = response.status();
        let problem: Value = response.json().await.unwrap_or_default();
        let text = |key: &str| problem[key].as_str().map(ToOwned::to_owned);
        Err(Refused {
            status,
            code: text("code").unwrap_or_default(),
            detail: text("detail").unwrap_or_else(|| "without a word".to_owned()),
        }
        .into())
    }

    /// Sends a request without a body, and reads the JSON of its answer; null of an empty one.
    pub(super) async fn call(&self, method: Method, path: &str) -> anyhow::Result<Value> {
        let body = self
            .send(self.request(method, path)?)
            .await?
            .bytes()
            .await?;
        match body.is_empty() {
            true => Ok(Value::Null),
            false => serde_json::from_slice(&body).context("the answer is no JSON"),
        }
    }

    /// Posts a form, and reads the JSON of its answer.
    pub(super) async fn post(&self, path: &str, form: Form) -> anyhow::Result<Value> {
        let request = self.request(Method::POST, path)?.multipart(form);
        let answer = self.send(request).await?.json().await;
        answer.context("the answer is no JSON")
    }

    /// Reads server-sent events until the stream ends, and calls `tell` with the name and data of
    /// each.
    pub(super) async fn follow(
        &self,
        path: &str,
        mut tell: impl FnMut(&str, &Value),
    ) -> anyhow::Result<()> {
        let mut response = self.send(self.request(Method::GET, path)?).await?;
        let mut bytes = Vec::new();
        while let Some(piece) = response.chunk().await? {
            bytes.extend_from_slice(&piece);
            // A piece may end within a character; an event does not.
            while let Some(end) = bytes.windows(2).position(|two| two == b"\n\n") {
                let event: Vec<u8> = bytes.drain(..end + 2).collect();
                let event = String::from_utf8_lossy(&event);
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
