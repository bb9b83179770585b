"""Scenes of OpenSceneFlow: from HDF5 to flow and back."""

import os
import subprocess

import numpy as np
import pytest

import fnsf

h5py = pytest.importorskip("h5py")
from fnsf.scene import main, write_flows  # noqa: E402

STAMPS = [str(1_700_000_000_000_000_000 + index * 100_000_000) for index in range(3)]


@pytest.fixture
def scene(street, tmp_path):
    """A street, as OpenSceneFlow's extraction writes its scenes."""
    path = tmp_path / "street.h5"
    with h5py.File(path, "w") as file:
        for index, stamp in enumerate(STAMPS):
            pair = street.pair(min(index, 1))
            points = pair.source if index < 2 else pair.target
            group = file.create_group(stamp)
            intensity = np.ones((len(points), 1), np.float32)
            group.create_dataset("lidar", data=np.hstack([points, intensity]))
            group.create_dataset("ground_mask", data=pair.masks[index == 2])
            group.create_dataset("pose", data=np.eye(4, dtype=np.float32))
            if index < 2:
                group.create_dataset("flow", data=pair.flow, compression="gzip")
                group.create_dataset("flow_is_valid", data=pair.valid)
                group.create_dataset("flow_category_indices", data=pair.foreground.astype(np.uint8))
    return path


def test_a_scene_is_unpacked_labelled_and_gets_its_flows(scene, program, tmp_path):
    def run(*arguments):
        done = subprocess.run([program, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "2 pairs with true flow and ground masks" in run("unpack", str(scene), "-o", "drives")
    with h5py.File(scene) as file:
        for index, stamp in enumerate(STAMPS):
            points = fnsf.read(tmp_path / f"drives/street/{stamp}.pcd")
            assert np.array_equal(points, file[stamp]["lidar"][:, :3])
            if index < 2:
                pair = fnsf.read_pair(tmp_path / f"drives/street/{stamp}.npz")
                assert np.array_equal(pair.flow, file[stamp]["flow"][:])
                assert np.array_equal(pair.valid, file[stamp]["flow_is_valid"][:])
                assert np.array_equal(pair.masks[0], file[stamp]["ground_mask"][:])
                assert pair.ego is not None
    run("label", "drives", "-o", "labels", "--preset", "default")
    main([str(scene), str(tmp_path / "labels/street")])
    # Once more, which replaces the first.
    assert write_flows(scene, tmp_path / "labels/street") == (2, 3)
    with h5py.File(scene) as file:
        assert "fnsf" not in file[STAMPS[2]]
        for stamp in STAMPS[:2]:
            flow = fnsf.read_flow(tmp_path / f"labels/street/{stamp}.npz")
            written = file[stamp]["fnsf"]
            assert written.dtype == np.float32 and np.isfinite(written[:]).all()
            assert np.array_equal(written[:][flow.valid], flow.flow[flow.valid])
            true = file[stamp]["flow"][:]
            error = np.linalg.norm(written[:] - true, axis=1)[file[stamp]["flow_is_valid"][:]]
            assert error.mean() < 0.05


def test_a_link_to_another_file_is_not_followed(scene, tmp_path):
    other = tmp_path / "other.h5"
    scene.rename(other)
    before = other.read_bytes()
    with h5py.File(scene, "w") as file:
        file[STAMPS[0]] = h5py.ExternalLink(str(other), STAMPS[0])
        file[STAMPS[1]] = h5py.SoftLink(f"/{STAMPS[0]}")
    np.savez(tmp_path / f"{STAMPS[0]}.npz", **label(other, STAMPS[0]))
    np.savez(tmp_path / f"{STAMPS[1]}.npz", **label(other, STAMPS[0]))
    with pytest.raises(fnsf.InputError, match="no flow of a sweep"):
        write_flows(scene, tmp_path)
    assert other.read_bytes() == before


def label(scene, stamp):
    """A flow of nothing for each point."""
    with h5py.File(scene) as file:
        count = len(file[stamp]["lidar"])
    return {"flow": np.zeros((count, 3), np.float32), "valid": np.ones(count, bool)}


def test_points_without_a_flow_move_with_the_ego_motion(scene, tmp_path):
    with h5py.File(scene) as file:
        points = file[STAMPS[0]]["lidar"][:, :3]
    valid = np.arange(len(points)) % 2 == 0
    ego = np.eye(4)
    ego[:3, 3] = [-1.0, 0.5, 0.0]
    np.savez(tmp_path / f"{STAMPS[0]}.npz", flow=np.zeros_like(points), valid=valid, ego=ego)
    assert write_flows(scene, tmp_path, name="other") == (1, 3)
    with h5py.File(scene) as file:
        rows = file[STAMPS[0]]["other"][:]
    assert np.array_equal(rows[valid], np.zeros_like(points[valid]))
    assert np.allclose(rows[~valid], [-1.0, 0.5, 0.0], atol=1e-6)
    np.savez(tmp_path / f"{STAMPS[0]}.npz", flow=np.zeros_like(points), valid=valid)
    write_flows(scene, tmp_path, name="other")
    with h5py.File(scene) as file:
        assert np.isnan(file[STAMPS[0]]["other"][:][~valid]).all()


def test_flows_of_other_sweeps_change_nothing(scene, tmp_path):
    before = scene.read_bytes()
    np.savez(tmp_path / f"{STAMPS[1]}.npz", flow=np.zeros((5, 3), np.float32), valid=np.ones(5, bool))
    with pytest.raises(fnsf.InputError, match="5 rows"):
        write_flows(scene, tmp_path)
    np.savez(tmp_path / f"{STAMPS[1]}.npz", **label(scene, STAMPS[1]))
    for name, said in [("flow", "of the data set itself"), ("", "no name"), ("a/b", "no name")]:
        with pytest.raises(fnsf.InputError, match=said):
            write_flows(scene, tmp_path, name=name)
    os.mkdir(tmp_path / "empty")
    with pytest.raises(fnsf.InputError, match="no flow of a sweep"):
        write_flows(scene, tmp_path / "empty")
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "none.h5"), str(tmp_path)])
    assert ended.value.code == 65
    assert scene.read_bytes() == before
