//! One trace from the caller's request to the attempt at its job, in the log and at the collector.

use opentelemetry::propagation::{Extractor, Injector, TextMapPropagator};
use opentelemetry::trace::TraceContextExt;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// The header that names a span, by W3C Trace Context.
pub(crate) const TRACEPARENT: &str = "traceparent";

/// The value of a [`TRACEPARENT`] header, to read or to write.
struct Header(Option<String>);

impl Extractor for Header {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.as_deref().filter(|_| key == TRACEPARENT)
    }

    fn keys(&self) -> Vec<&str> {
        vec![TRACEPARENT]
    }
}

impl Injector for Header {
    fn set(&mut self, key: &str, value: String) {
        if key == TRACEPARENT {
            self.0 = Some(value);
        }
    }
}

/// Makes `span` a child of the span that `parent` names, the value of a [`TRACEPARENT`] header, and
/// records the id of its trace in its field `trace_id`: 32 hexadecimal digits. Without a parent, or
/// with one that is malformed, the span begins a trace if traces are exported, and otherwise has no
/// id.
///
/// Returns the value that makes other spans children of this one. Where no traces are exported it is
/// that of the parent. `None` without a trace.
pub(crate) fn join(span: &Span, parent: Option<&str>) -> Option<String> {
    let propagator = TraceContextPropagator::new();
    let caller = propagator.extract(&Header(parent.map(str::to_owned)));
    let mut joined = caller.clone();
    // Fails only where no traces are exported.
    if !caller.span().span_context().is_valid() || span.set_parent(caller).is_ok() {
        joined = span.context();
    }
    let trace_id = joined.span().span_context().trace_id();
    if trace_id == opentelemetry::TraceId::INVALID {
        return None;
    }
    span.record("trace_id", tracing::field::display(trace_id));
    let mut header = Header(None);
    propagator.inject_context(&joined, &mut header);
    header.0
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use opentelemetry::trace::TracerProvider;
    use opentelemetry_sdk::error::OTelSdkResult;
    use opentelemetry_sdk::trace::{SdkTracerProvider, SpanData, SpanExporter};
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

    /// Keeps the spans that are exported.
    #[derive(Clone, Debug, Default)]
    struct Spans(Arc<Mutex<Vec<SpanData>>>);

    impl SpanExporter for Spans {
        async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
            self.0.lock().expect("spans").extend(batch);
            Ok(())
        }
    }

    /// The log of one request with this `traceparent` and of the attempt at its job, and the spans
    /// that were exported for them.
    fn logged(traceparent: Option<&str>, exports: bool) -> (String, Vec<SpanData>) {
        let lines = Lines::default();
        let exporter = Spans::default();
        let provider = SdkTracerProvider::builder()
            .with_simple_exporter(exporter.clone())
            .build();
        let spans =
            exports.then(|| tracing_opentelemetry::layer().with_tracer(provider.tracer("test")));
        let log = tracing_subscriber::fmt::layer().with_writer(lines.clone());
        let subscriber = tracing_subscriber::registry().with(log.json()).with(spans);
        tracing::subscriber::with_default(subscriber, || {
            let span = tracing::info_span!("request", trace_id = tracing::field::Empty);
            let child_of = join(&span, traceparent);
            span.in_scope(|| tracing::info!("answered"));
            drop(span);
            // The attempt at the job of this request, at another time and in another process.
            let attempt = tracing::info_span!("attempt", trace_id = tracing::field::Empty);
            join(&attempt, child_of.as_deref());
            attempt.in_scope(|| tracing::info!("done"));
        });
        let text = lines.0.lock().expect("lines").clone();
        let spans = exporter.0.lock().expect("spans").clone();
        (String::from_utf8(text).expect("text"), spans)
    }

    fn lines_with(log: &str, text: &str) -> usize {
        log.lines().filter(|line| line.contains(text)).count()
    }

    #[test]
    fn a_request_and_its_attempt_are_in_the_callers_trace_in_the_log_and_at_the_collector() {
        let parent = format!("00-{TRACE}-b7ad6b7169203331-01");
        let (line, spans) = logged(Some(&parent), true);
        assert_eq!(lines_with(&line, TRACE), 2, "{line}");
        let [request, attempt] = &spans[..] else {
            unreachable!("two spans ended: {spans:?}");
        };
        assert_eq!(request.span_context.trace_id().to_string(), TRACE);
        assert_eq!(request.parent_span_id.to_string(), "b7ad6b7169203331");
        assert_eq!(attempt.span_context.trace_id().to_string(), TRACE);
        assert_eq!(attempt.parent_span_id, request.span_context.span_id());
    }

    #[test]
    fn the_log_has_the_callers_trace_where_no_traces_are_exported() {
        let (line, _) = logged(Some(&format!("00-{TRACE}-b7ad6b7169203331-00")), false);
        assert_eq!(lines_with(&line, TRACE), 2, "{line}");
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
            assert_eq!(lines_with(&line, &own), 2, "{line}");
            let (line, _) = logged(wrong, false);
            assert!(!line.contains("trace_id"), "{line}");
        }
    }
}
