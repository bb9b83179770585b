//! Requests at the service's doors, in one process: whatever is sent is answered, and never with the
//! error of a fault.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::http::{Request, Version};
use fnsf::api::{Service, ServiceParts, public_router};
use fnsf::queue::{QueueOptions, open_sqlite};
use http_body_util::BodyExt;
use libfuzzer_sys::Corpus;
use tokio::runtime::Runtime;
use tower::ServiceExt;

use crate::pieces::Pieces;
use crate::settings::SCRATCH;

/// Requests after which the service is replaced, since it keeps the jobs.
const REQUESTS: usize = 2000;

/// Time that an answer may take. No worker runs, so a request that waits for a flow gets none.
const PATIENCE: Duration = Duration::from_millis(30);

struct Stand {
    runtime: Runtime,
    service: Arc<Service>,
    requests: usize,
    _folder: tempfile::TempDir,
}

impl Stand {
    fn new() -> Self {
        let folder = tempfile::tempdir_in(SCRATCH).expect("a folder");
        let runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = { runtime }.enable_all().build().expect("a runtime");
        let (events, _) = tokio::sync::mpsc::unbounded_channel();
        let queue = open_sqlite(folder.path(), QueueOptions::default(), events).expect("a queue");
        let service = Service::new(ServiceParts::alone(queue, folder.path(), PATIENCE));
        Self {
            runtime,
            service: Arc::new(service),
            requests: 0,
            _folder: folder,
        }
    }

    /// Sends a request. Its answer is read whole, or as far as it comes in time.
    fn ask(&mut self, request: Request<Body>) {
        self.requests += 1;
        let answered = async {
            let answer = public_router(&self.service, true).oneshot(request).await;
            let Ok(answer) = answer;
            let status = answer.status().as_u16();
            assert!(status != 500, "a fault: {answer:?}");
            let _whole = answer.into_body().collect().await;
        };
        let _in_time = self
            .runtime
            .block_on(async { tokio::time::timeout(PATIENCE, answered).await });
    }
}

fn ask(request: Request<Body>) {
    use std::cell::RefCell;
    thread_local! {
        static STAND: RefCell<Option<Stand>> = const { RefCell::new(None) };
    }
    STAND.with_borrow_mut(|stand| {
        if stand
            .as_ref()
            .is_none_or(|stand| stand.requests >= REQUESTS)
        {
            *stand = None;
            // A new service may take memory that no input takes.
            crate::memory::allow(usize::MAX >> 1);
            *stand = Some(Stand::new());
        }
        stand.as_mut().expect("just made").ask(request);
    });
}

/// A request over HTTP: the method and the path, headers, an empty line, and the body.
pub(crate) fn http(bytes: &[u8]) -> Corpus {
    let mut pieces = Pieces(bytes);
    let Ok(first) = std::str::from_utf8(pieces.line()) else {
        return Corpus::Reject;
    };
    let (method, path) = first.split_once(' ').unwrap_or(("GET", first));
    let mut request = Request::builder().method(method).uri(path);
    loop {
        let line = pieces.line();
        if line.is_empty() {
            break;
        }
        let colon = line.iter().position(|byte| *byte == b':');
        let Some((name, value)) = colon.map(|colon| line.split_at(colon)) else {
            return Corpus::Reject;
        };
        request = request.header(name, value[1..].trim_ascii());
    }
    let Ok(request) = request.body(Body::from(pieces.0.to_vec())) else {
        return Corpus::Reject;
    };
    ask(request);
    Corpus::Keep
}

/// A call over gRPC: the number of the method, and messages after their lengths.
pub(crate) fn grpc(bytes: &[u8]) -> Corpus {
    const METHODS: [&str; 11] = [
        "EstimateFlow",
        "EstimateSequence",
        "SubmitJob",
        "GetJob",
        "ListJobs",
        "CancelJob",
        "DeleteJob",
        "RequeueJob",
        "WatchJob",
        "GetTracks",
        "DownloadResult",
    ];
    let mut pieces = Pieces(bytes);
    let method = METHODS[usize::from(pieces.byte()) % METHODS.len()];
    let mut body = Vec::new();
    while !pieces.is_empty() {
        let message = pieces.counted();
        body.push(0);
        body.extend((message.len() as u32).to_be_bytes());
        body.extend(message);
    }
    let request = Request::post(format!("/fnsf.v1.SceneFlow/{method}"))
        .version(Version::HTTP_2)
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(Body::from(body));
    ask(request.expect("a request"));
    Corpus::Keep
}
