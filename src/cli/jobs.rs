//! `fnsf jobs`: the jobs of a server, from the command line.

use clap::{Args, Subcommand};
use reqwest::Method;
use serde_json::Value;
use url::form_urlencoded::Serializer;

use super::client::{self, Client, ServerFlags, block_on};
use super::failure::Failure;
use super::output::{say, show};

/// Number of jobs on a page of a list.
const PAGE: usize = 500;

/// List, show, cancel, requeue and remove the jobs of a server.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf jobs list --state failed\n  \
    fnsf jobs requeue --dead-letters --label drive=7    # all of them\n  \
    fnsf jobs show 0198c2d1-5ad7-7c3a-9c55-0f2f3a1b4c5d\n  \
    FNSF_API_KEY=... fnsf jobs list --server https://fnsf.example.com")]
pub(super) struct Jobs {
    #[command(flatten)]
    server: ServerFlags,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List jobs, latest first
    List {
        #[command(flatten)]
        filter: Filter,
        /// Maximum number of jobs
        #[arg(long, value_name = "N", default_value_t = 100)]
        limit: usize,
        /// Print one JSON object a line
        #[arg(long)]
        json: bool,
    },
    /// Print a job as JSON
    Show {
        /// The job's id
        id: String,
    },
    /// Cancel jobs that have not ended
    Cancel(Selection),
    /// Queue jobs again that failed, expired or were cancelled
    Requeue(Selection),
    /// Remove ended jobs and their results
    Remove(Selection),
}

/// Which jobs of a list.
#[derive(Debug, Args)]
struct Filter {
    /// Only jobs in this state: queued, running, succeeded, failed, cancelled or expired
    #[arg(long, value_name = "STATE")]
    state: Option<String>,
    /// Only jobs with this label
    #[arg(long, value_name = "NAME=VALUE")]
    label: Option<String>,
    /// Only jobs that were given up after too many attempts
    #[arg(long)]
    dead_letters: bool,
}

/// Jobs by id, or all that a filter finds.
#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("which").required(true).multiple(true).args(["ids", "state", "label", "dead_letters"]))]
struct Selection {
    /// Ids of jobs
    #[arg(value_name = "ID", conflicts_with_all = ["state", "label", "dead_letters"])]
    ids: Vec<String>,
    #[command(flatten)]
    filter: Filter,
}

impl Jobs {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let client = self.server.client()?;
        block_on(self.answer(&client))
    }

    async fn answer(&self, client: &Client) -> Result<(), Failure> {
        match &self.command {
            Command::List {
                filter,
                limit,
                json,
            } => list(client, filter, *limit, *json).await,
            Command::Show { id } => {
                let job = client.call(Method::GET, &path(id, "")).await;
                let job = job.map_err(client::failure)?;
                show(format_args!("{job:#}"))
            }
            Command::Cancel(of) => each(client, of, &CANCEL).await,
            Command::Requeue(of) => each(client, of, &REQUEUE).await,
            Command::Remove(of) => each(client, of, &REMOVE).await,
        }
    }
}

/// A change of jobs: its request, and the word for a job that was changed.
struct Change {
    method: Method,
    /// What follows the path of the job.
    rest: &'static str,
    done: &'static str,
    /// Whether the request leaves a job as it is, by its JSON.
    leaves: fn(&Value) -> bool,
}

const CANCEL: Change = Change {
    method: Method::DELETE,
    rest: "",
    done: "cancelled",
    leaves: |job| job["finished_at"].is_string() && job["state"] != "cancelled",
};
const REQUEUE: Change = Change {
    method: Method::POST,
    rest: "/requeue",
    done: "requeued",
    leaves: |_| false,
};
const REMOVE: Change = Change {
    method: Method::DELETE,
    rest: "?remove=true",
    done: "removed",
    leaves: |_| false,
};

/// The path of a job, with what follows it.
fn path(id: &str, rest: &str) -> String {
    let id: String = url::form_urlencoded::byte_serialize(id.as_bytes()).collect();
    format!("/v1/jobs/{id}{rest}")
}

