//! Tests of input that makes no sense: sweeps of two scenes, coordinates that are not metres, and
//! sweeps that are out of order.

use fnsf::flow::Point;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::formats::CloudFormat;
use reqwest::multipart::{Form, Part};
use reqwest::{Response, StatusCode};
use serde_json::Value;

use crate::clouds::{file, form, small_pair};
use crate::server::Server;

/// A sweep of another street than that of [`small_pair`].
fn elsewhere() -> Vec<Point> {
    let options = StreetOptions {
        seed: 5,
        beams: 16,
        azimuth_steps: 400,
        ..StreetOptions::default()
    };
    let street = Street::new(&options).expect("a street");
    street.sweep(0).expect("a sweep").points
}

async fn posted(server: &Server, pair: &[Vec<Point>; 2], options: &str) -> Response {
    let request = reqwest::Client::new().post(server.url("/v1/flow"));
    let request = request.multipart(form(pair, options));
    request.send().await.expect("an answer")
}

fn overlap(response: &Response) -> f32 {
    let text = response.headers()["fnsf-overlap"].to_str().expect("text");
    text.parse().expect("a number")
}

#[tokio::test]
async fn sweeps_of_two_scenes_are_refused_by_their_own_code_and_forced_ones_are_not() {
    let server = Server::start(&[]);
    let pair = [small_pair()[0].clone(), elsewhere()];
    let refused = posted(&server, &pair, "{}").await;
    assert_eq!(refused.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem: Value = refused.json().await.expect("a problem");
    assert_eq!(problem["job_error"]["code"], "no_overlap", "{problem}");
    assert_eq!(problem["job_error"]["retryable"], false, "{problem}");
    assert_eq!(server.metric("fnsf_overlap_ratio_count"), 1.0);

    let forced = posted(&server, &pair, r#"{"force":true}"#).await;
    assert_eq!(forced.status(), StatusCode::OK);
    assert!(overlap(&forced) < 0.35);
    let good = posted(&server, small_pair(), "{}").await;
    assert!(overlap(&good) > 0.6);
}

#[tokio::test]
async fn a_fit_that_diverges_is_tried_once() {
    let server = Server::start(&[]);
    let options = r#"{"preset":"nsfp-baseline","max_points":512,"field":{"learning_rate":1e30,"max_iterations":20}}"#;
    let refused = posted(&server, small_pair(), options).await;
    assert_eq!(refused.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem: Value = refused.json().await.expect("a problem");
    assert_eq!(problem["job_error"]["code"], "diverged", "{problem}");
    assert_eq!(problem["job_error"]["retryable"], false, "{problem}");
}

#[tokio::test]
async fn coordinates_in_millimetres_are_refused_before_they_are_queued() {
    let server = Server::start(&[]);
    let scaled = |points: &Vec<Point>| points.iter().map(|p| p.map(|c| c * 1000.0)).collect();
    let pair = small_pair().each_ref().map(scaled);
    let refused = posted(&server, &pair, "{}").await;
    assert_eq!(refused.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem: Value = refused.json().await.expect("a problem");
    assert!(problem.to_string().contains("millimetres"), "{problem}");
    assert_eq!(server.metric("fnsf_jobs_submitted_total"), 0.0);
}

#[tokio::test]
async fn sweeps_whose_numbers_turn_back_are_refused_in_words_and_forced_ones_are_not() {
    let server = Server::start(&[]);
    let submit = async |options: &str| {
        let form = Form::new().text("options", options.to_owned());
        let sweep = |form: Form, number: u32| {
            let bytes = file(CloudFormat::Npy, &small_pair()[0]);
            form.part(
                "sweep",
                Part::bytes(bytes).file_name(format!("drive_{number}.npy")),
            )
        };
        let form = [1, 10, 2].into_iter().fold(form, sweep);
        let request = reqwest::Client::new().post(server.url("/v1/sequences"));
        request.multipart(form).send().await.expect("an answer")
    };
    let refused = submit("{}").await;
    assert_eq!(refused.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem = refused.text().await.expect("a problem");
    assert!(
        problem.contains("drive_10.npy") && problem.contains("force"),
        "{problem}"
    );
    assert_eq!(
        submit(r#"{"force":true}"#).await.status(),
        StatusCode::ACCEPTED
    );
}
