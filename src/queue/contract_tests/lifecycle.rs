//! State transitions without failures: submission, order, fair sharing, cancellation, listing.

use super::*;

pub(crate) async fn a_submitted_job_is_leased_once_and_ends_with_its_outcome(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, submission("a")).await;
    assert_eq!((job.state, job.attempt), (State::Queued, 0));
    assert_eq!(queue.backlog().queued().jobs, 1);
    let lease = lease(&queue).await;
    assert_eq!((lease.job.id, lease.job.attempt), (job.id, 1));
    assert_eq!(lease.heartbeat.beat(None), Signal::Continue);
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);
    assert_eq!(queue.backlog().running().jobs, 1);
    let committed = finish(&queue, &lease.job, done()).await;
    assert_eq!(committed, Committed::Yes(State::Succeeded));
    let ended = queue.job(&tenant("a"), job.id).await.expect("known");
    assert_eq!(ended.stop_reason.as_deref(), Some("converged"));
    assert_eq!(ended.progress.map(|progress| progress.done), Some(9));
    assert!(ended.finished >= ended.started && ended.started.is_some());
    assert_eq!(finish(&queue, &lease.job, done()).await, Committed::Fenced);
    assert_eq!(queue.backlog().running().jobs, 0);
    let other = queue.job(&tenant("b"), job.id).await;
    assert_eq!(other, Err(QueueError::NotFound));
}

pub(crate) async fn a_repeated_key_finds_the_first_job_and_another_payload_is_refused(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let keyed = |of: &str, print: u8| Submission {
        idempotency: Some(Idempotency {
            key: "k".to_owned(),
            fingerprint: [print; 32],
        }),
        ..submission(of)
    };
    let first = submit(&queue, keyed("a", 1)).await;
    let again = queue.submit(keyed("a", 1)).await.expect("accepted");
    assert!(matches!(again, Submitted::Known(job) if job.id == first.id));
    let other = queue.submit(keyed("a", 2)).await;
    assert_eq!(other.err(), Some(QueueError::KeyReused(first.id)));
    submit(&queue, keyed("b", 2)).await;
    assert_eq!(queue.backlog().queued().jobs, 2);
}

pub(crate) async fn higher_priorities_go_first_and_equals_in_order(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let mut expected = Vec::new();
    for priority in [Priority::Low, Priority::Normal, Priority::High] {
        let mut jobs = Vec::new();
        for _ in 0..3 {
            let job = Submission {
                priority,
                ..submission("a")
            };
            jobs.push(submit(&queue, job).await.id);
        }
        jobs.append(&mut expected);
        expected = jobs;
    }
    for id in expected {
        assert_eq!(lease(&queue).await.job.id, id);
    }
}

pub(crate) async fn tenants_share_by_predicted_work(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    for _ in 0..60 {
        submit(&queue, submission("many")).await;
    }
    for _ in 0..5 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    for _ in 0..4 {
        let long = Submission {
            cost_seconds: 2.0,
            ..submission("few")
        };
        submit(&queue, long).await;
    }
    // Between two jobs of `few`, which are twice as long, run at most two of `many`.
    let mut others = 0;
    let mut few = 0;
    while few < 4 {
        let held = lease(&queue).await;
        if held.job.tenant == tenant("few") {
            few += 1;
            others = 0;
        } else {
            others += 1;
            assert!(others <= 2, "after {few} of the few");
        }
        finish(&queue, &held.job, done()).await;
    }
    assert_eq!(queue.backlog().queued_of(&tenant("few")).jobs, 0);
}

pub(crate) async fn a_cancelled_job_ends_at_once_or_through_its_worker(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let queued = submit(&queue, submission("a")).await;
    let ended = queue.cancel(queued.id).await.expect("known");
    assert_eq!(ended.state, State::Cancelled);
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);

    submit(&queue, submission("a")).await;
    let running = lease(&queue).await;
    let asked = queue.cancel(running.job.id).await.expect("known");
    assert!(asked.cancel_requested && asked.state == State::Running);
    assert_eq!(running.heartbeat.signal(), Signal::Cancel);
    // A result that arrives after the cancellation is discarded.
    let committed = finish(&queue, &running.job, done()).await;
    assert_eq!(committed, Committed::Yes(State::Cancelled));
    let again = queue.cancel(running.job.id).await.expect("known");
    assert_eq!(again.state, State::Cancelled);
    let unknown = queue.cancel(JobId::fresh()).await;
    assert_eq!(unknown, Err(QueueError::NotFound));
}

