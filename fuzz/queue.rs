//! Schedules of the queue: clients, workers, clocks, disk and crashes, against its promises.

use libfuzzer_sys::Corpus;

/// The steps of one schedule.
pub(crate) fn schedule(bytes: &[u8]) -> Corpus {
    fnsf::queue::simulation::run(bytes);
    Corpus::Keep
}
