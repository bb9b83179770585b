//! Memory budget and time limits for request bodies that are being received.
//!
//! A body must arrive at a minimum rate. A stream may pause, and keeps its memory until other
//! requests need it.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;

use super::error::ApiError;
use crate::job::Tenant;
use crate::metrics::Metrics;
use crate::sync::locked;

/// Granularity of the budget, bytes.
const UNIT: u64 = 1 << 10;

/// Minimum rate of a body, bytes per second.
const LEAST_BYTES_PER_SECOND: f64 = 1024.0;

/// Maximum time to receive one body.
const LONGEST: Duration = Duration::from_secs(3600);

/// Limits on request bodies.
#[derive(Clone, Copy, Debug)]
pub(super) struct UploadLimits {
    /// Maximum size of one body, bytes.
    pub(super) body: u64,
    /// Budget for all bodies together, bytes.
    pub(super) all: u64,
    /// Budget for all bodies of one tenant, bytes.
    pub(super) tenant: u64,
    /// Maximum time without a byte.
    pub(super) idle: Duration,
}

/// The memory budget for all bodies.
pub(super) struct UploadBudget {
    limits: UploadLimits,
    free: Arc<Semaphore>,
    held: Mutex<HashMap<Tenant, u64>>,
    paused: Mutex<Vec<Paused>>,
    metrics: Arc<Metrics>,
}

/// Bytes that the messages of a request hold, beside the clouds that are made of them. An extension of
/// the request. They may grow during a pause.
#[derive(Clone, Debug, Default)]
pub(super) struct MessageMemory(Arc<AtomicU64>);

impl MessageMemory {
    /// The bytes.
    fn bytes(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }

    /// Replaces the bytes.
    pub(super) fn set(&self, bytes: u64) {
        self.0.store(bytes, Ordering::Relaxed);
    }
}

struct Paused {
    tenant: Tenant,
    since: Instant,
    end: CancellationToken,
    /// Bytes of clouds, and of messages.
    clouds: u64,
    messages: MessageMemory,
}

impl Paused {
    fn holds_memory(&self) -> bool {
        self.clouds + self.messages.bytes() > 0
    }
}

impl UploadBudget {
    pub(super) fn new(limits: UploadLimits, metrics: Arc<Metrics>) -> Self {
        let units = usize::try_from(limits.all / UNIT).unwrap_or(usize::MAX);
        Self {
            limits,
            free: Arc::new(Semaphore::new(units.min(Semaphore::MAX_PERMITS))),
            held: Mutex::default(),
            paused: Mutex::default(),
            metrics,
        }
    }

    /// A reservation for a body of a tenant, initially empty.
    pub(super) fn room(self: &Arc<Self>, tenant: &Tenant) -> UploadReservation {
        UploadReservation {
            uploads: Arc::clone(self),
            tenant: tenant.clone(),
            held: None,
            of_request: Arc::default(),
            bytes: 0,
            began: None,
            credit: self.limits.idle,
        }
    }

    /// Ends the longest pause if it is at least as long as a body may be silent: of tenant `of`, or
    /// else of the tenants that hold the most memory.
    fn end_a_pause(&self, of: Option<&Tenant>) {
        let held = locked(&self.held).clone();
        let most = held.values().max().copied();
        let may_end = |tenant: &Tenant| match of {
            Some(of) => tenant == of,
            None => held.get(tenant).copied() == most,
        };
        let mut paused = locked(&self.paused);
        let own = (0..paused.len())
            .filter(|&index| may_end(&paused[index].tenant) && paused[index].holds_memory());
        if let Some(index) = own.min_by_key(|&index| paused[index].since)
            && paused[index].since.elapsed() >= self.limits.idle
        {
            paused.swap_remove(index).end.cancel();
        }
    }
}

/// Removes a pause from the list when it is dropped.
struct Over<'a>(&'a UploadBudget, &'a CancellationToken);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        let mut paused = locked(&self.0.paused);
        // Each token belongs to one pause. Apart from this guard, a token is cancelled only when
        // its pause has been removed from the list.
        self.1.cancel();
        paused.retain(|pause| !pause.end.is_cancelled());
    }
}