pub(crate) async fn a_sequence_ends_with_its_last_pair(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, sequence(3)).await;
    assert_eq!((job.pairs, job.pairs_left), (3, 3));
    assert_eq!(queue.backlog().queued().jobs, 3);
    for index in 0..3 {
        let held = lease(&queue).await;
        assert_eq!((held.job.parent, held.job.index), (Some(job.id), index));
        assert_eq!(state(&queue, &job).await, State::Running);
        finish(&queue, &held.job, done()).await;
    }
    let ended = reaches(&queue, &job, State::Succeeded).await;
    assert_eq!(ended.pairs_left, 0);
    let pairs = queue.pairs(job.id).await.expect("known");
    assert_eq!(pairs.len(), 3);
    let filter = Filter {
        tenant: tenant("a"),
        state: None,
        label: None,
        before: None,
        limit: 10,
    };
    assert_eq!(queue.list(filter).await.expect("a list").len(), 1);
}

pub(crate) async fn jobs_are_found_by_their_labels_until_they_are_removed(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let labelled = |of: &str, label: &str| Submission {
        labels: vec!["all=1".to_owned(), label.to_owned()],
        ..submission(of)
    };
    let first = submit(&queue, labelled("a", "drive=1")).await.id;
    let sequence = Submission {
        labels: vec!["drive=2".to_owned()],
        ..sequence(2)
    };
    submit(&queue, sequence).await;
    let second = submit(&queue, labelled("a", "drive=1")).await.id;
    submit(&queue, labelled("b", "drive=1")).await;
    let found = |label: &str, state, before| {
        let filter = Filter {
            tenant: tenant("a"),
            state,
            label: Some(label.to_owned()),
            before,
            limit: 10,
        };
        let queue = Arc::clone(&queue);
        async move {
            let jobs = queue.list(filter).await.expect("a list");
            jobs.iter().map(|job| job.id).collect::<Vec<_>>()
        }
    };
    assert_eq!(found("drive=1", None, None).await, [second, first]);
    assert_eq!(found("all=1", None, Some(second)).await, [first]);
    assert_eq!(found("drive=2", None, None).await.len(), 1);
    assert_eq!(found("drive", None, None).await, []);
    queue.cancel(first).await.expect("known");
    let cancelled = Some(State::Cancelled);
    assert_eq!(found("drive=1", cancelled, None).await, [first]);
    queue.remove(first).await.expect("it has ended");
    assert_eq!(found("drive=1", None, None).await, [second]);
}

pub(crate) async fn a_pair_says_which_sweeps_it_is_of_and_found_from(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let amid = PairOf {
        index: 2,
        window: [0, 5],
        ..PairOf::ALONE
    };
    let alone = Submission {
        pair: amid,
        ..submission("a")
    };
    submit(&queue, alone).await;
    let held = lease(&queue).await;
    assert_eq!((held.job.index, held.job.window), (2, [0, 5]));
    assert_eq!(held.job.sweeps(), (held.job.id, [2, 3]));
    let of_sequence = Submission {
        pairs: vec![PairOf {
            backward: true,
            ..amid
        }],
        ..sequence(0)
    };
    let job = submit(&queue, of_sequence).await;
    let held = lease(&queue).await;
    assert_eq!((held.job.index, held.job.window), (2, [0, 5]));
    assert_eq!(held.job.sweeps(), (job.id, [3, 2]));
}

pub(crate) async fn a_sequence_is_cancelled_with_its_pairs_and_can_be_asked_for_again(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, sequence(3)).await;
    let first = lease(&queue).await;
    finish(&queue, &first.job, done()).await;
    let second = lease(&queue).await;
    queue.cancel(job.id).await.expect("known");
    assert_eq!(second.heartbeat.signal(), Signal::Cancel);
    finish(&queue, &second.job, Outcome::Cancelled).await;
    reaches(&queue, &job, State::Cancelled).await;
    nothing_is_ready(&queue).await;

    let again = queue.requeue(job.id, false).await.expect("it has ended");
    assert_eq!((again.state, again.pairs_left), (State::Queued, 2));
    for _ in 0..2 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    reaches(&queue, &job, State::Succeeded).await;

    let broken = submit(&queue, sequence(2)).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, failure(false)).await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let ended = reaches(&queue, &broken, State::Failed).await;
    let error = ended.error.as_ref().expect("a reason");
    assert_eq!(error.message, "pair 0: it broke");
}

