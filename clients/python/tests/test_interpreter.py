"""The interpreter beside an estimate: its lock, signals, forks, threads and processes."""

import multiprocessing
import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest

import fnsf


def test_other_threads_run_during_an_estimate(pair):
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.monotonic())
            time.sleep(0.01)

    clock = threading.Thread(target=tick)
    clock.start()
    fnsf.flow(pair.source, pair.target, preset="paper", device="cpu", deadline=1.0)
    done.set()
    clock.join()
    assert len(ticks) > 30
    assert max(np.diff(ticks)) < 0.3


def test_two_threads_estimate_at_once(pair):
    wanted = fnsf.flow(pair.source, pair.target)
    with ThreadPoolExecutor(4) as pool:
        flows = list(pool.map(lambda _: fnsf.flow(pair.source, pair.target), range(8)))
    assert all(np.array_equal(flow.flow, wanted.flow) for flow in flows)


def test_ctrl_c_ends_an_estimate(python):
    said = python(
        """
import os, signal, threading, time, fnsf
pair = fnsf.simulate(beams=32).pair(0)
threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
began = time.monotonic()
try:
    long = {"max_iterations": 100000, "patience": 100000}
    fnsf.flow(pair.source, pair.target, preset="paper", device="cpu", field=long)
    print("not interrupted")
except KeyboardInterrupt:
    print("interrupted", time.monotonic() - began < 3)
# The device is usable after it.
print(fnsf.flow(pair.source, pair.target).valid.all())
"""
    )
    assert said.split() == ["interrupted", "True", "True"]


def test_every_thread_belongs_to_a_device(python):
    # A child of a fork has none of its parent's threads: it could wait for a global one for ever.
    said = python(
        """
import os, numpy as np, fnsf
def others():
    names = [open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")]
    return sum(not name.startswith("fnsf") for name in names)
before = others()
street = fnsf.simulate(3, beams=16, azimuth_steps=500)
pair = street.pair(0)
flow = fnsf.flow(pair.source, pair.target)
flow(pair.source)
for preset in ["neural", "nsfp-kdtree", "fnsf-linear", "nsfp++"]:
    short = {"max_iterations": 3}
    fitted = fnsf.flow(pair.source, pair.target, preset=preset, max_points=300, field=short, device="cpu")
    fitted(pair.source)
times = np.zeros(len(pair.source)), np.zeros(len(pair.target))
fnsf.flow(pair.source, pair.target, times=times)
sequence = fnsf.Sequence(track=True)
for index in range(3):
    sequence.push(street.sweep(index).points)
sequence.finish()
fnsf.densify([street.sweep(index).points for index in range(3)], 1.5)
fnsf.ground(pair.source), fnsf.register(pair.source, pair.target), fnsf.evaluate(flow, pair), street.tracks()
print(others() - before)
"""
    )
    assert said.strip() == "0"


def test_a_child_that_is_forked_after_use_estimates(python):
    said = python(
        """
import os, sys, warnings, numpy as np, fnsf
warnings.simplefilter("ignore", DeprecationWarning)
pair = fnsf.simulate(beams=16, azimuth_steps=500).pair(0)
wanted = fnsf.flow(pair.source, pair.target)
for _ in range(3):
    child = os.fork()
    if child == 0:
        flow = fnsf.flow(pair.source, pair.target)
        moved = wanted(pair.source)
        os._exit(0 if np.array_equal(flow.flow, wanted.flow) and len(moved) else 1)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(np.array_equal(fnsf.flow(pair.source, pair.target).flow, wanted.flow))
"""
    )
    assert said.split() == ["0", "0", "0", "True"]


def test_a_sequence_that_was_begun_before_a_fork_says_so_in_the_child(python):
    said = python(
        """
import os, warnings, fnsf
warnings.simplefilter("ignore", DeprecationWarning)
street = fnsf.simulate(beams=16, azimuth_steps=500)
sequence = fnsf.Sequence(preset="default")
sequence.push(street.sweep(0).points)
child = os.fork()
if child == 0:
    try:
        sequence.push(street.sweep(1).points)
    except fnsf.Error as error:
        os._exit(0 if "before a fork" in str(error) else 2)
    os._exit(1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), len(sequence.push(street.sweep(1).points)))
"""
    )
    assert said.split() == ["0", "1"]


