//! Logs on stderr, human-readable or JSON, and traces to an OTLP collector if one is configured.

use std::io::IsTerminal;

use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::WithExportConfig;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::config::{LogConfig, LogFormat};

/// Why logging or tracing cannot start.
#[derive(Debug, thiserror::Error)]
pub enum TelemetryError {
    /// `log.filter` is not a valid filter.
    #[error("log.filter: {0}")]
    Filter(#[from] tracing_subscriber::filter::ParseError),
    /// No exporter can be built for `otlp_endpoint`, for example because it is not a URL.
    #[error("otlp_endpoint: {0}")]
    Otlp(#[from] opentelemetry_otlp::ExporterBuildError),
    /// A logger was already installed in this process.
    #[error("logging was started twice")]
    Twice(#[from] tracing_subscriber::util::TryInitError),
}

/// Keeps tracing active. Dropping it sends the remaining traces.
#[derive(Debug, Default)]
pub struct Telemetry {
    traces: Option<SdkTracerProvider>,
}

impl Telemetry {
    /// Starts logging, and tracing if `otlp_endpoint` is given, for the whole process.
    ///
    /// # Errors
    /// - [`TelemetryError::Filter`] if the log filter is invalid.
    /// - [`TelemetryError::Otlp`] if no exporter can be built for `otlp_endpoint`.
    /// - [`TelemetryError::Twice`] if a logger was already installed in this process.
    ///
    /// # Panics
    /// If `otlp_endpoint` is given and there is no current tokio runtime.
    pub fn start(log: &LogConfig, otlp_endpoint: Option<&str>) -> Result<Self, TelemetryError> {
        let filter: EnvFilter = log.filter.parse()?;
        let lines = tracing_subscriber::fmt::layer()
            .with_writer(std::io::stderr)
            .with_ansi(std::io::stderr().is_terminal());
        let lines = match log.format {
            LogFormat::Human => lines.compact().boxed(),
            LogFormat::Json => lines.json().flatten_event(true).boxed(),
        };
        let traces = otlp_endpoint.map(exporter).transpose()?;
        let spans = traces.as_ref().map(|traces| {
            let tracer = traces.tracer("fnsf");
            tracing_opentelemetry::layer().with_tracer(tracer)
        });
        tracing_subscriber::registry()
            .with(filter)
            .with(lines)
            .with(spans)
            .try_init()?;
        Ok(Self { traces })
    }
}

fn exporter(endpoint: &str) -> Result<SdkTracerProvider, TelemetryError> {
    let exporter = opentelemetry_otlp::SpanExporter::builder()
        .with_tonic()
        .with_endpoint(endpoint)
        .build()?;
    let resource = Resource::builder().with_service_name("fnsf").build();
    Ok(SdkTracerProvider::builder()
        .with_batch_exporter(exporter)
        .with_resource(resource)
        .build())
}

impl Drop for Telemetry {
    fn drop(&mut self) {
        if let Some(traces) = self.traces.take()
            && let Err(error) = traces.shutdown()
        {
            tracing::warn!(%error, "the last traces were not sent");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn collectors_are_reached_with_tls_and_without() {
        for endpoint in ["http://localhost:4317", "https://localhost:4317"] {
            assert!(exporter(endpoint).is_ok(), "{endpoint}");
        }
        assert!(exporter("no URL").is_err());
    }
}
