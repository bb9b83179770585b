//! The metrics of the process under Prometheus' standard names, read when they are scraped.

use procfs::WithCurrentSystemInfo;
use procfs::process::{LimitValue, Process};
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Unit;

/// Collects the metrics of this process from `/proc`.
#[derive(Debug)]
pub(super) struct ProcessCollector;

impl Collector for ProcessCollector {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        // Without /proc the process has no metrics of its own.
        let Ok(own) = Process::myself() else {
            return Ok(());
        };
        let mut add = |name, help, unit: Option<&Unit>, value: &dyn EncodeMetric| {
            let kind = value.metric_type();
            value.encode(encoder.encode_descriptor(name, help, unit, kind)?)
        };
        if let Ok(stat) = own.stat() {
            let ticks = procfs::ticks_per_second() as f64;
            let cpu = (stat.utime + stat.stime) as f64 / ticks;
            let (seconds, bytes) = (Some(&Unit::Seconds), Some(&Unit::Bytes));
            let help = "Processor time of the process, user and system";
            add("process_cpu", help, seconds, &ConstCounter::new(cpu))?;
            let resident = stat.rss_bytes().get() as f64;
            let help = "Resident memory of the process";
            add(
                "process_resident_memory",
                help,
                bytes,
                &ConstGauge::new(resident),
            )?;
            if let Ok(boot) = procfs::boot_time_secs() {
                let began = boot as f64 + stat.starttime as f64 / ticks;
                let help = "Start of the process, seconds since 1970";
                add("process_start_time", help, seconds, &ConstGauge::new(began))?;
            }
            let threads = ConstGauge::new(stat.num_threads);
            add("process_threads", "Threads of the process", None, &threads)?;
        }
        if let Ok(open) = own.fd_count() {
            let open = ConstGauge::new(open as f64);
            add("process_open_fds", "Open file descriptors", None, &open)?;
        }
        if let Ok(limits) = own.limits()
            && let LimitValue::Value(most) = limits.max_open_files.soft_limit
        {
            let most = ConstGauge::new(most as f64);
            add(
                "process_max_fds",
                "Maximum number of open file descriptors",
                None,
                &most,
            )?;
        }
        Ok(())
    }
}