def test_a_child_forked_after_use_of_a_gpu_says_that_it_cannot(python):
    said = python(
        """
import os, warnings, fnsf
warnings.simplefilter("ignore")
os.environ["FNSF_ALLOW_SOFTWARE_GPU"] = "1"
try:
    fnsf.device_name("gpu")
except fnsf.DeviceError:
    print("no GPU")
    raise SystemExit
child = os.fork()
if child == 0:
    try:
        fnsf.device_name("gpu")
    except fnsf.DeviceError as error:
        os._exit(0 if "start workers by spawn" in str(error) else 2)
    os._exit(1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    )
    if said.strip() == "no GPU":
        if os.environ.get("FNSF_REQUIRE_GPU") == "1":
            pytest.fail("FNSF_REQUIRE_GPU is set and there is no GPU")
        pytest.skip("no GPU and no driver that computes on the CPU")
    assert said.strip() == "0"


def estimate(seed):
    pair = fnsf.simulate(seed=seed, beams=16, azimuth_steps=500).pair(0)
    return fnsf.flow(pair.source, pair.target)


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_pools_of_processes_estimate(method):
    wanted = estimate(1)
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        flows = list(pool.map(estimate, [1, 2, 1, 2], timeout=100))
    assert np.array_equal(flows[0].flow, wanted.flow) and np.array_equal(flows[2].flow, wanted.flow)
    assert np.array_equal(flows[1].flow, flows[3].flow)


def test_a_sequence_is_pushed_by_one_thread_at_a_time(street):
    sequence = fnsf.Sequence(preset="paper", device="cpu")
    sequence.push(street.sweep(0).points)
    other = threading.Thread(target=lambda: sequence.push(street.sweep(1).points, deadline=2.0))
    other.start()
    time.sleep(0.5)
    with pytest.raises(fnsf.Error, match="another thread uses this sequence"):
        sequence.push(street.sweep(1).points)
    other.join()


def test_memory_does_not_grow_with_calls(python):
    said = python(
        """
import fnsf
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096
pair = fnsf.simulate(beams=32, azimuth_steps=1000).pair(0)
for _ in range(10):
    fnsf.flow(pair.source, pair.target)
before = resident()
for _ in range(60):
    fnsf.flow(pair.source, pair.target)
print((resident() - before) / 60 / pair.source.nbytes)
"""
    )
    # A leak of one array a call would be 1.
    assert float(said) < 0.3


def test_tensors_and_loaders_of_torch():
    # torch is not installed by the package's check: FNSF_REQUIRE_TORCH=1 makes its absence a failure.
    if os.environ.get("FNSF_REQUIRE_TORCH") != "1":
        pytest.importorskip("torch")
    import torch

    pair = fnsf.simulate(beams=16, azimuth_steps=500).pair(0)
    wanted = fnsf.flow(pair.source, pair.target)
    given = torch.from_numpy(pair.source), torch.from_numpy(pair.target)
    assert np.array_equal(fnsf.flow(*given).flow, wanted.flow)
    assert torch.from_dlpack(wanted.flow).shape == wanted.flow.shape
    with pytest.raises(fnsf.InputError, match="detach"):
        fnsf.flow(given[0].requires_grad_(), given[1])

    class Pairs(torch.utils.data.Dataset):
        def __len__(self):
            return 4

        def __getitem__(self, seed):
            return estimate(seed % 2).flow

    loader = torch.utils.data.DataLoader(Pairs(), batch_size=None, num_workers=2)
    flows = [np.asarray(flow) for flow in loader]
    assert np.array_equal(flows[0], flows[2]) and np.array_equal(flows[1], flows[3])