/// A memory reservation for one body, released when dropped, and the time credit of the body.
pub(super) struct UploadReservation {
    uploads: Arc<UploadBudget>,
    tenant: Tenant,
    held: Option<OwnedSemaphorePermit>,
    /// Units of all reservations of the request.
    of_request: Arc<AtomicU64>,
    bytes: u64,
    /// The time of the first byte.
    began: Option<Instant>,
    /// Remaining time without a byte. Received bytes add to it, up to its initial value.
    credit: Duration,
}

impl UploadReservation {
    /// Moves this reservation out for a complete body, and leaves an empty one for the next body of
    /// the same tenant.
    pub(super) fn next(&mut self) -> Self {
        let next = self.another();
        std::mem::replace(self, next)
    }

    /// The tenant.
    pub(super) fn tenant(&self) -> &Tenant {
        &self.tenant
    }

    /// A second, empty reservation for the same request.
    pub(super) fn another(&self) -> Self {
        let mut another = self.uploads.room(&self.tenant);
        another.of_request = Arc::clone(&self.of_request);
        another
    }

    /// Adds `bytes` received bytes to the reservation and to the time credit.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`] if the body exceeds its limit, or those of [`UploadReservation::hold`].
    pub(super) fn take(&mut self, bytes: usize) -> Result<(), ApiError> {
        let limits = self.uploads.limits;
        self.bytes += bytes as u64;
        if self.bytes > limits.body {
            return Err(ApiError::TooLarge(format!(
                "the request's body has more than the {} MiB that this server takes",
                limits.body >> 20
            )));
        }
        self.uploads.metrics.uploaded(bytes);
        self.began.get_or_insert_with(Instant::now);
        let earned = Duration::from_secs_f64(bytes as f64 / LEAST_BYTES_PER_SECOND);
        self.credit = (self.credit + earned).min(limits.idle);
        self.hold(self.bytes)
    }

    /// Checks that the request may hold `more` units in addition to what it holds.
    fn check(&self, more: u64) -> Result<(), ApiError> {
        let UploadLimits { all, tenant, .. } = self.uploads.limits;
        let most = all.min(tenant);
        let bytes = (self.of_request.load(Ordering::Relaxed) + more) * UNIT;
        if bytes <= most {
            return Ok(());
        }
        Err(ApiError::TooLarge(format!(
            "the request takes {} MiB of memory while it is read, and this server has {} MiB for the \
             uploads of a tenant (max_total_upload_mib)",
            bytes.div_ceil(1 << 20),
            most >> 20
        )))
    }

    /// Extends the reservation to `bytes` bytes: the body so far, or the size of the decoded cloud.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`] where the budget never has as much for the request,
    /// [`ApiError::ServerFull`] where others hold it.
    pub(super) fn hold(&mut self, bytes: u64) -> Result<(), ApiError> {
        let limits = self.uploads.limits;
        // Rounded up for the total of the body, so that small chunks do not cost more than large
        // ones.
        let more = bytes.div_ceil(UNIT).saturating_sub(self.units());
        self.check(more)?;
        let full = || ApiError::ServerFull(Duration::from_secs(1));
        {
            let mut held = locked(&self.uploads.held);
            let of_tenant = held.entry(self.tenant.clone()).or_default();
            if (*of_tenant + more) * UNIT > limits.tenant {
                drop(held);
                self.uploads.end_a_pause(Some(&self.tenant));
                return Err(full());
            }
            let free = Arc::clone(&self.uploads.free);
            let permit = free.try_acquire_many_owned(u32::try_from(more).unwrap_or(u32::MAX));
            let Ok(permit) = permit else {
                drop(held);
                self.uploads.end_a_pause(None);
                return Err(full());
            };
            *of_tenant += more;
            self.of_request.fetch_add(more, Ordering::Relaxed);
            match &mut self.held {
                Some(held) => held.merge(permit),
                none => *none = Some(permit),
            }
        }
        Ok(())
    }

