//! Origin checks for servers without API keys: a page of another site could otherwise make a
//! browser on the same machine call the server.
//!
//! A page can post a form to any address. With DNS rebinding, a host name that is made to resolve
//! to 127.0.0.1 gives a foreign page the origin of this server. Browsers send the origin of a call
//! (`Origin`) and the host name (`Host`), and both are checked. Other clients can send any value,
//! but they gain nothing by it.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::error::ApiError;

/// The host names that a server without keys accepts in `Host`, without port and in any case. The
/// loopback names (`localhost`, names below `.localhost`, loopback addresses) are always accepted.
/// `None` accepts any name, for a server that is open to a network. In either case, the `Origin` of
/// a request, if it has one, must name the same host and port as its `Host`.
#[derive(Clone, Debug, Default)]
pub struct Hosts(pub Option<Vec<String>>);

/// Refuses a request without exactly one host (RFC 9112, 3.2). HTTP/2 requests may have no `Host`
/// header.
///
/// # Errors
/// [`ApiError::BadRequest`].
pub(super) fn check_host_is_one(request: &Request) -> Result<(), ApiError> {
    let hosts = request.headers().get_all(header::HOST).iter().count();
    let is_needed = request.version() == Version::HTTP_11;
    if hosts > 1 || (is_needed && hosts == 0) {
        let text = "a request names one host: send one Host header";
        return Err(ApiError::BadRequest(text.to_owned()));
    }
    Ok(())
}

/// Refuses a call that a page of another site has made.
///
/// # Errors
/// [`ApiError::ForeignSite`].
pub(super) fn check(hosts: &Hosts, request: &Request) -> Result<(), ApiError> {
    let host = match request.uri().authority() {
        Some(authority) => Some(authority.clone()),
        None => header_host(request.headers()),
    };
    if let Some(known) = &hosts.0
        && host.as_ref().is_some_and(|host| !is_known(host, known))
    {
        return Err(ApiError::ForeignSite);
    }
    let Some(origin) = request.headers().get(header::ORIGIN) else {
        return Ok(());
    };
    let of_origin = origin.to_str().ok().and_then(|origin| {
        let (_, authority) = origin.split_once("://")?;
        authority.parse::<Authority>().ok()
    });
    if of_origin.is_some() && of_origin == host {
        Ok(())
    } else {
        Err(ApiError::ForeignSite)
    }
}

/// Refuses calls that a page of another site has made: a layer of routes.
pub(super) async fn own_pages(
    State(hosts): State<Arc<Hosts>>,
    request: Request,
    next: Next,
) -> Response {
    match check(&hosts, &request) {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

/// The host in the `Host` header. An invalid value yields a name that is not accepted.
fn header_host(headers: &HeaderMap) -> Option<Authority> {
    let value = headers.get(header::HOST)?;
    let parsed = value.to_str().ok().and_then(|text| text.parse().ok());
    Some(parsed.unwrap_or_else(|| Authority::from_static("unreadable")))
}

fn is_known(host: &Authority, known: &[String]) -> bool {
    let name = host.host().trim_end_matches('.');
    let address = name.trim_start_matches('[').trim_end_matches(']');
    let is_loopback = address
        .parse::<std::net::IpAddr>()
        .is_ok_and(|address| address.is_loopback());
    is_loopback
        || name.eq_ignore_ascii_case("localhost")
        || name.to_ascii_lowercase().ends_with(".localhost")
        || known.iter().any(|known| known.eq_ignore_ascii_case(name))
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    fn refused(hosts: &Hosts, host: &str, origin: Option<&str>) -> bool {
        let mut request = Request::get("/v1/jobs").header("host", host);
        if let Some(origin) = origin {
            request = request.header("origin", origin);
        }
        let request = request.body(Body::empty()).expect("a request");
        check(hosts, &request).is_err()
    }

    #[test]
    fn pages_of_other_sites_are_refused_and_everybody_else_is_not() {
        let own = Hosts(Some(vec!["flow.example".to_owned()]));
        for (host, origin, is_refused) in [
            ("localhost:8080", None, false),
            ("127.0.0.1:8080", None, false),
            ("[::1]:8080", None, false),
            ("LOCALHOST.", None, false),
            ("flow.example", None, false),
            ("rebound.example:8080", None, true),
            ("127.0.0.1.example", None, true),
            ("not a host", None, true),
            ("localhost:8080", Some("http://localhost:8080"), false),
            ("localhost:8080", Some("http://localhost:3000"), true),
            ("localhost:8080", Some("https://site.example"), true),
            ("localhost:8080", Some("null"), true),
        ] {
            assert_eq!(refused(&own, host, origin), is_refused, "{host} {origin:?}");
        }
        let any = Hosts(None);
        assert!(!refused(&any, "rebound.example", None));
        assert!(refused(&any, "a.example", Some("http://b.example")));
    }
}
