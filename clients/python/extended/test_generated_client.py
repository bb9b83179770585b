"""A client that openapi-python-client generates from the server's own document gets flows."""

import importlib
import io
import json
import re
import subprocess
import sys
import urllib.request
import zipfile

import numpy as np
import pytest
from conftest import PROGRAM


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("server")
    ports = ["--listen", "127.0.0.1:0", "--admin-listen", "127.0.0.1:0"]
    command = [PROGRAM, "serve", "--data-dir", folder, *ports]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    address = re.search(r"127\.0\.0\.1:\d+", process.stdout.readline()).group()
    yield f"http://{address}"
    process.kill()
    process.wait()


@pytest.fixture(scope="module")
def generated(server, tmp_path_factory):
    folder = tmp_path_factory.mktemp("generated")
    with urllib.request.urlopen(f"{server}/openapi.json") as answer:
        (folder / "openapi.json").write_bytes(answer.read())
    # The generator does not know the type of a PCD.
    (folder / "config.yaml").write_text("content_type_overrides:\n  application/x-pcd: application/octet-stream\n")
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--path", "openapi.json", "--meta", "none"]
    command += ["--config", "config.yaml"]
    # A warning is a piece that is missing.
    done = subprocess.run([*command, "--fail-on-warning"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    sys.path.insert(0, str(folder))
    yield lambda name: importlib.import_module(f"fnsf_client.{name}")
    sys.path.remove(str(folder))


def files(generated, drive):
    file = generated("types").File
    sweeps = sorted(drive.glob("3*.pcd"))
    return [file(io.BytesIO(sweep.read_bytes()), sweep.name, "application/octet-stream") for sweep in sweeps]


def test_a_pair_gets_its_flow_on_one_call(server, generated, drive):
    client = generated("client").Client(server)
    models = generated("models")
    source, target, *_ = files(generated, drive)
    options = models.JobOptions(preset=models.PresetChoice("default"), seed=3)
    body = models.PairBody(source=source, target=target, options=options)
    answer = generated("api.flow.estimate").sync_detailed(client=client, body=body)
    assert answer.status_code == 200 and answer.headers["fnsf-stop-reason"] == "completed"
    flow = np.load(answer.parsed.payload)
    assert flow["flow"].shape[1] == 3 and flow["valid"].any() and len(flow["clusters_points"]) > 0


def test_a_sequence_is_submitted_followed_and_fetched(server, generated, drive):
    client = generated("client").Client(server)
    models, jobs = generated("models"), "api.jobs"
    options = models.JobOptions(preset=models.PresetChoice("default"), labels=models.Labels.from_dict({"drive": "7"}))
    body = models.SequenceBody(options=options, sweep=files(generated, drive))
    job = generated(f"{jobs}.submit_sequence").sync(client=client, body=body)
    assert isinstance(job, models.JobView)
    for _ in range(10):
        if job.state not in (models.State.QUEUED, models.State.RUNNING):
            break
        job = generated(f"{jobs}.get_job").sync(job.id, client=client, wait=20)
    assert job.state == models.State.SUCCEEDED
    result = generated(f"{jobs}.result").sync(job.id, client=client)
    assert len(zipfile.ZipFile(result.payload).namelist()) == 4
    listed = generated(f"{jobs}.list_jobs").sync(client=client)
    assert job.id in [found.id for found in listed.jobs]


def test_a_refusal_says_why(server, generated):
    client = generated("client").Client(server)
    models = generated("models")
    file = generated("types").File(io.BytesIO(b"no cloud"), "a.pcd", "application/octet-stream")
    body = models.PairBody(source=file, target=file)
    refused = generated("api.flow.estimate").sync(client=client, body=body)
    assert isinstance(refused, models.Problem) and "unrecognized" in json.dumps(refused.to_dict())