/// Up to `limit` jobs that the filter finds, latest first.
async fn find(client: &Client, filter: &Filter, limit: usize) -> Result<Vec<Value>, Failure> {
    let mut found = Vec::new();
    let mut before: Option<String> = None;
    loop {
        let mut query = Serializer::new(String::new());
        // Of failed jobs, only some are dead letters.
        let wanted = match filter.dead_letters {
            true => PAGE,
            false => PAGE.min(limit - found.len()),
        };
        query.append_pair("limit", &wanted.to_string());
        let failed = filter.dead_letters.then_some("failed");
        let pairs = [
            ("state", filter.state.as_deref().or(failed)),
            ("label", filter.label.as_deref()),
            ("before", before.as_deref()),
        ];
        for (name, value) in pairs {
            if let Some(value) = value {
                query.append_pair(name, value);
            }
        }
        let path = format!("/v1/jobs?{}", query.finish());
        let page = client.call(Method::GET, &path).await;
        let mut page = page.map_err(client::failure)?;
        let Value::Array(jobs) = page["jobs"].take() else {
            return Err(Failure::internal(anyhow::anyhow!(
                "the answer is no page of jobs"
            )));
        };
        let is_wanted = |job: &Value| !filter.dead_letters || job["dead_letter"] == true;
        found.extend(jobs.into_iter().filter(is_wanted));
        before = page["next"].as_str().map(str::to_owned);
        if found.len() >= limit || before.is_none() {
            found.truncate(limit);
            return Ok(found);
        }
    }
}

async fn list(client: &Client, filter: &Filter, limit: usize, json: bool) -> Result<(), Failure> {
    for job in find(client, filter, limit).await? {
        if json {
            show(format_args!("{job}"))?;
            continue;
        }
        let text = |key: &str| job[key].as_str().unwrap_or("-").to_owned();
        let labels = job["options"]["labels"].as_object();
        let labels = labels
            .into_iter()
            .flatten()
            .map(|(name, value)| format!("{name}={}", value.as_str().unwrap_or_default()));
        let error = job["error"]["code"].as_str().unwrap_or_default();
        let dead = if job["dead_letter"] == true {
            "(dead letter)"
        } else {
            ""
        };
        let rest = [error.to_owned(), dead.to_owned()]
            .into_iter()
            .chain(labels);
        let rest: Vec<String> = rest.filter(|text| !text.is_empty()).collect();
        show(format_args!(
            "{}  {:<9}  {:<8}  {}  {}",
            text("id"),
            text("state"),
            text("kind"),
            text("created_at"),
            rest.join(" ")
        ))?;
    }
    Ok(())
}

/// Makes the same change to each job of a selection. Goes on after a refusal, and fails in the end.
async fn each(client: &Client, of: &Selection, change: &Change) -> Result<(), Failure> {
    let done = change.done;
    let mut ids = of.ids.clone();
    if ids.is_empty() {
        let found = find(client, &of.filter, usize::MAX).await?;
        let changed = found.iter().filter(|job| !(change.leaves)(job));
        ids = changed
            .filter_map(|job| Some(job["id"].as_str()?.to_owned()))
            .collect();
    }
    let (mut refused, mut left) = (0, 0);
    for id in &ids {
        let path = path(id, change.rest);
        match client.call(change.method.clone(), &path).await {
            Ok(job) if (change.leaves)(&job) => {
                left += 1;
                let state = job["state"].as_str().unwrap_or_default();
                say(format_args!("{id} not {done}: it had {state}"))?;
            }
            Ok(_) => say(format_args!("{id} {done}"))?,
            Err(error) => {
                refused += 1;
                say(format_args!("{id} not {done}: {error:#}"))?;
            }
        }
    }
    match refused {
        0 => say(format_args!("{} jobs {done}", ids.len() - left)),
        _ => Err(Failure::internal(anyhow::anyhow!(
            "{refused} of {} jobs were not {done}",
            ids.len()
        ))),
    }
}