pub(crate) async fn a_sequence_that_is_asked_for_again_repeats_what_a_deadline_stopped_early(
    stand: &mut impl Stand,
) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, sequence(3)).await;
    for reason in ["deadline", "converged"] {
        let held = lease(&queue).await;
        let outcome = Outcome::Succeeded {
            stop_reason: Some(reason.to_owned()),
            report: "{}".to_owned(),
            progress: None,
        };
        finish(&queue, &held.job, outcome).await;
    }
    queue.cancel(job.id).await.expect("known");
    reaches(&queue, &job, State::Cancelled).await;

    let again = queue.requeue(job.id, false).await.expect("it has ended");
    assert_eq!(again.pairs_left, 2);
    for index in [0, 2] {
        let held = lease(&queue).await;
        assert_eq!(held.job.index, index);
        finish(&queue, &held.job, done()).await;
    }
    reaches(&queue, &job, State::Succeeded).await;
}

pub(crate) async fn followers_see_every_state(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let job = submit(&queue, submission("a")).await;
    let mut news = queue.watch(job.id).await.expect("known");
    assert_eq!(news.borrow_and_update().state, State::Queued);
    let held = lease(&queue).await;
    timeout(PATIENCE, news.changed())
        .await
        .expect("in time")
        .expect("followed");
    assert_eq!(news.borrow_and_update().state, State::Running);
    let progress = JobProgress {
        done: 7,
        total: 150,
        loss: 0.25,
    };
    held.heartbeat.beat(Some(progress));
    timeout(PATIENCE, news.changed())
        .await
        .expect("in time")
        .expect("followed");
    assert_eq!(news.borrow_and_update().progress, Some(progress));
    finish(&queue, &held.job, done()).await;
    timeout(PATIENCE, news.changed())
        .await
        .expect("in time")
        .expect("followed");
    assert_eq!(news.borrow_and_update().state, State::Succeeded);
}

pub(crate) async fn lists_are_latest_first_in_pages_and_of_one_tenant(stand: &mut impl Stand) {
    let (queue, _events) = stand.open(QueueOptions::default()).await;
    let mut ids = Vec::new();
    for _ in 0..5 {
        ids.push(submit(&queue, submission("a")).await.id);
        submit(&queue, submission("b")).await;
    }
    ids.reverse();
    let page = |state, before, limit| {
        let filter = Filter {
            tenant: tenant("a"),
            state,
            label: None,
            before,
            limit,
        };
        let queue = Arc::clone(&queue);
        async move {
            let jobs = queue.list(filter).await.expect("a list");
            jobs.iter().map(|job| job.id).collect::<Vec<_>>()
        }
    };
    assert_eq!(page(None, None, 3).await, ids[..3]);
    assert_eq!(page(None, Some(ids[2]), 3).await, ids[3..]);
    queue.cancel(ids[1]).await.expect("known");
    assert_eq!(page(Some(State::Cancelled), None, 9).await, [ids[1]]);
    assert_eq!(page(Some(State::Queued), None, 9).await.len(), 4);
}

pub(crate) async fn a_job_that_was_given_up_frees_its_key_at_once_and_is_promised_to_nobody(
    stand: &mut impl Stand,
) {
    let (queue, _) = stand.open(QueueOptions::default()).await;
    let with_key = || Submission {
        durable: false,
        idempotency: Some(Idempotency {
            key: "key".to_owned(),
            fingerprint: [7; 32],
        }),
        ..submission("a")
    };
    let first = submit(&queue, with_key()).await;
    let held = lease(&queue).await;
    // The worker has not observed the cancellation yet: the job is still running.
    queue.abandon(first.id).await.expect("known");
    assert_eq!(state(&queue, &first).await, State::Running);
    let promised = queue.make_durable(first.id).await;
    assert_eq!(promised.err(), Some(QueueError::GivenUp));
    let second = submit(&queue, with_key()).await;
    assert_ne!(second.id, first.id);
    assert_eq!(
        finish(&queue, &held.job, done()).await,
        Committed::Yes(State::Cancelled)
    );
    let promised = queue.make_durable(first.id).await;
    assert_eq!(promised.err(), Some(QueueError::GivenUp));
    match queue.submit(with_key()).await.expect("accepted") {
        Submitted::Known(job) => assert_eq!(job.id, second.id),
        Submitted::New(job) => panic!("{} is new", job.id),
    }
    let promised = queue
        .make_durable(second.id)
        .await
        .expect("nobody has given it up");
    assert!(promised.durable);
}

