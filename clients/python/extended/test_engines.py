"""Bulk labelling on real engines: Ray with two nodes, Spark, Slurm. `.ci/extended` runs this."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import PROGRAM, REPOSITORY

import fnsf
import fnsf.bulk

ROWS = 40


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    """A drive of a simulated street."""
    folder = tmp_path_factory.mktemp("drives") / "drive"
    folder.mkdir()
    street = fnsf.simulate(ROWS + 1, beams=32, azimuth_steps=1000)
    for index in range(ROWS + 1):
        fnsf.write(folder / f"{index:04}.pcd", street.sweep(index).points)
    return folder


def rows_of(sweeps):
    return [
        {"key": f"drive/{k:04}", "source": str(sweeps / f"{k:04}.pcd"), "target": str(sweeps / f"{k + 1:04}.pcd")}
        for k in range(ROWS)
    ]


def check_labels(folder):
    labels = sorted(folder.glob("drive/*.npz"))
    assert len(labels) == ROWS
    for path in labels:
        assert len(fnsf.read_flow(path)) > 1000
    assert not list(folder.rglob("*.part"))


def test_ray_labels_every_row_though_an_actor_dies_and_a_node_goes(sweeps, tmp_path):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address)
    try:
        pairs = ray.data.from_items(rows_of(sweeps)).repartition(ROWS // 2)
        output = tmp_path / "labels"
        report = fnsf.bulk.ray_label(pairs, str(output), concurrency=(1, 2), num_cpus=0.9, batch_size=2)
        reports = []
        running = threading.Thread(target=lambda: reports.extend(report.take_all()))
        running.start()

        def labels():
            return len(list(output.glob("drive/*.npz")))

        def wait_for(count):
            until = time.monotonic() + 120
            while labels() < count:
                assert time.monotonic() < until, f"{labels()} labels"
                time.sleep(0.05)

        wait_for(4)
        # Ray names the process of an actor of `map_batches` so.
        actors = subprocess.run(["pgrep", "-f", "^ray::MapWorker"], capture_output=True, text=True).stdout.split()
        assert actors
        os.kill(int(actors[0]), signal.SIGKILL)
        wait_for(min(labels() + 4, ROWS - 8))
        cluster.remove_node(second)
        running.join(300)
        assert not running.is_alive()
        assert sorted(row["key"] for row in reports) == sorted(row["key"] for row in rows_of(sweeps))
        # What a dead actor had labelled without reporting it was found by the next.
        assert {row["outcome"] for row in reports} <= {"labelled", "found", "raced"}
        check_labels(output)
    finally:
        ray.shutdown()
        cluster.shutdown()


def test_spark_labels_every_row(sweeps, tmp_path):
    pytest.importorskip("pyspark")
    from pyspark.sql import SparkSession

    if shutil.which("java") is None:
        pytest.fail("Spark needs Java")
    os.environ["PYSPARK_PYTHON"] = sys.executable
    session = SparkSession.builder.master("local[2]").appName("fnsf").config("spark.ui.enabled", "false").getOrCreate()
    try:
        pairs = session.createDataFrame(rows_of(sweeps)).repartition(4)
        output = tmp_path / "labels"
        report = fnsf.bulk.spark_label(pairs, str(output)).toPandas()
        assert sorted(report["key"]) == sorted(row["key"] for row in rows_of(sweeps))
        assert set(report["outcome"]) == {"labelled"}
        assert report["seconds"].dtype == np.float64 and report["points"].min() > 1000
        check_labels(output)
        again = fnsf.bulk.spark_label(pairs, str(output)).toPandas()
        assert set(again["outcome"]) == {"found"}
    finally:
        session.stop()


@pytest.fixture
def slurm(tmp_path):
    """A Slurm cluster of this machine alone."""
    if not all(shutil.which(name) for name in ("slurmctld", "slurmd", "munged")):
        pytest.skip("Slurm is not installed: apt-get install slurmctld slurmd slurm-client munge")
    host = socket.gethostname().split(".")[0]
    subprocess.run(["pkill", "munged"], check=False)
    Path("/run/munge").mkdir(exist_ok=True)
    subprocess.run(["munged", "--force"], check=True, capture_output=True)
    conf = tmp_path / "slurm.conf"
    conf.write_text(
        f"""
