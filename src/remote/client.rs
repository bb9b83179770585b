//! The HTTP client for URLs that callers name.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::redirect::Policy;
use url::{Host, Url};

use super::address::is_public;

/// Time to make a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Time without a byte of an answer.
const READ_TIMEOUT: Duration = Duration::from_secs(30);

/// Resolves names to public addresses.
struct PublicNames;

impl Resolve for PublicNames {
    fn resolve(&self, name: Name) -> Resolving {
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let public: Vec<SocketAddr> = found.filter(|at| is_public(at.ip())).collect();
            if public.is_empty() {
                let text = format!("{} has no public address", name.as_str());
                return Err(text.into());
            }
            Ok(Box::new(public.into_iter()) as Addrs)
        })
    }
}

/// A client that follows no redirects, uses no proxy, and gives up a connection after 10 s and a
/// silent answer after 30 s. Unless `allows_private` is set, it connects to public addresses alone:
/// names are checked after their resolution, so a name cannot change between check and connection.
/// [`literal_is_reachable`] checks addresses in the URL itself, which are not resolved.
///
/// # Panics
/// If no TLS provider was installed for the process.
pub(super) fn client(allows_private: bool) -> reqwest::Client {
    let builder = reqwest::Client::builder()
        .redirect(Policy::none())
        .no_proxy()
        .user_agent(concat!("fnsf/", env!("CARGO_PKG_VERSION")))
        .connect_timeout(CONNECT_TIMEOUT)
        .read_timeout(READ_TIMEOUT);
    let builder = match allows_private {
        true => builder,
        false => builder.dns_resolver(Arc::new(PublicNames)),
    };
    builder.build().expect("the options are constant")
}

/// Whether the host of a URL is a name, or an address that may be connected to.
pub(super) fn literal_is_reachable(url: &Url, allows_private: bool) -> bool {
    match url.host() {
        _ if allows_private => true,
        Some(Host::Ipv4(address)) => is_public(address.into()),
        Some(Host::Ipv6(address)) => is_public(address.into()),
        Some(Host::Domain(_)) | None => true,
    }
}

/// An error with its causes. The URL may hold a secret of its owner, so it is left out.
pub(super) fn chain(error: &dyn std::error::Error) -> String {
    let mut texts = Vec::new();
    let mut next = error.source().or(Some(error));
    while let Some(error) = next {
        texts.push(error.to_string());
        next = error.source();
    }
    texts.join(": ")
}