pub(crate) async fn a_job_whose_result_is_lost_can_be_asked_for_again(stand: &mut impl Stand) {
    let (queue, _) = stand.open(QueueOptions::default()).await;
    let job = submit(
        &queue,
        Submission {
            durable: false,
            ..submission("a")
        },
    )
    .await;
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let refused = queue.requeue(job.id, false).await;
    assert!(matches!(
        refused,
        Err(QueueError::NotTerminal(State::Succeeded))
    ));
    let again = queue.requeue(job.id, true).await.expect("it is lost");
    assert!(again.durable && again.state == State::Queued);
    let held = lease(&queue).await;
    assert_eq!((held.job.id, held.job.attempt), (job.id, 2));
    let done = finish(&queue, &held.job, done()).await;
    assert_eq!(done, Committed::Yes(State::Succeeded));
}

pub(crate) async fn a_probe_leaves_nothing(stand: &mut impl Stand) {
    let (queue, mut heard) = stand.open(QueueOptions::default()).await;
    queue.probe().await.expect("it can be written");
    nothing_is_ready(&queue).await;
    assert_eq!(queue.backlog().queued().jobs, 0);
    let listed = queue.list(Filter {
        tenant: Tenant::default(),
        state: None,
        label: None,
        before: None,
        limit: 10,
    });
    assert!(listed.await.expect("a list").is_empty());
    assert!(heard.try_recv().is_err());
}

pub(crate) async fn an_ended_job_is_removed_when_its_owner_asks_for_it(stand: &mut impl Stand) {
    let options = QueueOptions {
        answered_retention: Duration::from_millis(40),
        ..QueueOptions::default()
    };
    let (queue, mut events) = stand.open(options).await;
    assert_eq!(
        queue.remove(JobId::fresh()).await,
        Err(QueueError::NotFound)
    );

    let job = submit(&queue, submission("a")).await;
    let queued = queue.remove(job.id).await;
    assert_eq!(queued, Err(QueueError::NotEnded(State::Queued)));
    let held = lease(&queue).await;
    let running = queue.remove(job.id).await;
    assert_eq!(running, Err(QueueError::NotEnded(State::Running)));
    finish(&queue, &held.job, done()).await;
    queue.remove(job.id).await.expect("it has ended");
    let gone = queue.job(&job.tenant, job.id).await;
    assert_eq!(gone.map(drop), Err(QueueError::NotFound));
    assert_eq!(queue.remove(job.id).await, Err(QueueError::NotFound));

    let whole = submit(&queue, sequence(2)).await;
    let pairs = queue.pairs(whole.id).await.expect("known");
    for _ in 0..2 {
        let held = lease(&queue).await;
        finish(&queue, &held.job, done()).await;
    }
    let of_whole = queue.remove(pairs[0].id).await;
    assert_eq!(of_whole, Err(QueueError::PairOfSequence(whole.id)));
    queue.remove(whole.id).await.expect("it has ended");
    let mut expected = vec![job.id, pairs[0].id, pairs[1].id, whole.id];
    while let Some(next) = expected.first().copied() {
        if let Event::Deleted(id) = events.recv().await.expect("an event") {
            assert_eq!(id, next);
            expected.remove(0);
        }
    }

    // A job that another one follows is kept until that one has ended.
    let first = submit(&queue, submission("a")).await;
    let held = lease(&queue).await;
    let next = Submission {
        after: Some(first.id),
        ..submission("a")
    };
    submit(&queue, next).await;
    finish(&queue, &held.job, done()).await;
    queue.remove(first.id).await.expect("it has ended");
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert_eq!(state(&queue, &first).await, State::Succeeded);
    let held = lease(&queue).await;
    finish(&queue, &held.job, done()).await;
    let began = std::time::Instant::now();
    while queue.job(&first.tenant, first.id).await.is_ok() {
        assert!(began.elapsed() < PATIENCE, "it is kept for nobody");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert!(queue.is_empty().await.is_ok_and(|empty| !empty));
}
