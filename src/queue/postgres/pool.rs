//! The threads that make changes, each on its own connection.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use super::session::{Call, PATIENCE, Session};
use crate::queue::types::QueueError;
use crate::sync::locked;

/// Time after which a call fails whose statements have no answer: the database's machine is there,
/// and the database hangs. Whether a change was made is unknown then, as after a lost connection.
const LONGEST: Duration = Duration::from_secs(30);

const SILENT: &str = "the database does not answer";

/// Work for one of the threads. Nothing is done for a caller that has left.
type Work = Box<dyn FnOnce(&mut Session) + Send>;

/// Handle to the threads, which end when it is dropped.
pub(super) struct Pool {
    work: Sender<Work>,
}

impl Pool {
    /// Starts a thread for each session. `ended` is cancelled when one of them has ended.
    pub(super) fn start(
        sessions: Vec<Session>,
        ended: &CancellationToken,
    ) -> Result<Self, QueueError> {
        let (work, inbox) = channel::<Work>();
        let inbox = Arc::new(Mutex::new(inbox));
        for session in sessions {
            let inbox = Arc::clone(&inbox);
            spawn("queue", ended, move || run(session, &inbox))?;
        }
        Ok(Self { work })
    }

    /// Has one of the threads do something, and waits for it.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Session, Call<'_>) -> Result<T, QueueError> + Send + 'static,
    ) -> Result<T, QueueError> {
        let (answer, answered) = oneshot::channel();
        let at = Instant::now();
        let work: Work = Box::new(move |session| {
            if answer.is_closed() {
                return;
            }
            // The call has waited behind others while the database was away.
            let done = match at.elapsed() > PATIENCE && !session.is_open() {
                true => Err(QueueError::Store(SILENT.to_owned())),
                false => {
                    let has_left = || answer.is_closed();
                    let has_left = &has_left;
                    work(session, Call { at, has_left })
                }
            };
            let _gone_is_fine = answer.send(done);
        });
        self.work.send(work).map_err(|_| QueueError::Closed)?;
        match tokio::time::timeout(LONGEST, answered).await {
            Ok(answer) => answer.map_err(|_| QueueError::Closed)?,
            Err(_) => Err(QueueError::Store(SILENT.to_owned())),
        }
    }
}

fn run(mut session: Session, inbox: &Mutex<Receiver<Work>>) {
    loop {
        let next = locked(inbox).recv();
        match next {
            Ok(work) => work(&mut session),
            Err(_) => return,
        }
    }
}

/// Starts a thread of the queue. `ended` is cancelled when it has ended, even by a panic.
pub(super) fn spawn(
    name: &str,
    ended: &CancellationToken,
    work: impl FnOnce() + Send + 'static,
) -> Result<(), QueueError> {
    let ended = ended.clone();
    let thread = thread::Builder::new().name(name.to_owned());
    let started = thread.spawn(move || {
        let _even_by_a_panic = ended.drop_guard();
        work();
    });
    started.map_err(|error| QueueError::Store(error.to_string()))?;
    Ok(())
}
