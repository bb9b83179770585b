//! The console: pages for browsers, at `/`. Its scripts use the public API.

use axum::Router;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use super::assets::{ASSETS, Asset};
use super::results::is_known;

/// The page of `/`.
const PAGE: &str = "index.html";

/// What the pages may load: nothing of another host, no inline scripts and styles.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
     img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

/// The routes of the console. They need no key and no state.
pub(super) fn router<S: Clone + Send + Sync + 'static>() -> Router<S> {
    let mut router = Router::new();
    for asset in ASSETS {
        let tag = format!("\"{}\"", &blake3::hash(asset.bytes).to_hex()[..16]);
        let path = match asset.path {
            PAGE => "/".to_owned(),
            path => format!("/console/{path}"),
        };
        let serve = get(move |headers: HeaderMap| {
            let response = answer(asset, &tag, &headers);
            async move { response }
        });
        router = router.route(&path, serve);
    }
    router
}

/// The file, or 304 if the browser has it.
fn answer(asset: &'static Asset, tag: &str, headers: &HeaderMap) -> Response {
    let mut response = match is_known(headers, tag) {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => asset.bytes.into_response(),
    };
    let headers = response.headers_mut();
    let mut set = |name, value: &str| {
        if let Ok(value) = HeaderValue::from_str(value) {
            headers.insert(name, value);
        }
    };
    set(header::CONTENT_TYPE, asset.media_type());
    set(header::ETAG, tag);
    set(header::CACHE_CONTROL, "no-cache");
    set(header::CONTENT_SECURITY_POLICY, POLICY);
    set(header::REFERRER_POLICY, "no-referrer");
    response
}
