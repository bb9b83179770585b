//! The caller's trace: its id in the log, and the request's span as a part of it.

use axum::http::HeaderMap;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::TraceContextExt;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// The field of a span that holds the id of its trace, 32 hexadecimal digits.
pub(super) const TRACE_ID: &str = "trace_id";

/// The headers of a request, in gRPC its metadata.
struct Headers<'a>(&'a HeaderMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(axum::http::HeaderName::as_str).collect()
    }
}

/// Makes `span` a child of the span that the header `traceparent` (W3C Trace Context) names, and
/// records the id of its trace in the field [`TRACE_ID`]. Without that header, or with one that is
/// malformed, the span begins a trace if traces are exported, and otherwise has no id.
pub(super) fn join_trace(span: &Span, headers: &HeaderMap) {
    let caller = TraceContextPropagator::new().extract(&Headers(headers));
    let parent = caller.span().span_context().clone();
    let exported = match parent.is_valid() {
        // Fails only where no traces are exported.
        true => span.set_parent(caller).is_ok(),
        false => true,
    };
    let own = match exported {
        true => span.context().span().span_context().trace_id(),
        false => parent.trace_id(),
    };
    if own != opentelemetry::TraceId::INVALID {
        span.record(TRACE_ID, tracing::field::display(own));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use opentelemetry::trace::TracerProvider;
    use opentelemetry_sdk::trace::{InMemorySpanExporter, SdkTracerProvider};
    use tracing_subscriber::fmt::MakeWriter;
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl std::io::Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().expect("lines").write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    impl<'a> MakeWriter<'a> for Lines {
        type Writer = Self;

        fn make_writer(&'a self) -> Self {
            self.clone()
        }
    }

    /// The log of one request with this `traceparent`, and the spans that were exported for it.
    fn logged(
        traceparent: Option<&str>,
        exports: bool,
    ) -> (String, Vec<opentelemetry_sdk::trace::SpanData>) {
        let lines = Lines::default();
        let exporter = InMemorySpanExporter::default();
        let provider = SdkTracerProvider::builder()
            .with_simple_exporter(exporter.clone())
            .build();
        let spans =
            exports.then(|| tracing_opentelemetry::layer().with_tracer(provider.tracer("test")));
        let log = tracing_subscriber::fmt::layer().with_writer(lines.clone());
        let subscriber = tracing_subscriber::registry().with(log.json()).with(spans);
        tracing::subscriber::with_default(subscriber, || {
            let span = tracing::info_span!("request", trace_id = tracing::field::Empty);
            let mut headers = HeaderMap::new();
            if let Some(value) = traceparent {
                headers.insert("traceparent", value.parse().expect("a header"));
            }
            join_trace(&span, &headers);
            span.in_scope(|| tracing::info!("answered"));
        });
        let text = lines.0.lock().expect("lines").clone();
        let spans = exporter.get_finished_spans().expect("spans");
        (String::from_utf8(text).expect("text"), spans)
    }

    #[test]
    fn a_request_is_a_part_of_its_callers_trace_in_the_log_and_at_the_collector() {
        let parent = format!("00-{TRACE}-b7ad6b7169203331-01");
        let (line, spans) = logged(Some(&parent), true);
        assert!(line.contains(TRACE), "{line}");
        assert_eq!(spans.len(), 1);
        assert_eq!(spans[0].span_context.trace_id().to_string(), TRACE);
        assert_eq!(spans[0].parent_span_id.to_string(), "b7ad6b7169203331");
    }

    #[test]
    fn the_log_has_the_callers_trace_where_no_traces_are_exported() {
        let (line, _) = logged(Some(&format!("00-{TRACE}-b7ad6b7169203331-00")), false);
        assert!(line.contains(TRACE), "{line}");
    }

    #[test]
    fn a_malformed_trace_is_ignored_and_the_request_begins_its_own() {
        for wrong in [
            None,
            Some("00-zz-b7ad6b7169203331-01"),
            Some("00-00000000000000000000000000000000-b7ad6b7169203331-01"),
            Some(""),
        ] {
            let (line, spans) = logged(wrong, true);
            let own = spans[0].span_context.trace_id().to_string();
            assert!(line.contains(&own), "{line}");
            let (line, _) = logged(wrong, false);
            assert!(!line.contains("trace_id"), "{line}");
        }
    }
}