ClusterName=tests
SlurmctldHost={host}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
StateSaveLocation={tmp_path}/state
SlurmdSpoolDir={tmp_path}/spool
SlurmctldPidFile={tmp_path}/slurmctld.pid
SlurmdPidFile={tmp_path}/slurmd.pid
SlurmctldLogFile={tmp_path}/slurmctld.log
SlurmdLogFile={tmp_path}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
JobAcctGatherType=jobacct_gather/none
ReturnToService=2
KillWait=20
NodeName={host} CPUs={os.cpu_count()} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
    )
    (tmp_path / "state").mkdir()
    (tmp_path / "spool").mkdir()
    environment = {**os.environ, "SLURM_CONF": str(conf)}
    daemons = [
        subprocess.Popen(["slurmctld", "-D", "-f", str(conf)], env=environment, stderr=subprocess.DEVNULL),
        subprocess.Popen(["slurmd", "-D", "-f", str(conf)], env=environment, stderr=subprocess.DEVNULL),
    ]
    try:
        until = time.monotonic() + 60
        while "idle" not in subprocess.run(["sinfo", "-h"], env=environment, capture_output=True, text=True).stdout:
            assert time.monotonic() < until, (tmp_path / "slurmctld.log").read_text()[-2000:]
            time.sleep(0.5)
        yield environment
    finally:
        for daemon in daemons:
            daemon.terminate()
            daemon.wait()
        subprocess.run(["pkill", "munged"], check=False)


def test_a_slurm_array_labels_every_row_through_a_requeue(slurm, sweeps, tmp_path):
    output = tmp_path / "labels"
    environment = {
        **slurm,
        "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}",
        "MANIFEST": str(sweeps.parent),
        "OUTPUT": str(output),
        "FNSF_LABEL_OPTIONS": "--preset default",
    }
    script = REPOSITORY / "deploy/farm/slurm.sbatch"
    submit = ["sbatch", "--parsable", "--array=0-3", "--cpus-per-task=1", "--mem=0", "--time=5", f"--chdir={tmp_path}"]
    subprocess.run([*submit, script], env=environment, check=True, capture_output=True)
    until = time.monotonic() + 240

    def labels():
        return len(list(output.glob("drive/*.npz")))

    while labels() < 3:
        assert time.monotonic() < until
        time.sleep(0.02)
    # As when a node is taken away: the batch script gets SIGTERM, the program finishes its pair.
    running = ["squeue", "-h", "-t", "R", "-o", "%A"]
    task = subprocess.run(running, env=environment, check=True, capture_output=True, text=True).stdout.split()[0]
    # It asks again while the task is being requeued, so it is not waited for.
    cancel = subprocess.Popen(["scancel", "--batch", "--signal=TERM", task], env=environment)
    while "finished" not in "".join(path.read_text() for path in tmp_path.glob("slurm-*.out")):
        assert time.monotonic() < until
        time.sleep(0.05)
    cancel.kill()
    cancel.wait()
    while subprocess.run(["squeue", "-h"], env=environment, capture_output=True, text=True).stdout.strip():
        assert time.monotonic() < until, subprocess.run(["squeue"], env=environment, capture_output=True).stdout
        time.sleep(0.5)
    check_labels(output)
    said = "".join(path.read_text() for path in tmp_path.glob("slurm-*.out"))
    assert "the pair that is computed is finished" in said, said
    assert "were there before" in said, said
    end = [PROGRAM, "label", sweeps.parent, "-o", output, "--finalize"]
    subprocess.run(end, check=True)
    assert (output / "_SUCCESS").exists()
