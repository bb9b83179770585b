//! The delivery of a result to a place of the submitter.

use serde::Serialize;
use utoipa::ToSchema;

/// Stands, in the URI of a sequence, for the index of a pair: six digits.
pub const PAIR_INDEX: &str = "{index}";

/// Where the result of a job is delivered to, and how far the delivery is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Delivery {
    /// The URI of the object that is written.
    pub uri: String,
    /// How far it is.
    pub state: DeliveryState,
}

/// How far a delivery is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeliveryState {
    /// The job has not succeeded yet, or its result is being delivered.
    Pending,
    /// The result is there.
    Delivered,
    /// The result could not be delivered, and it is not tried again.
    GivenUp,
}

impl DeliveryState {
    /// All states.
    pub const ALL: [Self; 3] = [Self::Pending, Self::Delivered, Self::GivenUp];
}

/// The URI of one pair of a sequence, from the sequence's. `None` if the latter names no pair.
pub fn uri_of_pair(uri: &str, index: u32) -> Option<String> {
    let names_pairs = uri.contains(PAIR_INDEX);
    names_pairs.then(|| uri.replace(PAIR_INDEX, &format!("{index:06}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_uri_with_an_index_names_pairs() {
        let of = |uri| uri_of_pair(uri, 17);
        assert_eq!(
            of("s3://a/{index}.npz").as_deref(),
            Some("s3://a/000017.npz")
        );
        assert_eq!(of("s3://a/b.npz"), None);
    }
}
