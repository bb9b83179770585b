"""Files in every format, and the tools beside the estimates."""

import json
import os
import stat
import subprocess

import numpy as np
import pytest

import fnsf


@pytest.mark.parametrize("ending", ["npy", "ply", "pcd", "feather", "bin"])
def test_a_sweep_comes_back_from_every_format(pair, tmp_path, ending):
    path = tmp_path / f"sweep.{ending}"
    fnsf.write(path, pair.source)
    assert np.array_equal(fnsf.read(path), pair.source)
    assert fnsf.read_sweep(str(path)).times is None
    assert stat.S_IMODE(path.stat().st_mode) == 0o644 or os.umask(os.umask(0o22)) != 0o22
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("ending", ["npz", "npy", "feather", "ply", "pcd", "json"])
def test_a_flow_comes_back_from_every_format(pair, tmp_path, ending):
    flow = fnsf.flow(pair.source, pair.target)
    flow.save(tmp_path / f"flow.{ending}")
    again = fnsf.read_flow(tmp_path / f"flow.{ending}")
    assert np.array_equal(again.flow, flow.flow)
    if ending != "npy":
        for name in ["valid", "dynamic", "cluster", "confidence", "moving"]:
            assert np.array_equal(getattr(again, name), getattr(flow, name)), name
    if ending in ("npz", "json"):
        assert np.array_equal(again.clusters, flow.clusters)
        assert np.allclose(again.ego, flow.ego, atol=1e-12)
    with pytest.raises(fnsf.Error, match="no motion field"):
        again(pair.source)


@pytest.mark.parametrize("ending", ["feather", "ply", "pcd"])
def test_a_flow_without_clusters_or_points_is_written_as_far_as_a_format_goes(pair, tmp_path, ending):
    flow = fnsf.flow(pair.source, pair.target)
    flow.save(tmp_path / f"flow.{ending}")
    read = fnsf.read_flow(tmp_path / f"flow.{ending}")
    assert read.clusters is None and read.source is None
    for other in ["npz", "json"]:
        read.save(tmp_path / f"again.{other}")
        again = fnsf.read_flow(tmp_path / f"again.{other}")
        assert np.array_equal(again.flow, flow.flow) and np.array_equal(again.confidence, flow.confidence)
        assert (again.cluster == -1).all()
    read.save(tmp_path / "again.feather")
    assert np.array_equal(fnsf.read_flow(tmp_path / "again.feather").cluster, flow.cluster)
    for other in ["ply", "pcd"]:
        with pytest.raises(fnsf.Error, match="no source points"):
            read.save(tmp_path / f"none.{other}")
        assert not (tmp_path / f"none.{other}").exists()


def test_a_picture_is_that_of_the_command_line(program, pair, tmp_path):
    np.savez(tmp_path / "pair.npz", pc1=pair.source, pc2=pair.target)
    command = [program, "flow", tmp_path / "pair.npz", "--picture", tmp_path / "theirs.png"]
    subprocess.run(command, check=True, capture_output=True)
    flow = fnsf.flow(pair.source, pair.target)
    flow.picture(tmp_path / "ours.png")
    assert (tmp_path / "ours.png").read_bytes() == (tmp_path / "theirs.png").read_bytes()
    flow.save(tmp_path / "flow.npz")
    with pytest.raises(fnsf.Error, match="no source points"):
        fnsf.read_flow(tmp_path / "flow.npz").picture(tmp_path / "none.png")


def test_files_that_are_none_are_refused_by_name(tmp_path):
    (tmp_path / "x.pcd").write_bytes(b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nPOINTS 9999999999999\nDATA binary\n")
    (tmp_path / "y.bin").write_bytes(b"")
    for name in ["x.pcd", "y.bin"]:
        with pytest.raises(fnsf.InputError, match=name):
            fnsf.read(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        fnsf.read(tmp_path / "none.pcd")
    with pytest.raises(fnsf.InputError, match=r"\.npy, \.ply"):
        fnsf.write(tmp_path / "x.obj", np.zeros((3, 3)))
    with pytest.raises(FileNotFoundError):
        fnsf.write(tmp_path / "no folder" / "x.npy", np.zeros((3, 3)))


def test_an_interrupted_write_leaves_the_file_before(tmp_path, monkeypatch):
    path = tmp_path / "x.npy"
    fnsf.write(path, np.zeros((3, 3)))
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        fnsf.write(path, np.ones((3, 3)))
    assert not fnsf.read(path).any() and os.listdir(tmp_path) == ["x.npy"]


def test_times_of_points_are_read(tmp_path):
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    rows = "\n".join(f"{k} 0 0 {k / 1000}" for k in range(100))
    (tmp_path / "t.pcd").write_text(f"{header}WIDTH 100\nHEIGHT 1\nPOINTS 100\nDATA ascii\n{rows}\n")
    sweep = fnsf.read_sweep(tmp_path / "t.pcd")
    assert len(sweep) == 100
    assert np.allclose(sweep.times, np.arange(100) / 1000)


def test_scores_are_those_of_the_command_line(program, pair, tmp_path):
    flow = fnsf.flow(pair.source, pair.target)
    flow.save(tmp_path / "flow.npz")
    arrays = {"pc1": pair.source, "pc2": pair.target, "flow": pair.flow, "valid": pair.valid, "dynamic": pair.dynamic}
    arrays |= {
        "ground1": pair.masks[0],
        "ground2": pair.masks[1],
        "ego_SE3": pair.ego,
        "classes": pair.foreground.astype(np.int32),
    }
    np.savez(tmp_path / "pair.npz", **arrays)
    command = [program, "eval", tmp_path / "flow.npz", "--truth", tmp_path / "pair.npz", "--json"]
    theirs = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    assert fnsf.evaluate(flow, fnsf.read_pair(tmp_path / "pair.npz")) == theirs
    assert fnsf.evaluate(pair.flow, pair)["epe"] == 0
    with pytest.raises(fnsf.InputError, match="no true flow"):
        fnsf.evaluate(flow, fnsf.Pair(pair.source, pair.target))


def test_ground_and_registration(pair):
    found = fnsf.ground(pair.source)
    assert (found == pair.masks[0]).mean() > 0.97
    motion, covariance = fnsf.register(pair.source, pair.target)
    assert np.abs(motion - pair.ego).max() < 0.01
    assert covariance.shape == (6, 6) and np.array_equal(covariance, covariance.T)
    again = fnsf.register(pair.source, pair.target, prior=pair.ego).motion
    assert np.abs(again - pair.ego).max() < 0.01


def test_a_street_is_the_same_each_time():
    one, other = (fnsf.simulate(3, seed=5, beams=16, azimuth_steps=200, rolling=True) for _ in range(2))
    assert len(one) == 3
    assert np.array_equal(one.sweep(2).points, other.sweep(2).points)
    assert np.ptp(one.sweep(2).times) > 0.05
    assert len(one.tracks()) > 0
    with pytest.raises(fnsf.InputError, match="sweeps"):
        fnsf.simulate(0)
    with pytest.raises(fnsf.InputError):
        one.sweep(3)
