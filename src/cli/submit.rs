//! `fnsf submit`: sweeps to a server, and the flow back.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};

use super::client::{Client, ServerFlags, block_on};
use super::failure::Failure;
use super::files;
use super::output::say;
use super::terminal::Terminal;
use super::unfinished::Unfinished;
use crate::flow::{Control, Progress};

/// Submit sweeps to a server as a job, wait for its end and fetch the result.
///
/// Two sweeps are a pair, more are a sequence. The result of a sequence is a zip file with one flow a
/// pair, or one dense cloud if options ask for it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf submit a.pcd b.pcd -o flow.npz\n  \
    fnsf submit drive/*.pcd --preset label --label drive=7 -o flows.zip\n  \
    fnsf submit a.pcd b.pcd --detach    # prints the id; fnsf jobs show ID")]
pub(super) struct Submit {
    #[command(flatten)]
    server: ServerFlags,
    /// Sweeps in the order of time, in any format that the service reads
    #[arg(required = true, num_args = 1.., value_name = "SWEEP")]
    sweeps: Vec<PathBuf>,
    /// File for the result; its extension chooses the format
    #[arg(short, long, value_name = "FILE", required_unless_present = "detach")]
    output: Option<PathBuf>,
    /// Preset
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// Label of the job; repeat it for several
    #[arg(long, value_name = "NAME=VALUE")]
    label: Vec<String>,
    /// Webhook: a URL to which the server posts a notice when the job ends
    #[arg(long, value_name = "URL")]
    webhook: Option<String>,
    /// URI to which the server writes the result, such as s3://labels/0001.feather; of a sequence with
    /// {index} for the index of each pair
    #[arg(long, value_name = "URI")]
    result_uri: Option<String>,
    /// More options, a JSON object as in the API
    #[arg(long, value_name = "JSON", default_value = "{}")]
    options: String,
    /// Key under which a repeated submission finds the first one's job
    #[arg(long, value_name = "KEY")]
    idempotency_key: Option<String>,
    /// Print the job's id and do not wait
    #[arg(long, conflicts_with = "output")]
    detach: bool,
}

impl Submit {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let client = self.server.client()?;
        let options = self.options().map_err(Failure::usage)?;
        block_on(self.answer(&client, &options))
    }

    /// The options of the job as one JSON object.
    fn options(&self) -> anyhow::Result<Value> {
        let mut options: Value = serde_json::from_str(&self.options).context("--options")?;
        let object = options.as_object_mut();
        let object = object.context("--options is one JSON object")?;
        if let Some(preset) = &self.preset {
            object.insert("preset".to_owned(), json!(preset));
        }
        for (name, value) in [("webhook", &self.webhook), ("result_uri", &self.result_uri)] {
            if let Some(value) = value {
                object.insert(name.to_owned(), json!(value));
            }
        }
        for label in &self.label {
            let (name, value) = label.split_once('=').context("--label is NAME=VALUE")?;
            let labels = object.entry("labels").or_insert_with(|| json!({}));
            let labels = labels
                .as_object_mut()
                .context("labels are one JSON object")?;
            labels.insert(name.to_owned(), json!(value));
        }
        Ok(options)
    }

    async fn answer(&self, client: &Client, options: &Value) -> Result<(), Failure> {
        let form = form(&self.sweeps, options)
            .await
            .map_err(Failure::bad_input)?;
        let request = client
            .request(Method::POST, "/v1/jobs")
            .map_err(Failure::internal)?;
        let request = match &self.idempotency_key {
            None => request,
            Some(key) => request.header("idempotency-key", key),
        };
        let job = client.send(request.multipart(form)).await;
        let job: Value = job
            .map_err(Failure::internal)?
            .json()
            .await
            .map_err(Failure::internal)?;
        let id = job["id"].as_str().unwrap_or_default();
        let Some(output) = &self.output else {
            return say(format_args!("{id}"));
        };
        let terminal = Terminal::new();
        let ended = until_ended(client, &job, &terminal).await;
        terminal.finish();
        let ended = ended.map_err(Failure::internal)?;
        if ended["state"] != "succeeded" {
            let why = ended["error"]["message"]
                .as_str()
                .unwrap_or("without a word");
            let state = ended["state"].as_str().unwrap_or_default();
            return Err(Failure::internal(anyhow!(
                "job {id} ended as {state}: {why}"
            )));
        }
        let fetched = fetch(client, &job, output)
            .await
            .map_err(Failure::internal)?;
        say(format_args!(
            "job {id}: wrote {} ({fetched} bytes)",
            output.display()
        ))
    }
}

/// The body of the submission. Files are read while they are sent.
async fn form(sweeps: &[PathBuf], options: &Value) -> anyhow::Result<Form> {
    let mut form = Form::new().text("options", options.to_string());
    for (index, path) in sweeps.iter().enumerate() {
        let name = match (sweeps.len(), index) {
            (1, _) | (2, 0) => "source",
            (2, _) => "target",
            _ => "sweep",
        };
        let part = Part::file(path).await;
        let part = part.with_context(|| format!("cannot read {}", path.display()))?;
        form = form.part(name, part);
    }
    Ok(form)
}

/// Follows a job to its end. Returns its last state.
pub(super) async fn until_ended(
    client: &Client,
    job: &Value,
    terminal: &Terminal,
) -> anyhow::Result<Value> {
    let link = |name: &str| job["links"][name].as_str().unwrap_or_default().to_owned();
    loop {
        let mut last = Value::Null;
        let followed = client
            .follow(&link("events"), |event, data| match event {
                "progress" => terminal.progress(progress(data)),
                _ => last = data.clone(),
            })
            .await;
        // A server that restarts ends its streams: the job goes on.
        if let Err(error) = followed {
            tracing::debug!(%error, "the events ended early");
        }
        if last["finished_at"].is_string() {
            return Ok(last);
        }
        let job = client
            .call(Method::GET, &format!("{}?wait=20", link("self")))
            .await?;
        if job["finished_at"].is_string() {
            return Ok(job);
        }
    }
}

fn progress(data: &Value) -> Progress {
    let count = |key: &str| data[key].as_u64().unwrap_or(0) as usize;
    Progress {
        done: count("done"),
        total: count("total"),
        loss: data["loss"].as_f64().unwrap_or(0.0),
    }
}

/// Fetches the result of a job into a file, in the format of the file's extension. Returns its bytes.
async fn fetch(client: &Client, job: &Value, output: &Path) -> anyhow::Result<u64> {
    let info = client.call(Method::GET, "/v1/info").await?;
    let extension = output
        .extension()
        .and_then(|ending| ending.to_str())
        .unwrap_or("npz");
    let formats = ["flow", "dense"].map(|kind| info["formats"][kind].as_array().cloned());
    let formats = formats.into_iter().flatten().flatten();
    let media_type = formats
        .into_iter()
        .find(|format| format["extension"] == extension)
        .and_then(|format| Some(format["media_type"].as_str()?.to_owned()));
    let link = job["links"]["result"].as_str().unwrap_or_default();
    let request = client.request(Method::GET, link)?;
    let request = match &media_type {
        Some(media_type) => request.header("accept", media_type),
        None => request,
    };
    let mut response = client.send(request).await?;
    let place = files::place_of(output).context("the folder of the output is not there")?;
    let (unfinished, mut file) = Unfinished::beside(&place)?;
    let mut bytes = 0;
    while let Some(piece) = response.chunk().await? {
        std::io::Write::write_all(&mut file, &piece)?;
        bytes += piece.len() as u64;
    }
    unfinished.rename(&place)?;
    Ok(bytes)
}
