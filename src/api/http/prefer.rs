//! The `Prefer` header (RFC 7240): `respond-async` and `wait`.

use std::time::Duration;

use axum::http::HeaderMap;

/// The preferences of a client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Prefer {
    /// Whether the client accepts a job instead of a flow.
    pub(super) respond_async: bool,
    /// The time that the client is willing to wait.
    pub(super) wait: Option<Duration>,
}

impl Prefer {
    /// Parses the `Prefer` headers. Unknown preferences are ignored, as the RFC requires.
    pub(super) fn from_headers(headers: &HeaderMap) -> Self {
        let mut prefer = Self::default();
        for value in headers.get_all("prefer") {
            for word in value.to_str().unwrap_or_default().split(',') {
                let word = word.split(';').next().unwrap_or_default().trim();
                let (name, value) = word.split_once('=').unwrap_or((word, ""));
                match name.trim().to_ascii_lowercase().as_str() {
                    "respond-async" => prefer.respond_async = true,
                    "wait" => {
                        let seconds = value.trim().trim_matches('"').parse().ok();
                        prefer.wait = prefer.wait.or(seconds.map(Duration::from_secs));
                    }
                    _ => {}
                }
            }
        }
        prefer
    }

    /// The value of `Preference-Applied`. `None` if no preference was recognized.
    pub(super) fn applied(self) -> Option<String> {
        let mut words = Vec::new();
        if self.respond_async {
            words.push("respond-async".to_owned());
        }
        words.extend(self.wait.map(|wait| format!("wait={}", wait.as_secs())));
        (!words.is_empty()).then(|| words.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    #[test]
    fn preferences_are_read_from_any_number_of_headers() {
        let read = |values: &[&'static str]| {
            let mut headers = HeaderMap::new();
            for value in values {
                headers.append("prefer", HeaderValue::from_static(value));
            }
            Prefer::from_headers(&headers)
        };
        let ten = Some(Duration::from_secs(10));
        let both = Prefer {
            respond_async: true,
            wait: ten,
        };
        assert_eq!(read(&["respond-async, wait=10"]), both);
        assert_eq!(read(&["Wait=\"10\"", "respond-async; foo=\"1\""]), both);
        assert_eq!(read(&["handling=lenient, wait=-1"]), Prefer::default());
        assert_eq!(both.applied().as_deref(), Some("respond-async, wait=10"));
    }
}
