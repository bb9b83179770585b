//! Memory budget for results that are encoded and sent, and a cache of the latest ones.
//!
//! A slow client may read at any rate while the budget suffices. When another result needs memory,
//! the result with the slowest reader is evicted. Its client can fetch the rest with a range
//! request.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

use super::error::ApiError;
use crate::job::{JobId, Tenant};
use crate::sync::locked;

/// Granularity of the budget, bytes.
const UNIT: usize = 1 << 10;

/// The reciprocal of the cache's share of the budget. Cached results serve later range requests for
/// the same result.
const KEPT: usize = 4;

/// Time for which a result is sent before it may be evicted, however slow its reader is.
const GRACE: Duration = Duration::from_secs(10);

/// Interval at which a request that waits for memory tries again.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Size of the chunks that are passed to a connection, bytes.
const PIECE: usize = 64 << 10;

/// Cache key: the job id, the attempt, and the file extension of the format.
pub(super) type Name = (JobId, u32, &'static str);

/// Limits on the memory of results, and on waiting for it.
#[derive(Clone, Copy, Debug)]
pub(super) struct ResultLimits {
    /// Budget for all results together, bytes.
    pub(super) all: u64,
    /// Whether there are several tenants. One tenant can then use at most half of the budget.
    pub(super) shared: bool,
    /// Maximum time that a result waits for memory.
    pub(super) patience: Duration,
    /// Time for which a result is sent before it may be evicted.
    pub(super) grace: Duration,
}

impl ResultLimits {
    pub(super) fn new(all: u64, shared: bool) -> Self {
        Self {
            all,
            shared,
            patience: Duration::from_secs(5),
            grace: GRACE,
        }
    }
}

/// The memory budget for all results, and the cache.
pub(super) struct ResultBudget {
    units: usize,
    limits: ResultLimits,
    free: Arc<Semaphore>,
    held: Arc<Mutex<HashMap<Tenant, usize>>>,
    rooms: Mutex<Vec<Weak<ReadProgress>>>,
    kept: Mutex<VecDeque<(Name, Encoded)>>,
}

/// A memory reservation for one result, released when dropped.
pub(super) struct ResultReservation {
    permit: OwnedSemaphorePermit,
    tenant: Tenant,
    held: Arc<Mutex<HashMap<Tenant, usize>>>,
    taking: Arc<ReadProgress>,
}

/// The read progress of one result. A result that is not sent yet has no reader to be slow: it is never evicted.
pub(super) struct ReadProgress {
    tenant: Tenant,
    /// When its first piece was offered to a client.
    since: OnceLock<Instant>,
    bytes: AtomicU64,
    evicted: CancellationToken,
}

/// An encoded result. It holds its memory reservation as long as any slice of it exists.
#[derive(Clone)]
pub(super) struct Encoded {
    bytes: Bytes,
    taking: Arc<ReadProgress>,
}

struct ReservedBytes {
    bytes: Vec<u8>,
    _room: ResultReservation,
}

impl AsRef<[u8]> for ReservedBytes {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl ResultBudget {
    pub(super) fn new(limits: ResultLimits) -> Self {
        let units = usize::try_from(limits.all).unwrap_or(usize::MAX) / UNIT;
        let units = units.clamp(2, u32::MAX as usize);
        Self {
            units,
            limits,
            free: Arc::new(Semaphore::new(units)),
            held: Arc::default(),
            rooms: Mutex::default(),
            kept: Mutex::default(),
        }
    }

    /// The share of one tenant, in units of [`UNIT`] bytes.
    fn share(&self) -> usize {
        if self.limits.shared {
            self.units / 2
        } else {
            self.units
        }
    }

    /// Reserves `bytes` bytes for a tenant's result. A request above the tenant's share reserves
    /// the whole share, so that it can be served alone. It waits for memory, clears the cache and
    /// evicts slow readers as needed.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`] if no memory is released in time.
    pub(super) async fn room(
        &self,
        tenant: &Tenant,
        bytes: usize,
    ) -> Result<ResultReservation, ApiError> {
        let units = bytes.div_ceil(UNIT).clamp(1, self.share());
        let until = Instant::now() + self.limits.patience;
        loop {
            if let Some(room) = self.try_room(tenant, units) {
                return Ok(room);
            }
            locked(&self.kept).clear();
            if let Some(room) = self.try_room(tenant, units) {
                return Ok(room);
            }
            let own = locked(&self.held).get(tenant).copied().unwrap_or(0);
            let own_share = own + units > self.share();
            self.end_the_slowest(own_share.then_some(tenant));
            if Instant::now() >= until {
                return Err(ApiError::ServerFull(Duration::from_secs(5)));
            }
            tokio::time::sleep(POLL_INTERVAL.min(self.limits.patience)).await;
        }
    }

    fn try_room(&self, tenant: &Tenant, units: usize) -> Option<ResultReservation> {
        let mut held = locked(&self.held);
        let own = held.get(tenant).copied().unwrap_or(0);
        if own + units > self.share() {
            return None;
        }
        let free = Arc::clone(&self.free);
        let permit = free.try_acquire_many_owned(units as u32).ok()?;
        *held.entry(tenant.clone()).or_default() += units;
        let taking = Arc::new(ReadProgress {
            tenant: tenant.clone(),
            since: OnceLock::new(),
            bytes: AtomicU64::new(0),
            evicted: CancellationToken::new(),
        });
        let mut rooms = locked(&self.rooms);
        rooms.retain(|room| room.strong_count() > 0);
        rooms.push(Arc::downgrade(&taking));
        Some(ResultReservation {
            permit,
            tenant: tenant.clone(),
            held: Arc::clone(&self.held),
            taking,
        })
    }

    /// Evicts the result with the slowest reader: of tenant `of`, or else of the tenant that holds
    /// the most memory.
    fn end_the_slowest(&self, of: Option<&Tenant>) {
        let most = {
            let held = locked(&self.held);
            held.iter()
                .max_by_key(|(_, units)| **units)
                .map(|(tenant, _)| tenant.clone())
        };
        let Some(tenant) = of.cloned().or(most) else {
            return;
        };
        let rooms: Vec<Arc<ReadProgress>> = locked(&self.rooms)
            .iter()
            .filter_map(Weak::upgrade)
            .collect();
        let slow = rooms.iter().filter(|one| {
            one.tenant == tenant
                && one.age().is_some_and(|age| age >= self.limits.grace)
                && !one.evicted.is_cancelled()
        });
        if let Some(slowest) = slow.min_by(|one, other| one.rate().total_cmp(&other.rate())) {
            slowest.evicted.cancel();
        }
    }

    /// A cached result.
    pub(super) fn made(&self, name: &Name) -> Option<Encoded> {
        let kept = locked(&self.kept);
        let found = kept.iter().find(|(known, _)| known == name);
        let usable = found.filter(|(_, made)| !made.taking.evicted.is_cancelled());
        usable.map(|(_, made)| made.clone())
    }

    /// Caches a result, and removes the oldest ones from the cache as needed.
    pub(super) fn keep(&self, name: Name, made: &Encoded) {
        let most = self.units / KEPT * UNIT;
        if made.bytes.len() > most {
            return;
        }
        let mut kept = locked(&self.kept);
        kept.retain(|(known, _)| *known != name);
        kept.push_back((name, made.clone()));
        let mut all: usize = kept.iter().map(|(_, made)| made.bytes.len()).sum();
        while all > most
            && let Some((_, oldest)) = kept.pop_front()
        {
            all -= oldest.bytes.len();
        }
    }
}

impl ReadProgress {
    /// Records that the result is sent from now on.
    pub(super) fn begin(&self) {
        self.since.get_or_init(Instant::now);
    }

    /// The time for which it is sent. None before.
    fn age(&self) -> Option<Duration> {
        self.since.get().map(Instant::elapsed)
    }

    /// The mean rate at which the client has read so far, bytes per second.
    fn rate(&self) -> f64 {
        let taken = self.bytes.load(Ordering::Relaxed) as f64;
        taken / self.age().unwrap_or_default().as_secs_f64().max(1e-3)
    }

    /// Records that the client has read `bytes` bytes.
    pub(super) fn took(&self, bytes: usize) {
        self.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Completes when the result is evicted.
    pub(super) async fn evicted(&self) {
        self.evicted.cancelled().await;
    }
}

impl ResultReservation {
    /// The read progress of the result.
    pub(super) fn taking(&self) -> &Arc<ReadProgress> {
        &self.taking
    }

    /// Reduces the reservation to `bytes` bytes.
    pub(super) fn shrink(&mut self, bytes: usize) {
        let needed = bytes.div_ceil(UNIT).max(1);
        let spare = self.permit.num_permits().saturating_sub(needed);
        if spare > 0 {
            drop(self.permit.split(spare));
            self.give_back(spare);
        }
    }

    fn give_back(&self, units: usize) {
        let mut held = locked(&self.held);
        if let Some(own) = held.get_mut(&self.tenant) {
            *own = own.saturating_sub(units);
            if *own == 0 {
                held.remove(&self.tenant);
            }
        }
    }

    /// Attaches the reservation to the bytes of the result. It is held as long as any slice of them
    /// exists.
    pub(super) fn hold(mut self, bytes: Vec<u8>) -> Encoded {
        self.shrink(bytes.len());
        let taking = Arc::clone(&self.taking);
        Encoded {
            bytes: Bytes::from_owner(ReservedBytes { bytes, _room: self }),
            taking,
        }
    }
}

impl Drop for ResultReservation {
    fn drop(&mut self) {
        self.give_back(self.permit.num_permits());
    }
}

impl Encoded {
    /// The length, bytes.
    pub(super) fn len(&self) -> usize {
        self.bytes.len()
    }

    /// The bytes, for a writer that splits them itself.
    pub(super) fn bytes(&self) -> &Bytes {
        &self.bytes
    }

    /// The read progress.
    pub(super) fn taking(&self) -> &Arc<ReadProgress> {
        &self.taking
    }

    /// A slice that shares the memory and the reservation.
    pub(super) fn slice(&self, range: std::ops::Range<usize>) -> Self {
        Self {
            bytes: self.bytes.slice(range),
            taking: Arc::clone(&self.taking),
        }
    }

    /// A stream of chunks at the rate of the reader. When the result is evicted, the stream
    /// releases all of its memory and ends with an error.
    pub(super) fn into_pieces(mut self) -> ReceiverStream<Result<Bytes, std::io::Error>> {
        let (pieces, stream) = mpsc::channel::<Result<Bytes, std::io::Error>>(1);
        self.taking.begin();
        tokio::spawn(async move {
            while !self.bytes.is_empty() {
                // A copy: a chunk in the connection's buffer must not keep the whole result alive.
                let length = self.bytes.len().min(PIECE);
                let piece = Bytes::copy_from_slice(&self.bytes.split_to(length));
                tokio::select! {
                    sent = pieces.send(Ok(piece)) => match sent {
                        Ok(()) => self.taking.took(length),
                        Err(_) => return,
                    },
                    () = self.taking.evicted() => {
                        tracing::info!("an answer that was taken slowly has made room for others");
                        drop(self);
                        let end = Err(std::io::ErrorKind::TimedOut.into());
                        let _gone_is_fine = pieces.send(end).await;
                        return;
                    }
                }
            }
        });
        ReceiverStream::new(stream)
    }
}

#[cfg(test)]
mod tests {
    use futures_util::StreamExt;

    use super::*;

    const KIB: usize = 1 << 10;

    fn answers(shared: bool, grace: Duration) -> ResultBudget {
        ResultBudget::new(ResultLimits {
            all: 1 << 20,
            shared,
            patience: Duration::from_millis(300),
            grace,
        })
    }

    fn tenant(name: &str) -> Tenant {
        name.parse().expect("a good name")
    }

    #[tokio::test]
    async fn answers_that_are_not_read_keep_the_next_one_out_until_they_are() {
        let answers = answers(false, Duration::from_secs(3600));
        let a = tenant("a");
        let room = answers.room(&a, 1 << 20).await.expect("room");
        let held = room.hold(vec![0; 600 * KIB]);
        let part = held.slice(5..10);
        drop(held);
        let refused = answers.room(&a, 600 * KIB).await;
        assert!(matches!(refused, Err(ApiError::ServerFull(_))));
        let small = answers.room(&a, 400 * KIB).await.expect("what was spare");
        drop((part, small));
        // A request larger than the whole budget is served alone instead of being refused forever.
        drop(answers.room(&a, 1 << 30).await.expect("room"));
        assert!(locked(&answers.held).is_empty());
    }

    #[tokio::test]
    async fn the_slowest_reader_makes_room_and_the_whole_answer_with_it() {
        let answers = answers(false, Duration::ZERO);
        let a = tenant("a");
        let made = |room: ResultReservation| room.hold(vec![7; 400 * KIB]).into_pieces();
        let mut slow = made(answers.room(&a, 400 * KIB).await.expect("room"));
        let mut quick = made(answers.room(&a, 400 * KIB).await.expect("room"));
        for _ in 0..5 {
            quick.next().await.expect("a piece").expect("no error");
        }
        slow.next().await.expect("a piece").expect("no error");
        let third = answers.room(&a, 400 * KIB).await.expect("room");
        let rest: Vec<_> = slow.collect().await;
        assert!(rest.last().is_some_and(Result::is_err), "it was ended");
        let rest: Vec<_> = quick.collect().await;
        let lengths = rest.into_iter().map(|piece| piece.expect("no error").len());
        assert_eq!(lengths.sum::<usize>(), 400 * KIB - 5 * PIECE);
        drop(third);
    }

    #[tokio::test]
    async fn an_answer_that_is_not_sent_yet_is_not_ended_for_another() {
        let answers = answers(false, Duration::ZERO);
        let a = tenant("a");
        // It waits for its turn to be encoded, and is older than what is sent.
        let waiting = answers.room(&a, 400 * KIB).await.expect("room");
        let sent = answers.room(&a, 400 * KIB).await.expect("room");
        let mut sent = sent.hold(vec![7; 400 * KIB]).into_pieces();
        sent.next().await.expect("a piece").expect("no error");
        let third = answers.room(&a, 400 * KIB).await.expect("room");
        assert!(!waiting.taking().evicted.is_cancelled());
        let rest: Vec<_> = sent.collect().await;
        assert!(rest.last().is_some_and(Result::is_err), "it was ended");
        drop((waiting, third));
    }

    #[tokio::test]
    async fn a_tenant_cannot_take_all_room() {
        let answers = answers(true, Duration::from_secs(3600));
        let (a, b) = (tenant("a"), tenant("b"));
        let held = answers.room(&a, 1 << 20).await.expect("half of it");
        let refused = answers.room(&a, KIB).await;
        assert!(matches!(refused, Err(ApiError::ServerFull(_))));
        drop(answers.room(&b, 500 * KIB).await.expect("the other half"));
        drop(held);
        assert!(locked(&answers.held).is_empty());
    }

    #[tokio::test]
    async fn answers_are_kept_for_the_next_range_unless_room_is_needed() {
        let answers = answers(false, GRACE);
        let a = tenant("a");
        let name = |attempt| (JobId::fresh(), attempt, "npz");
        let [first, second, third, large] = [1, 2, 3, 4].map(name);
        for name in [first, second, third] {
            let room = answers.room(&a, 100 * KIB).await.expect("room");
            answers.keep(name, &room.hold(vec![0; 100 * KIB]));
        }
        assert!(answers.made(&first).is_none());
        let made = answers.made(&third).map(|made| made.len());
        assert_eq!(made, Some(100 * KIB));
        let room = answers.room(&a, 1 << 20).await.expect("room");
        assert!(answers.made(&third).is_none());
        answers.keep(large, &room.hold(vec![0; 300 * KIB]));
        assert!(answers.made(&large).is_none());
    }
}
