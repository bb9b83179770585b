"""The client against a server over real sockets."""

import pickle
import threading
import time
from datetime import datetime, timezone

import numpy as np
import pytest

import fnsf

grpc = pytest.importorskip("grpc")
from fnsf.client import NamedSweep, ServerError  # noqa: E402


def test_the_flow_of_a_server_has_the_bits_of_the_library(server, pair):
    told = []
    with server.client() as client:
        theirs = client.flow(pair.source, pair.target, ground=pair.masks, progress=lambda *step: told.append(step))
    ours = fnsf.flow(pair.source, pair.target, ground=pair.masks)
    for name in ["flow", "valid", "dynamic", "cluster", "confidence", "moving", "clusters"]:
        assert np.array_equal(getattr(theirs, name), getattr(ours, name)), name
    # These went through JSON.
    assert np.allclose(theirs.ego, ours.ego, rtol=1e-12, atol=1e-14)
    assert np.allclose(theirs.ego_covariance, ours.ego_covariance, rtol=1e-12, atol=0)
    assert theirs.stop_reason == ours.stop_reason and theirs.report["points"] == len(pair.source)
    report, same = theirs.report, ["objects", "overlap", "warnings", "dt_s", "valid_points"]
    assert [report.get(key) == ours.report.get(key) for key in same] == [True] * len(same), report
    for key in ["ego_motion", "ego_covariance"]:
        assert np.allclose(report[key], ours.report[key], rtol=1e-12, atol=1e-14), key
    theirs.save(server.folder / "flow.ply")
    with server.client() as client:
        theirs = client.flow(
            pair.source, pair.target, preset="paper", ground=pair.masks, field={"max_iterations": 5}, deadline=60
        )
    assert not theirs.valid[pair.masks[0]].any() and theirs.valid[~pair.masks[0]].all()


def test_what_the_library_refuses_does_not_reach_a_server(server, pair):
    broken = pair.masks[0].astype(float)
    broken[7] = np.nan
    with server.client() as client:
        for masks in [([], pair.masks[1]), (pair.masks[0][:-1], pair.masks[1]), (broken, pair.masks[1])]:
            with pytest.raises(fnsf.InputError, match="ground mask of pc1"):
                client.flow(pair.source, pair.target, ground=masks)
        with pytest.raises(fnsf.InputError, match="deadline is 0"):
            client.flow(pair.source, pair.target, deadline=0)
        with pytest.raises(fnsf.InputError, match="sweep 1 has 2 rows"):
            client.submit([pair.source, NamedSweep(pair.target, ground=[True, False])])


def test_refusals_have_the_code_of_the_server(server, pair):
    with server.client(api_key="another key, of no tenant") as client, pytest.raises(ServerError) as refused:
        client.flow(pair.source, pair.target)
    assert (refused.value.code, refused.value.status) == ("unauthenticated", "UNAUTHENTICATED")
    with server.client() as client:
        with pytest.raises(ServerError) as refused:
            client.flow(pair.source, 1000 * pair.target)
        assert refused.value.code == "bad_input" and "millimetres" in str(refused.value)
        with pytest.raises(ServerError) as refused:
            client.job("00000000-0000-7000-8000-000000000000")
        assert refused.value.status == "NOT_FOUND"
        with pytest.raises(TypeError, match="no option 'sead'"):
            client.flow(pair.source, pair.target, sead=1)
        with pytest.raises(fnsf.InputError, match="options"):
            client.flow(pair.source, pair.target, preset="best")
    with fnsf.Client("127.0.0.1:1") as client, pytest.raises(ServerError) as refused:
        client.flow(pair.source, pair.target)
    assert refused.value.code is None and refused.value.status == "UNAVAILABLE"


def test_a_refusal_goes_from_one_process_to_another():
    refused = pickle.loads(pickle.dumps(ServerError("server_full", "UNAVAILABLE", "full", 2.0)))
    assert (refused.code, refused.status, refused.retry_after) == ("server_full", "UNAVAILABLE", 2.0)
    assert str(refused) == "server_full [UNAVAILABLE]: full (try again in 2 s)"


def test_a_deadline_of_the_call_gives_the_best_flow_so_far(server, pair):
    with server.client() as client:
        flow = client.flow(pair.source, pair.target, preset="paper", deadline=3.0)
    assert flow.stop_reason == "deadline" and flow.valid.any()


def test_a_sequence_comes_pair_by_pair(server, street):
    def sweeps():
        for index in range(len(street)):
            yield NamedSweep(street.sweep(index).points, name=f"{index}.pcd", pose=street.pose(index))

    with server.client() as client:
        pairs = list(client.sequence(sweeps(), preset="default"))
    assert [(pair.index, pair.source, pair.target) for pair in pairs] == [
        (index, f"{index}.pcd", f"{index + 1}.pcd") for index in range(len(street) - 1)
    ]
    for pair in pairs:
        assert pair.error is None
        truth = street.pair(pair.index)
        assert np.abs(pair.flow.ego - truth.ego).max() < 1e-6
        assert np.array_equal(pair.flow.source, truth.source)


