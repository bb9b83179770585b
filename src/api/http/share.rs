//! The route `/v1/jobs/{id}/share`: links to one job that expire.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Extension, Query, State};
use axum::http::{HeaderMap, header};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::named::Named;
use super::problem::Problem;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::service::Service;
use crate::clock::Timestamp;

/// Seconds until a link expires, if the request does not say.
const DEFAULT_SECONDS: u64 = 7 * 24 * 3600;
/// Maximum number of seconds until a link expires.
const MAX_SECONDS: u64 = 90 * 24 * 3600;

/// The query parameters of a share link.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Terms {
    /// Seconds until the link expires, 1 to 7,776,000 (90 days).
    seconds: Option<u64>,
}

/// A link to a job, for readers without a key.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ShareLink {
    /// The path of the job in the console. It contains the token after `#`, which browsers do not
    /// send to the server or to other sites.
    path: String,
    /// The token, which can be sent like a key. It permits to read this job. Null on a server
    /// without keys, where readers need none.
    token: Option<String>,
    /// When the link expires. Null on a server without keys, where it does not.
    expires_at: Option<String>,
}

/// Creates a link with which others can read the job, its sweeps and its results without a key.
///
/// The link expires. It cannot be used to list, submit, cancel or remove jobs. Without the key of
/// the caller who made it in the configuration, a link is void.
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/share",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "The job's name"),
        ("seconds" = Option<u64>, Query, description = "Seconds until it expires, 1 to 7776000; 7 days by default"),
    ),
    responses(
        (status = 200, description = "The link", body = ShareLink),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn share(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
    headers: HeaderMap,
    terms: Result<Query<Terms>, axum::extract::rejection::QueryRejection>,
) -> Result<Json<ShareLink>, ApiError> {
    let Query(terms) = terms.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    let seconds = terms.seconds.unwrap_or(DEFAULT_SECONDS);
    if !(1..=MAX_SECONDS).contains(&seconds) {
        let text = format!("seconds is {seconds}, 1 to {MAX_SECONDS} are possible");
        return Err(ApiError::BadRequest(text));
    }
    caller.has_key()?;
    let job = service.job(&caller, id).await?;
    let expires = Timestamp::now().after(Duration::from_secs(seconds));
    let shown = headers.get(header::AUTHORIZATION);
    let shown = shown.and_then(|value| value.to_str().ok());
    let token = service.keys.get().share(shown, job.id, expires);
    let path = format!("/#/jobs/{}", job.id);
    Ok(Json(ShareLink {
        path: match &token {
            Some(token) => format!("{path}?token={token}"),
            None => path,
        },
        expires_at: token.as_ref().map(|_| expires.to_string()),
        token,
    }))
}