    fn units(&self) -> u64 {
        self.held
            .as_ref()
            .map_or(0, OwnedSemaphorePermit::num_permits) as u64
    }

    /// Waits for more of a body, up to its time credit and the maximum time for one body. The
    /// credit implies the minimum rate.
    ///
    /// # Errors
    /// [`ApiError::TooSlow`].
    pub(super) async fn wait<T>(&mut self, more: impl Future<Output = T>) -> Result<T, ApiError> {
        let lasted = self.began.map_or(Duration::ZERO, |began| began.elapsed());
        let left = LONGEST.saturating_sub(lasted).min(self.credit);
        let began = Instant::now();
        let came = tokio::time::timeout(left, more).await;
        self.credit = self.credit.saturating_sub(began.elapsed());
        came.map_err(|_| ApiError::TooSlow)
    }

    /// The reserved bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.units() * UNIT
    }

    /// Waits for more of a stream without a time limit. `besides` is the number of bytes that the
    /// stream holds in other reservations of clouds, and `messages` that of messages. When other
    /// requests need memory, the longest pause of a tenant ends with an error, provided that it is at
    /// least as long as a body may be silent. A stream that holds no memory may pause forever.
    ///
    /// # Errors
    /// [`ApiError::TooSlow`].
    pub(super) async fn pause<T>(
        &self,
        besides: u64,
        messages: &MessageMemory,
        more: impl Future<Output = T>,
    ) -> Result<T, ApiError> {
        let end = CancellationToken::new();
        locked(&self.uploads.paused).push(Paused {
            tenant: self.tenant.clone(),
            since: Instant::now(),
            end: end.clone(),
            clouds: besides + self.bytes(),
            messages: messages.clone(),
        });
        let _over = Over(&self.uploads, &end);
        tokio::select! {
            biased;
            came = more => Ok(came),
            () = end.cancelled() => Err(ApiError::TooSlow),
        }
    }
}

