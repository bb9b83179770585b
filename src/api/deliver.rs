//! Delivery of results to the places that their submitters have named.
//!
//! Independent of HTTP and gRPC types.

use std::sync::Arc;

use super::codec::{ANSWER_FORMATS, AnswerFormat};
use super::dense::is_dense;
use super::error::ApiError;
use super::service::Service;
use crate::formats::{DENSE_FORMATS, DenseFormat};
use crate::job::{Job, JobOptions, Kind, PAIR_INDEX, uri_of_pair};
use crate::remote::{Deliveries, NotDelivered};

/// Why a result was not delivered.
#[derive(Debug, thiserror::Error)]
pub enum DeliveryError {
    /// The result cannot be read or encoded.
    #[error("{0}")]
    Result(#[from] ApiError),
    /// The place cannot be written.
    #[error(transparent)]
    Place(#[from] NotDelivered),
}

impl DeliveryError {
    /// Whether a later attempt may succeed. A place that was allowed when the job came may be unknown to
    /// another node, or to this one until its settings are those of the others.
    pub fn is_worth_a_retry(&self) -> bool {
        match self {
            Self::Result(error) => error.row().retryable,
            Self::Place(
                NotDelivered::Failed(_) | NotDelivered::NotAllowed(_) | NotDelivered::Off,
            ) => true,
        }
    }
}

/// The format of a delivered file, by the ending of its URI.
#[derive(Clone, Copy, Debug, PartialEq)]
enum DeliveredFormat {
    Flow(AnswerFormat),
    Cloud(DenseFormat),
}

impl DeliveredFormat {
    /// # Errors
    /// [`ApiError::InvalidOptions`] if the ending is none of those of the result.
    fn of(uri: &str, is_dense: bool) -> Result<Self, ApiError> {
        let name = uri.rsplit('/').next().unwrap_or_default();
        let ending = name.rsplit_once('.').map_or("", |(_, ending)| ending);
        let found = match is_dense {
            false => find(&ANSWER_FORMATS, ending).map(Self::Flow),
            true => find(&DENSE_FORMATS, ending).map(Self::Cloud),
        };
        found.ok_or_else(|| {
            let known: Vec<&str> = match is_dense {
                false => ANSWER_FORMATS.iter().map(|(.., ending)| *ending).collect(),
                true => DENSE_FORMATS.iter().map(|(.., ending)| *ending).collect(),
            };
            let what = if is_dense { "a dense cloud" } else { "a flow" };
            refused(&format!(
                "the ending of {what} is one of {}",
                known.join(", ")
            ))
        })
    }
}

fn find<F: Copy>(formats: &[(F, &str, &str)], wanted: &str) -> Option<F> {
    let found = formats.iter().find(|(.., ending)| *ending == wanted);
    found.map(|(format, ..)| *format)
}

fn refused(why: &str) -> ApiError {
    ApiError::InvalidOptions(format!("options: result_uri: {why}"))
}

/// Checks that the server may write to a URI that a caller names.
///
/// # Errors
/// [`ApiError::InvalidOptions`].
pub(super) fn check_place(deliveries: &Deliveries, uri: &str) -> Result<(), ApiError> {
    let uri = uri_of_pair(uri, 0).unwrap_or_else(|| uri.to_owned());
    let checked = deliveries.check(&uri);
    checked.map_err(|error| refused(&error.to_string()))
}

/// Checks that the URI in the options fits the result of a job of this kind.
///
/// # Errors
/// [`ApiError::InvalidOptions`].
pub(super) fn check_form(options: &JobOptions, kind: Kind) -> Result<(), ApiError> {
    let Some(uri) = &options.result_uri else {
        return Ok(());
    };
    let is_dense = kind == Kind::Sequence && options.densify.is_some();
    let has_flows = kind == Kind::Sequence && !is_dense;
    match uri_of_pair(uri, 0).is_some() {
        false if has_flows => Err(refused(&format!(
            "that of a sequence has {PAIR_INDEX} in the place of the index of a pair"
        ))),
        true if !has_flows => Err(refused(&format!(
            "{PAIR_INDEX} is for the flows of a sequence"
        ))),
        _ => DeliveredFormat::of(uri, is_dense).map(drop),
    }
}

impl Service {
    /// Writes the result of a job that has succeeded to the URI of its delivery.
    ///
    /// # Errors
    /// [`DeliveryError`].
    pub async fn deliver(&self, job: &Arc<Job>) -> Result<(), DeliveryError> {
        let Some(delivery) = &job.delivery else {
            return Ok(());
        };
        let encoded = match DeliveredFormat::of(&delivery.uri, is_dense(job))? {
            DeliveredFormat::Flow(format) => self.encoded(job, format).await?,
            DeliveredFormat::Cloud(format) => self.encode_dense(job, format).await?,
        };
        let deliveries = &self.remotes.deliveries;
        Ok(deliveries
            .put(&delivery.uri, encoded.bytes().clone())
            .await?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uri_fits_the_result_or_is_refused_with_what_would_fit() {
        let options = |uri: &str, densify: bool| {
            let densify = if densify {
                r#", "densify": {"reference_time": 0}"#
            } else {
                ""
            };
            let json = format!(r#"{{"result_uri": "{uri}"{densify}}}"#);
            JobOptions::from_json(json.as_bytes()).expect("good options")
        };
        for (uri, kind, densify, said) in [
            ("s3://a/b.npz", Kind::Pair, false, ""),
            ("s3://a/b.f32", Kind::Pair, false, ""),
            (
                "s3://a/b.laz",
                Kind::Pair,
                false,
                "one of npz, npy, feather",
            ),
            (
                "s3://a.npz/b",
                Kind::Pair,
                false,
                "one of npz, npy, feather",
            ),
            ("s3://a/{index}.npz", Kind::Pair, false, "is for the flows"),
            ("s3://a/{index}.npz", Kind::Sequence, false, ""),
            ("s3://a/{index}/f.ply", Kind::Sequence, false, ""),
            ("s3://a/b.npz", Kind::Sequence, false, "has {index}"),
            ("s3://a/b.laz", Kind::Sequence, true, ""),
            (
                "s3://a/b.feather",
                Kind::Sequence,
                true,
                "one of npz, ply, pcd, laz, las",
            ),
            (
                "s3://a/{index}.laz",
                Kind::Sequence,
                true,
                "is for the flows",
            ),
        ] {
            let checked = check_form(&options(uri, densify), kind);
            match checked {
                Ok(()) => assert_eq!(said, "", "{uri}"),
                Err(error) => {
                    assert!(
                        !said.is_empty() && error.to_string().contains(said),
                        "{uri}: {error}"
                    );
                }
            }
        }
    }
}
