//! Clouds for the tests, and request bodies with them.

use std::sync::OnceLock;

use fnsf::flow::Point;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::formats::{CloudFormat, write_cloud};
use reqwest::RequestBuilder;
use reqwest::multipart::{Form, Part};
use serde_json::Value;

/// A simulated pair of about five thousand points.
pub(crate) fn small_pair() -> &'static [Vec<Point>; 2] {
    static PAIR: OnceLock<[Vec<Point>; 2]> = OnceLock::new();
    PAIR.get_or_init(|| street(16, 400))
}

/// A simulated pair of about thirty thousand points. The published method takes seconds for it.
pub(crate) fn medium_pair() -> &'static [Vec<Point>; 2] {
    static PAIR: OnceLock<[Vec<Point>; 2]> = OnceLock::new();
    PAIR.get_or_init(|| street(32, 1000))
}

fn street(beams: usize, azimuth_steps: usize) -> [Vec<Point>; 2] {
    let options = StreetOptions {
        beams,
        azimuth_steps,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).and_then(|street| street.pair(0));
    let pair = pair.expect("a street");
    [pair.source, pair.target]
}

/// A cloud encoded as a file.
pub(crate) fn file(format: CloudFormat, points: &[Point]) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_cloud(format, points, &mut bytes).expect("written");
    bytes
}

/// Options of a job that does not end by itself.
pub(crate) const ENDLESS: &str =
    r#"{"preset": "paper", "field": {"max_iterations": 1000000, "patience": 1000000}}"#;

/// Sends a submission. Returns the JSON of the accepted job.
pub(crate) async fn accepted(submission: RequestBuilder) -> Value {
    let answer = submission.send().await.expect("an answer");
    answer.json().await.expect("a job")
}

/// A multipart body with source, target and options.
pub(crate) fn form([source, target]: &[Vec<Point>; 2], options: &str) -> Form {
    let part =
        |points: &[Point]| Part::bytes(file(CloudFormat::Npy, points)).file_name("cloud.npy");
    Form::new()
        .part("source", part(source))
        .part("target", part(target))
        .text("options", options.to_owned())
}
