//! Room for the bodies that are being received, and time for them to come.
//!
//! Room is memory that others want: a body has to come at a least rate, and a stream that pauses
//! keeps its room only as long as nobody else needs it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;

use super::error::ApiError;
use crate::job::Tenant;
use crate::metrics::Metrics;

/// The unit in which room is counted, bytes.
const UNIT: u64 = 1 << 10;

/// The least rate of a body: a line that is slower than this is not served.
const LEAST_BYTES_PER_SECOND: f64 = 1024.0;

/// The longest that one body may take.
const LONGEST: Duration = Duration::from_secs(3600);

/// What uploads may take.
#[derive(Clone, Copy, Debug)]
pub(super) struct UploadLimits {
    /// Bytes of one body.
    pub(super) body: u64,
    /// Bytes of all bodies together.
    pub(super) all: u64,
    /// Bytes of all bodies of one tenant.
    pub(super) tenant: u64,
    /// Time without a byte.
    pub(super) idle: Duration,
}

/// Room for all bodies.
pub(super) struct Uploads {
    limits: UploadLimits,
    free: Arc<Semaphore>,
    held: Mutex<HashMap<Tenant, u64>>,
    paused: Mutex<Vec<Paused>>,
    metrics: Arc<Metrics>,
}

struct Paused {
    tenant: Tenant,
    since: Instant,
    end: CancellationToken,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Uploads {
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

    /// Room for a body of a tenant: none yet.
    pub(super) fn room(self: &Arc<Self>, tenant: &Tenant) -> Room {
        Room {
            uploads: Arc::clone(self),
            tenant: tenant.clone(),
            held: None,
            bytes: 0,
            began: None,
            credit: self.limits.idle,
        }
    }

    /// Ends the longest pause, if it is long enough: of one tenant, or of whoever holds most.
    fn end_a_pause(&self, of: Option<&Tenant>) {
        let held = locked(&self.held).clone();
        let most = held.values().max().copied();
        let may_end = |tenant: &Tenant| match of {
            Some(of) => tenant == of,
            None => held.get(tenant).copied() == most,
        };
        let mut paused = locked(&self.paused);
        let own = (0..paused.len()).filter(|&place| may_end(&paused[place].tenant));
        if let Some(place) = own.min_by_key(|&place| paused[place].since)
            && paused[place].since.elapsed() >= self.limits.idle
        {
            paused.swap_remove(place).end.cancel();
        }
    }
}

/// Takes a pause off the list, however it ends.
struct Over<'a>(&'a Uploads, &'a CancellationToken);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        let mut paused = locked(&self.0.paused);
        // Each token is of one pause: none is cancelled but by the list itself.
        self.1.cancel();
        paused.retain(|pause| !pause.end.is_cancelled());
    }
}

/// Room for one body's bytes, given back when it is dropped, and time for them to come.
pub(super) struct Room {
    uploads: Arc<Uploads>,
    tenant: Tenant,
    held: Option<OwnedSemaphorePermit>,
    bytes: u64,
    /// When its first byte came.
    began: Option<Instant>,
    /// Time that it may still be silent; bytes earn more, up to what it began with.
    credit: Duration,
}

impl Room {
    /// Room for another body of the same tenant: this one's is given on.
    pub(super) fn next(&mut self) -> Self {
        let next = self.uploads.room(&self.tenant);
        std::mem::replace(self, next)
    }

    /// Whose it is.
    pub(super) fn tenant(&self) -> &Tenant {
        &self.tenant
    }

    /// Room beside this one, of the same tenant.
    pub(super) fn another(&self) -> Self {
        self.uploads.room(&self.tenant)
    }

    /// Takes room for `bytes` more.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`] where one request has too many, [`ApiError::ServerFull`] where all
    /// requests together have, or all of the tenant's.
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

    /// Takes room until it holds `bytes`: of a body so far, or of what it is unfolded to.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`].
    pub(super) fn hold(&mut self, bytes: u64) -> Result<(), ApiError> {
        let limits = self.uploads.limits;
        // Whole units of all bytes: small pieces must not cost more than large ones.
        let more = bytes.div_ceil(UNIT).saturating_sub(self.units());
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

    /// Waits for more of a body: no longer than it may be silent, than the least rate allows, and
    /// than any body may take.
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

    /// Bytes that it holds.
    pub(super) fn bytes(&self) -> u64 {
        self.units() * UNIT
    }

    /// Waits for more of a stream for as long as it likes, unless others need the room that it
    /// holds, `besides` this one's bytes: then the tenant's longest pause has to end, once it is
    /// longer than a body may be silent. Who holds nothing is in nobody's way.
    ///
    /// # Errors
    /// [`ApiError::TooSlow`].
    pub(super) async fn pause<T>(
        &self,
        besides: u64,
        more: impl Future<Output = T>,
    ) -> Result<T, ApiError> {
        if besides + self.bytes() == 0 {
            return Ok(more.await);
        }
        let end = CancellationToken::new();
        locked(&self.uploads.paused).push(Paused {
            tenant: self.tenant.clone(),
            since: Instant::now(),
            end: end.clone(),
        });
        let _over = Over(&self.uploads, &end);
        tokio::select! {
            biased;
            came = more => Ok(came),
            () = end.cancelled() => Err(ApiError::TooSlow),
        }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        let units = self.units();
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

    fn uploads() -> Arc<Uploads> {
        let limits = UploadLimits {
            body: 1 << 20,
            all: 2 << 20,
            tenant: 1 << 20,
            idle: IDLE,
        };
        Arc::new(Uploads::new(limits, Arc::new(Metrics::new(&["cpu"]))))
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
        // A byte now and then is as good as none: what it earns is a millisecond.
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

    #[tokio::test]
    async fn a_stream_pauses_until_others_need_its_room() {
        let uploads = uploads();
        let mut rooms = ["a", "b"].map(|name| uploads.room(&tenant(name)));
        for room in &mut rooms {
            room.take(1 << 20).expect("room");
        }
        let [first, second] = rooms;
        // One that holds nothing is in nobody's way, however long it is silent.
        let empty = uploads.room(&tenant("a"));
        let pausing = |room: Room| {
            tokio::spawn(async move { room.pause(0, std::future::pending::<()>()).await })
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
        let paused = tokio::spawn(async move { room.pause(0, std::future::pending::<()>()).await });
        tokio::time::sleep(IDLE * 2).await;
        assert!(uploads.room(&tenant("a")).take(1).is_err());
        assert_eq!(paused.await.expect("no panic"), Err(ApiError::TooSlow));
        uploads.room(&tenant("a")).take(1).expect("room");
    }
}
