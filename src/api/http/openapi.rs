//! The OpenAPI document, generated from the handlers, and the Swagger UI.

use std::sync::Arc;

use axum::Router;
use axum::http::header;
use axum::middleware::map_response;
use axum::response::Response;
use axum::routing::get;
use bytes::Bytes;
use utoipa::openapi::header::HeaderBuilder;
use utoipa::openapi::path::Operation;
use utoipa::openapi::schema::{KnownFormat, Object, SchemaFormat, Type};
use utoipa::openapi::security::{Http, HttpAuthScheme, SecurityScheme};
use utoipa::openapi::{Content, RefOr, Schema};
use utoipa::{Modify, OpenApi};
use utoipa_swagger_ui::{Config, SwaggerUi};

use super::results::{ARCHIVE, RESULT_HEADERS};
use super::{events, handlers, info, list, queue, results, scene, share, street};
use crate::api::codec::ANSWER_FORMATS;
use crate::api::listener::HasRoom;
use crate::api::service::Service;
use crate::formats::DENSE_FORMATS;

struct Bearer;

impl Modify for Bearer {
    fn modify(&self, document: &mut utoipa::openapi::OpenApi) {
        let scheme = SecurityScheme::Http(Http::new(HttpAuthScheme::Bearer));
        let components = document.components.get_or_insert_with(Default::default);
        components.add_security_scheme("key", scheme);
    }
}

/// Adds to the responses with results the formats and headers that tables define, and a schema to all
/// bodies.
struct ResultFormats;

impl Modify for ResultFormats {
    fn modify(&self, document: &mut utoipa::openapi::OpenApi) {
        let flow = || ANSWER_FORMATS.map(|(_, media, _)| media).into_iter();
        let dense = DENSE_FORMATS.map(|(_, media, _)| media).into_iter();
        let paths = &mut document.paths.paths;
        if let Some(path) = paths.get_mut("/v1/flow") {
            describe(path.post.as_mut(), &["200"], flow());
        }
        if let Some(path) = paths.get_mut("/v1/jobs/{id}/result") {
            let all = flow().chain(dense).chain([ARCHIVE]);
            describe(path.get.as_mut(), &["200", "206"], all);
        }
        // Without one, generators of clients leave the response out.
        let operations = paths.values_mut();
        let operations = operations.flat_map(|path| [path.get.as_mut(), path.post.as_mut()]);
        for operation in operations.flatten() {
            for response in operation.responses.responses.values_mut() {
                let RefOr::T(response) = response else {
                    continue;
                };
                for (media_type, content) in &mut response.content {
                    let RefOr::T(content) = content else { continue };
                    let schema = || RefOr::from(Schema::from(body_of(media_type)));
                    content.schema.get_or_insert_with(schema);
                }
            }
        }
    }
}

/// The schema of a body that only its media type describes.
fn body_of(media_type: &str) -> Object {
    let text = Object::builder().schema_type(Type::String);
    match media_type {
        "application/json" => Object::new(),
        media_type if media_type.starts_with("text/") => text.build(),
        _ => {
            let binary = SchemaFormat::KnownFormat(KnownFormat::Binary);
            text.format(Some(binary)).build()
        }
    }
}

/// Sets the media types and the headers of the responses of an operation that have a result.
fn describe(
    operation: Option<&mut Operation>,
    statuses: &[&str],
    media_types: impl Iterator<Item = &'static str>,
) {
    let Some(operation) = operation else { return };
    let media_types: Vec<_> = media_types.collect();
    for status in statuses {
        let response = operation.responses.responses.get_mut(*status);
        let Some(RefOr::T(response)) = response else {
            continue;
        };
        for &media_type in &media_types {
            let content = Content::new(Some(body_of(media_type)));
            response
                .content
                .insert(media_type.to_owned(), content.into());
        }
        for (name, text) in RESULT_HEADERS {
            let header = HeaderBuilder::new().description(Some(text)).build();
            response.headers.insert(name.to_owned(), header.into());
        }
    }
}

/// The OpenAPI document.
#[derive(OpenApi)]
#[openapi(
    info(
        title = "fnsf",
        description = "Scene flow as a service: two lidar clouds in, the motion of every point out."
    ),
    paths(
        handlers::estimate,
        handlers::submit_sequence,
        handlers::submit_job,
        list::list_jobs,
        handlers::get_job,
        handlers::delete_job,
        handlers::requeue_job,
        events::follow_job,
        results::result,
        results::tracks,
        scene::scene,
        scene::sweep,
        share::share,
        queue::queue,
        street::street,
        info::info,
    ),
    security((), ("key" = [])),
    modifiers(&Bearer, &ResultFormats),
    tags(
        (name = "flow", description = "A pair in, its flow out, on one call"),
        (name = "jobs", description = "Work that outlives the call"),
        (name = "server", description = "What the server is and takes"),
    )
)]
struct Contract;

/// The routes `/openapi.json` and `/docs`. They need no key. All answers share the same bytes: an unread answer takes
/// no memory of its own.
pub(super) fn router() -> Router<Arc<Service>> {
    let document = Contract::openapi().to_json();
    let document = Bytes::from(document.expect("the document is our own"));
    let answer =
        get(move || async move { ([(header::CONTENT_TYPE, "application/json")], document) });
    let pages = SwaggerUi::new("/docs").config(Config::from("/openapi.json"));
    Router::from(pages)
        .route("/openapi.json", answer)
        .layer(map_response(shared))
}

async fn shared(mut response: Response) -> Response {
    response.extensions_mut().insert(HasRoom);
    response
}
