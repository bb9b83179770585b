//! `fnsf demo`: one simulated pair, estimated by a local service over a real socket.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use reqwest::Method;
use reqwest::multipart::{Form, Part};
use tokio::signal::unix::{SignalKind, signal};

use super::client::Client;
use super::eval::print_score;
use super::failure::Failure;
use super::files;
use super::flow::print_report;
use super::output::{say, without_reader};
use super::submit::until_ended;
use super::synth::labelled;
use super::terminal::Terminal;
use crate::app::App;
use crate::config::Config;
use crate::flow::simulate::{Street, StreetOptions};
use crate::formats::{FlowFile, Pair, read_flow, rigid_motion, write_pair_npz};
use crate::job::{JobOptions, Report};
use crate::picture;
use crate::picture::{TopDown, TopDownOptions};
use crate::text::grouped;

/// Run one simulated pair through the service, print the flow's error and draw the flow.
///
/// The service runs inside this command, on a free port of 127.0.0.1. Its data is in a temporary
/// folder, which is removed at the end.
#[derive(Debug, Args)]
pub(super) struct Demo {
    /// Folder for flow.npz and flow.png; created if missing
    #[arg(short, long, value_name = "DIR", default_value = "demo")]
    output: PathBuf,
    /// Seed of the simulated street and of the estimate; the same seed gives the same street
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
}

/// A flow returned by the service, with the job's report.
struct Answer {
    bytes: Vec<u8>,
    flow: FlowFile,
    report: Report,
}

impl Demo {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let street = Street::new(&StreetOptions {
            seed: self.seed,
            ..StreetOptions::default()
        });
        let street = street.and_then(|street| street.pair(0));
        let mut pair = labelled(street.map_err(Failure::internal)?);
        say(format_args!(
            "a simulated street: {} points, then {}, 0.1 s apart",
            grouped(pair.source.len()),
            grouped(pair.target.len())
        ))?;
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("cannot make {}", self.output.display()))
            .map_err(Failure::internal)?;
        let truth = pair.truth.take().unwrap_or_default();

        let answer = self.through_the_service(&pair)?;
        without_reader(print_report(&answer.report))?;
        let flow = self.output.join("flow.npz");
        let picture = self.output.join("flow.png");
        files::write(&flow, |file| std::io::Write::write_all(file, &answer.bytes))?;
        draw(&pair, &answer, &picture)?;
        say(format_args!(
            "  wrote {} and {}",
            flow.display(),
            picture.display()
        ))?;
        say(format_args!(
            "against the simulator's truth, ground left out:"
        ))?;
        without_reader(print_score(&answer.flow, &truth, &pair))
    }

    fn through_the_service(&self, pair: &Pair) -> Result<Answer, Failure> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .map_err(Failure::internal)?;
        // The folder is removed when this function returns.
        let folder = tempfile::tempdir().map_err(Failure::internal)?;
        let answered = runtime.block_on(async {
            let mut terminate = signal(SignalKind::terminate())?;
            let mut hangup = signal(SignalKind::hangup())?;
            tokio::select! {
                answered = self.ask(pair, folder.path().to_owned()) => answered,
                _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("interrupted")),
                _ = terminate.recv() => Err(anyhow::anyhow!("terminated")),
                _ = hangup.recv() => Err(anyhow::anyhow!("hung up")),
            }
        });
        runtime.shutdown_timeout(std::time::Duration::from_secs(1));
        answered.map_err(Failure::internal)
    }

    /// Starts a server, submits the pair, follows the job's events, fetches the flow and stops the
    /// server.
    async fn ask(&self, pair: &Pair, data_dir: PathBuf) -> anyhow::Result<Answer> {
        let any_port = std::net::SocketAddr::from(([127, 0, 0, 1], 0));
        let app = App::start(Config {
            listen: any_port,
            admin_listen: any_port,
            data_dir,
            ..Config::default()
        })
        .await?;
        app.ready().await?;
        let address = app.public_address().context("it has no public port")?;
        say(format_args!(
            "the service runs at http://{address}; POST /v1/jobs"
        ))
        .map_err(|failure| anyhow::anyhow!("{failure}"))?;
        let mut file = Vec::new();
        // The points alone are sent, without truth, ground masks or ego motion.
        let sent = Pair {
            source: pair.source.clone(),
            target: pair.target.clone(),
            ..Pair::default()
        };
        write_pair_npz(&sent, &mut file)?;
        let options = JobOptions {
            seed: self.seed,
            ..JobOptions::default()
        };
        let client = Client::new(format!("http://{address}").parse()?, None)?;
        let form = Form::new()
            .text("options", options.to_json())
            .part("source", Part::bytes(file).file_name("pair.npz"));
        let job = client.post("/v1/jobs", form).await?;
        let terminal = Terminal::new();
        let mut last = until_ended(&client, &job, &terminal).await?;
        terminal.finish();
        if last["state"] != "succeeded" {
            let why = last["error"]["message"]
                .as_str()
                .unwrap_or("without a word");
            return Err(anyhow::anyhow!("the job ended as {}: {why}", last["state"]));
        }
        let result = job["links"]["result"].as_str().unwrap_or_default();
        let result = client.send(client.request(Method::GET, result)?).await?;
        let bytes = result.bytes().await?.to_vec();
        app.drain().await;
        Ok(Answer {
            flow: read_flow(&bytes, None)?,
            report: serde_json::from_value(last["report"].take())?,
            bytes,
        })
    }
}

fn draw(pair: &Pair, answer: &Answer, path: &std::path::Path) -> Result<(), Failure> {
    let ego = answer
        .report
        .ego_motion
        .as_ref()
        .map(rigid_motion)
        .transpose();
    let ego = ego.map_err(Failure::internal)?;
    let all = vec![true; pair.source.len()];
    let image = picture::top_down(
        &TopDown {
            source: &pair.source,
            flow: &answer.flow.flow,
            valid: answer.flow.valid.as_deref().unwrap_or(&all),
            ego: ego.as_ref(),
            clusters: answer.flow.clusters.as_deref().unwrap_or_default(),
        },
        &TopDownOptions::default(),
    );
    files::write(path, |file| picture::write_png(&image, file))
}