def test_flows_come_while_sweeps_are_sent(server, street):
    sent, came = [], []

    def sweeps():
        for index in range(4):
            sent.append(index)
            yield street.sweep(index).points
            time.sleep(1.0)

    with server.client() as client:
        for _ in client.sequence(sweeps(), preset="default"):
            came.append(len(sent))
    assert len(came) == 3
    assert came[0] < 4


def test_an_error_of_the_sweeps_ends_the_call_with_that_error(server, street):
    def sweeps():
        yield street.sweep(0).points
        raise ZeroDivisionError("the disk is broken")

    with server.client() as client, pytest.raises(ZeroDivisionError, match="the disk is broken"):
        list(client.sequence(sweeps()))


def test_jobs_are_submitted_found_and_removed(server, pair, street):
    with server.client() as client:
        job = client.submit([pair.source, pair.target], labels={"drive": "7"}, preset="default")
        assert job.kind == "pair" and job.labels == {"drive": "7"}
        ended = client.wait(job.id, timeout=60)
        assert ended.state == "succeeded" and ended.ended and ended.stop_reason == "completed"
        assert ended.created_at <= ended.started_at <= ended.finished_at
        assert abs((datetime.now(timezone.utc) - ended.created_at).total_seconds()) < 60
        assert np.array_equal(client.result(job.id).flow, fnsf.flow(pair.source, pair.target).flow)
        assert [found.id for found in client.jobs(label="drive=7")] == [job.id]
        assert list(client.jobs(state="failed")) == []
        assert [found.state for found in client.watch(job.id)][-1] == "succeeded"
        client.delete(job.id)
        with pytest.raises(ServerError):
            client.job(job.id)

        named = [NamedSweep(points, name=name) for points, name in [(pair.source, "0.10"), (pair.target, "0.20")]]
        with pytest.raises(ServerError, match="against the order"):
            client.submit([*named, NamedSweep(pair.source, name="0.15")])

        sweeps = [street.sweep(index).points for index in range(len(street))]
        densify = {"reference_time": 1, "later_sweeps": "inverse"}
        sequence = client.submit(sweeps, preset="default", densify=densify)
        done = client.wait(sequence.id, timeout=120)
        assert done.state == "succeeded", done
        assert len(client.job(sequence.id).pair_ids) == len(sweeps) - 1
        assert len(client.result(sequence.id)) == sum(map(len, sweeps))
        assert len(client.tracks(sequence.id)) > 0


def test_a_job_is_cancelled_and_queued_again(server, pair):
    with server.client() as client:
        job = client.submit(
            [pair.source, pair.target], preset="paper", field={"max_iterations": 100_000, "patience": 100_000}
        )
        assert client.cancel(job.id).id == job.id
        assert client.wait(job.id, timeout=20).state == "cancelled"
        with pytest.raises(ServerError) as refused:
            client.result(job.id)
        assert (refused.value.code, refused.value.status) == ("cancelled", "CANCELLED")
        assert client.requeue(job.id).state == "queued"
        client.cancel(job.id)
        long = {"max_iterations": 100_000, "patience": 100_000}
        waiting = client.submit([pair.source, pair.target], preset="paper", field=long)
        with pytest.raises(TimeoutError):
            client.wait(waiting.id, timeout=0.5)
        behind = [client.submit([pair.source, pair.target], preset="paper", field=long) for _ in range(20)]
        last = client.job(behind[-1].id)
        assert last.state == "queued" and last.ahead is not None and last.ahead > 0 and last.starts_in > 0
        for job in [waiting, *behind]:
            client.cancel(job.id)


def test_places_are_named_that_the_server_may_refuse(server, pair):
    with server.client() as client:
        with pytest.raises(ServerError, match=r"remote\.sweeps") as refused:
            client.submit(["s3://bucket/a.pcd", pair.target])
        assert refused.value.code == "bad_request"
        with pytest.raises(ServerError, match=r"remote\.results") as refused:
            client.submit([pair.source, pair.target], result_uri="s3://bucket/flow.npz")
        assert refused.value.code == "invalid_options"


def test_a_submission_and_a_wait_live_through_a_killed_server(server, pair):
    with server.client() as client:
        job = client.submit(
            [pair.source, pair.target], preset="paper", max_points=3000, idempotency_key="a key of the test"
        )
        ends = []
        waiting = threading.Thread(target=lambda: ends.append(client.wait(job.id, timeout=120)))
        waiting.start()
        time.sleep(0.3)
        server.kill()
        again = []
        submitting = threading.Thread(
            target=lambda: again.append(
                client.submit(
                    [pair.source, pair.target], preset="paper", max_points=3000, idempotency_key="a key of the test"
                )
            )
        )
        submitting.start()
        time.sleep(1.0)
        server.start()
        submitting.join(60)
        waiting.join(120)
        assert again[0].id == job.id
        assert ends[0].state == "succeeded"
        assert len(list(client.jobs())) == 1