impl Drop for UploadReservation {
    fn drop(&mut self) {
        let units = self.units();
        self.of_request.fetch_sub(units, Ordering::Relaxed);
        let mut held = locked(&self.uploads.held);
        if let Some(of_tenant) = held.get_mut(&self.tenant) {
            *of_tenant = of_tenant.saturating_sub(units);
            if *of_tenant == 0 {
                held.remove(&self.tenant);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDLE: Duration = Duration::from_millis(200);

    fn uploads() -> Arc<UploadBudget> {
        let limits = UploadLimits {
            body: 1 << 20,
            all: 2 << 20,
            tenant: 1 << 20,
            idle: IDLE,
        };
        Arc::new(UploadBudget::new(limits, Arc::new(Metrics::new(&["cpu"]))))
    }

    fn tenant(name: &str) -> Tenant {
        name.parse().expect("a good name")
    }

    #[tokio::test]
    async fn a_burst_earns_no_more_silence_than_a_body_has_anyhow() {
        let mut room = uploads().room(&tenant("a"));
        room.take(1 << 20).expect("room");
        let began = Instant::now();
        let silent = room.wait(std::future::pending::<()>()).await;
        assert_eq!(silent, Err(ApiError::TooSlow));
        assert!(began.elapsed() < IDLE * 20);
        // Single bytes do not prolong a body: each adds about one millisecond.
        let mut room = uploads().room(&tenant("a"));
        let mut waits = 0;
        while room.wait(tokio::time::sleep(IDLE * 3 / 4)).await.is_ok() {
            room.take(1).expect("room");
            waits += 1;
        }
        assert_eq!(waits, 1);
    }

    #[tokio::test]
    async fn a_tenant_cannot_take_all_room_and_what_is_dropped_is_free() {
        let uploads = uploads();
        let (mut first, mut second) = (uploads.room(&tenant("a")), uploads.room(&tenant("a")));
        let mut other = uploads.room(&tenant("b"));
        first.take(1000 << 10).expect("room");
        assert!(matches!(
            second.take(100 << 10),
            Err(ApiError::ServerFull(_))
        ));
        other.take(1 << 20).expect("room");
        assert!(matches!(other.take(1), Err(ApiError::TooLarge(_))));
        drop(first);
        uploads.room(&tenant("a")).take(1 << 20).expect("room");
        assert_eq!(uploads.held.lock().expect("no panic").len(), 1);
    }

    #[test]
    fn a_request_that_never_fits_is_too_large_and_one_that_others_keep_out_may_come_again() {
        let uploads = uploads();
        let mut body = uploads.room(&tenant("a"));
        body.take(600 << 10).expect("room");
        let mut cloud = body.another();
        assert!(matches!(cloud.hold(600 << 10), Err(ApiError::TooLarge(_))));
        let mut other = uploads.room(&tenant("a"));
        let refused = other.hold(600 << 10);
        assert!(matches!(refused, Err(ApiError::ServerFull(_))));
        // A body that is kept belongs to its request, until it is dropped.
        let kept = body.next();
        assert!(matches!(cloud.hold(600 << 10), Err(ApiError::TooLarge(_))));
        drop(kept);
        cloud.hold(600 << 10).expect("room");
    }

    #[tokio::test]
    async fn a_stream_pauses_until_others_need_its_room() {
        let uploads = uploads();
        let mut rooms = ["a", "b"].map(|name| uploads.room(&tenant(name)));
        for room in &mut rooms {
            room.take(1 << 20).expect("room");
        }
        let [first, second] = rooms;
        // A stream that holds no memory is never ended, however long it pauses.
        let empty = uploads.room(&tenant("a"));
        let pausing = |room: UploadReservation| {
            tokio::spawn(async move {
                let none = MessageMemory::default();
                room.pause(0, &none, std::future::pending::<()>()).await
            })
        };
        let empty = pausing(empty);
        let first = pausing(first);
        tokio::time::sleep(IDLE / 4).await;
        let second = pausing(second);
        let mut third = uploads.room(&tenant("c"));
        assert!(third.take(1).is_err());
        tokio::time::sleep(IDLE * 2).await;
        assert!(!first.is_finished() && !second.is_finished());
        let mut third = uploads.room(&tenant("c"));
        assert!(third.take(1).is_err());
        assert_eq!(first.await.expect("no panic"), Err(ApiError::TooSlow));
        let mut third = uploads.room(&tenant("c"));
        third.take(1).expect("room");
        assert!(!second.is_finished() && !empty.is_finished());
    }

    #[tokio::test]
    async fn a_tenant_that_is_alone_does_not_keep_itself_out() {
        let uploads = uploads();
        let mut room = uploads.room(&tenant("a"));
        room.take(1 << 20).expect("room");
        let paused = tokio::spawn(async move {
            let none = MessageMemory::default();
            room.pause(0, &none, std::future::pending::<()>()).await
        });
        tokio::time::sleep(IDLE * 2).await;
        assert!(uploads.room(&tenant("a")).take(1).is_err());
        assert_eq!(paused.await.expect("no panic"), Err(ApiError::TooSlow));
        uploads.room(&tenant("a")).take(1).expect("room");
    }

    #[tokio::test]
    async fn a_message_that_comes_during_a_pause_counts_as_memory_of_the_stream() {
        let uploads = uploads();
        let messages = MessageMemory::default();
        let (empty, known) = (uploads.room(&tenant("a")), messages.clone());
        let paused =
            tokio::spawn(async move { empty.pause(0, &known, std::future::pending::<()>()).await });
        tokio::time::sleep(IDLE * 2).await;
        let mut room = uploads.room(&tenant("a"));
        room.take(1 << 20).expect("room");
        assert!(uploads.room(&tenant("a")).take(1).is_err());
        tokio::time::sleep(IDLE / 4).await;
        assert!(!paused.is_finished(), "it holds nothing");
        messages.set(1);
        assert!(uploads.room(&tenant("a")).take(1).is_err());
        assert_eq!(paused.await.expect("no panic"), Err(ApiError::TooSlow));
    }
}
