//! The URLs that callers may name: those below prefixes in the configuration.

use url::Url;

use crate::text::without_user;

/// The longest URL, bytes.
const MAX_BYTES: usize = 2048;

/// A prefix that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not a prefix such as https://data.example.com/drives/: {1}")]
pub struct InvalidPrefix(String, &'static str);

/// Why a URL is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotAllowed {
    /// It is not a URL, has more than 2,048 bytes, or has a user, a password or a fragment.
    #[error(
        "is not a plain URL with a host and at most 2048 bytes, without user, password and fragment"
    )]
    Malformed,
    /// No prefix covers it.
    #[error("is not below an address that this server allows")]
    Elsewhere,
}

/// Prefixes of URLs.
#[derive(Clone, Debug, Default)]
pub struct Allowed(Vec<Url>);

impl Allowed {
    /// Reads prefixes. Each is a URL with one of the `schemes` and ends with `/`.
    ///
    /// # Errors
    /// [`InvalidPrefix`] of the first that is something else.
    pub fn new(prefixes: &[String], schemes: &[&str]) -> Result<Self, InvalidPrefix> {
        let read = |text: &String| {
            let wrong = |why| InvalidPrefix(without_user(text), why);
            let url = plain(text).ok_or(wrong("no plain URL"))?;
            if !schemes.contains(&url.scheme()) {
                return Err(wrong("another scheme than those possible here"));
            }
            if !url.path().ends_with('/') || url.query().is_some() {
                return Err(wrong("it ends with a slash"));
            }
            Ok(url)
        };
        prefixes
            .iter()
            .map(read)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// Whether nothing is allowed.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The prefixes.
    pub(super) fn prefixes(&self) -> &[Url] {
        &self.0
    }

    /// Checks a URL: scheme, host and port are those of a prefix, and its path lies below the
    /// prefix's path.
    ///
    /// # Errors
    /// [`NotAllowed`].
    pub fn check(&self, text: &str) -> Result<Url, NotAllowed> {
        let url = plain(text).ok_or(NotAllowed::Malformed)?;
        let covers = |prefix: &Url| {
            prefix.scheme() == url.scheme()
                && prefix.host() == url.host()
                && prefix.port_or_known_default() == url.port_or_known_default()
                && url.path().starts_with(prefix.path())
        };
        match self.0.iter().any(covers) {
            true => Ok(url),
            false => Err(NotAllowed::Elsewhere),
        }
    }
}

/// A URL with a host, or of a file; without user, password and fragment, and without a path that another
/// server may read as a way upward: with a backslash, with escaped dots, slashes or percent signs, or a part
/// such as `..;`.
fn plain(text: &str) -> Option<Url> {
    let url = Url::parse(text).ok().filter(|_| text.len() <= MAX_BYTES)?;
    let path = url.path().to_ascii_lowercase();
    let is_plain = url.username().is_empty()
        && url.password().is_none()
        && url.fragment().is_none()
        && (url.has_host() || url.scheme() == "file")
        && !["\\", "%2e", "%2f", "%5c", "%00", "%25"]
            .iter()
            .any(|code| path.contains(code))
        // Some servers read what follows a semicolon as a parameter of the part before it.
        && !path.split('/').any(|part| part.starts_with(".."));
    is_plain.then_some(url)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_lies_below_a_prefix_is_allowed() {
        let prefixes = [
            "https://a.example/in/",
            "s3://drives/2026/",
            "file:///data/",
        ];
        let prefixes = prefixes.map(str::to_owned);
        let allowed = Allowed::new(&prefixes, &["https", "s3", "file"]).expect("good prefixes");
        for good in [
            "https://a.example/in/x.pcd",
            "https://A.example:443/in/deep/x.pcd?version=2",
            "s3://drives/2026/07/x.feather",
            "file:///data/x.npz",
        ] {
            assert!(allowed.check(good).is_ok(), "{good}");
        }
        for (wrong, why) in [
            ("https://a.example/other/x", NotAllowed::Elsewhere),
            ("https://a.example/in/../other/x", NotAllowed::Elsewhere),
            ("https://a.example/in", NotAllowed::Elsewhere),
            ("http://a.example/in/x", NotAllowed::Elsewhere),
            ("https://a.example:8443/in/x", NotAllowed::Elsewhere),
            ("https://a.example.evil.example/in/x", NotAllowed::Elsewhere),
            ("s3://drives-2/2026/x", NotAllowed::Elsewhere),
            ("file:///data/../etc/passwd", NotAllowed::Elsewhere),
            ("https://user@a.example/in/x", NotAllowed::Malformed),
            ("https://a.example/in/%2e%2e/x", NotAllowed::Elsewhere),
            ("https://a.example/in/..%2Fx", NotAllowed::Malformed),
            ("s3://drives/2026/a\\..\\..\\x", NotAllowed::Malformed),
            ("https://a.example/in/x#f", NotAllowed::Malformed),
            ("a.example/in/x", NotAllowed::Malformed),
            ("", NotAllowed::Malformed),
        ] {
            assert_eq!(allowed.check(wrong), Err(why), "{wrong}");
        }
        let nothing = Allowed::default();
        assert!(nothing.is_empty());
        assert!(nothing.check("https://a.example/in/x").is_err());
    }

    #[test]
    fn a_prefix_is_a_url_that_ends_with_a_slash() {
        for wrong in [
            "https://a.example/in",
            "ftp://a.example/",
            "a",
            "https://a.example/?x=",
        ] {
            let refused = Allowed::new(&[wrong.to_owned()], &["https"]);
            assert!(refused.is_err(), "{wrong}");
        }
    }
}
