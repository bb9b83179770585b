//! `fnsf submit`: sweeps to a server, and the flow back.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use clap::Args;
use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};

use super::client::{self, Client, ServerFlags, block_on, may_pass};
use super::failure::Failure;
use super::files::{self, Output};
use super::output::say;
use super::terminal::Terminal;
use crate::flow::{Control, Progress};

/// How long a job is followed while its server cannot be reached.
const RECONNECT: Duration = Duration::from_secs(60);
/// Time between two attempts to reach the server.
const PAUSE: Duration = Duration::from_secs(1);

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
        files::check_outputs(&self.output, &self.sweeps)?;
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

    /// The media type of the result, by the ending of the output.
    async fn media_type(
        &self,
        client: &Client,
        options: &Value,
        output: &Path,
    ) -> Result<String, Failure> {
        let info = client.call(Method::GET, "/v1/info").await;
        let mut info = info.map_err(Failure::internal)?;
        let is_dense = !options["densify"].is_null();
        let is_sequence = self.sweeps.len() > 2 || is_dense;
        let kind = match is_sequence {
            false => "flow",
            true if is_dense => "dense",
            true => "archive",
        };
        let formats = info["formats"][kind].take();
        let formats = formats.as_array().into_iter().flatten();
        let formats = formats.filter_map(|format| {
            Some((
                format["extension"].as_str()?,
                format["media_type"].as_str()?,
            ))
        });
        let archive = is_sequence.then_some(("zip", "application/zip"));
        let formats: Vec<_> = formats.chain(archive).collect();
        let ending = output.extension().unwrap_or_default().to_string_lossy();
        let asked = formats
            .iter()
            .find(|(extension, _)| extension.eq_ignore_ascii_case(&ending));
        asked
            .map(|(_, media_type)| (*media_type).to_owned())
            .ok_or_else(|| {
                let endings: Vec<_> = formats.iter().map(|(ending, _)| *ending).collect();
                let (output, endings) = (output.display(), endings.join(", ."));
                Failure::usage(anyhow!(
                    "cannot write {output}: the result of this job is a file of .{endings}"
                ))
            })
    }

    async fn answer(&self, client: &Client, options: &Value) -> Result<(), Failure> {
        let output = match &self.output {
            None => None,
            Some(output) => Some((output, self.media_type(client, options, output).await?)),
        };
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
            .map_err(client::failure)?
            .json()
            .await
            .map_err(Failure::internal)?;
        let id = job["id"].as_str().unwrap_or_default();
        let Some((output, media_type)) = output else {
            return say(format_args!("{id}"));
        };
        let terminal = Terminal::new();
        terminal.part(&format!("job {id}"));
        let ended = until_ended(client, &job, &terminal).await;
        terminal.finish();
        let ended = ended.map_err(Failure::internal)?;
        if ended["state"] != "succeeded" {
            let why = ended["error"]["message"]
                .as_str()
                .unwrap_or("without a word");
            let state = ended["state"].as_str().unwrap_or_default();
            let error = anyhow!("job {id} ended as {state}: {why}");
            return Err(match ended["error"]["code"].as_str() {
                Some("input_refused" | "no_overlap") => Failure::bad_input(error),
                _ => Failure::internal(error),
            });
        }
        let fetched = fetch(client, &job, &media_type, output)
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
            // A dense cloud is made of a sequence.
            _ if !options["densify"].is_null() => "sweep",
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
///
/// # Errors
/// If the server refuses, or cannot be reached for [`RECONNECT`].
pub(super) async fn until_ended(
    client: &Client,
    job: &Value,
    terminal: &Terminal,
) -> anyhow::Result<Value> {
    let link = |name: &str| job["links"][name].as_str().unwrap_or_default().to_owned();
    let mut lost: Option<Instant> = None;
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
        let path = format!("{}?wait=20", link("self"));
        match client.call(Method::GET, &path).await {
            Ok(job) if job["finished_at"].is_string() => return Ok(job),
            Ok(_) => lost = None,
            Err(error)
                if may_pass(&error)
                    && lost.get_or_insert_with(Instant::now).elapsed() < RECONNECT =>
            {
                tokio::time::sleep(PAUSE).await;
            }
            Err(error) => {
                let id = job["id"].as_str().unwrap_or_default();
                return Err(error.context(format!("job {id} is no longer followed")));
            }
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

/// Fetches the result of a job into a file. Returns its bytes.
async fn fetch(
    client: &Client,
    job: &Value,
    media_type: &str,
    output: &Path,
) -> anyhow::Result<u64> {
    let link = job["links"]["result"].as_str().unwrap_or_default();
    let request = client.request(Method::GET, link)?;
    let mut response = client.send(request.header("accept", media_type)).await?;
    let mut written = Output::create(output)?;
    let mut bytes = 0;
    while let Some(piece) = response.chunk().await? {
        written.file.write_all(&piece)?;
        bytes += piece.len() as u64;
    }
    written.complete()?;
    Ok(bytes)
}
