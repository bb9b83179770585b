"""Boxes of tracks, read by the code of labelling tools and data sets: Supervisely, Datumaro, which CVAT reads with,
and the devkit of nuScenes.

`check extended` runs this in an environment of its own, because these need an older numpy.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest


def test_supervisely_reads_the_episode(exported, tracks, states):
    import supervisely as sly

    folder, names = exported("supervisely")
    project = sly.PointcloudEpisodeProject(str(folder), sly.OpenMode.READ)
    (dataset,) = project.datasets
    assert [dataset.get_frame_idx(f"{name}.pcd") for name in names] == list(range(5))
    episode = dataset.get_ann(project.meta)
    assert len(episode.objects) == len(tracks)
    ids = {object.key(): track["id"] for object, track in zip(episode.objects, tracks, strict=True)}
    figures = [(figure, frame.index) for frame in episode.frames for figure in frame.figures]
    assert len(figures) == len(states)
    for figure, sweep in figures:
        state = states[ids[figure.parent_object.key()], sweep]
        cuboid = figure.geometry
        place = [cuboid.position.x, cuboid.position.y, cuboid.position.z]
        size = [cuboid.dimensions.x, cuboid.dimensions.y, cuboid.dimensions.z]
        np.testing.assert_allclose(place, state["center"], atol=2e-6)
        np.testing.assert_allclose(size, state["size"], atol=2e-6)
        assert cuboid.rotation.z == pytest.approx(state["yaw"], abs=2e-6)


def test_datumaro_reads_the_clouds_of_cvat(exported, states):
    # Modules that it loads late break the import of others.
    import datumaro

    folder, names = exported("cvat")
    read = datumaro.Dataset.import_from(str(folder), "sly_pointcloud")
    seen = 0
    for item in read:
        sweep = names.index(item.id)
        assert item.attributes["frame"] == sweep
        for cuboid in item.annotations:
            # Datumaro keeps two decimals.
            state = states[cuboid.attributes["track_id"], sweep]
            np.testing.assert_allclose(cuboid.position, state["center"], atol=6e-3)
            np.testing.assert_allclose(cuboid.scale, state["size"], atol=6e-3)
            assert cuboid.rotation[2] == pytest.approx(state["yaw"], abs=6e-3)
            seen += 1
    assert seen == len(states)


def test_datumaro_reads_the_tracklets_of_kitti(exported, drive, tracks, states):
    import datumaro

    folder, names = exported("kitti-tracklets")
    clouds = folder / "velodyne_points/data"
    clouds.mkdir(parents=True)
    for index, name in enumerate(names):
        shutil.copy(drive / f"{name}.pcd", clouds / f"{index:010}.pcd")
    read = datumaro.Dataset.import_from(str(folder), "kitti_raw")
    order = [track["id"] for track in tracks]
    seen = 0
    for item in read:
        for cuboid in item.annotations:
            state = states[order[cuboid.attributes["track_id"] - 1], item.attributes["frame"]]
            # What it takes for the center is the middle of the lower face, as in the data set.
            lower = np.subtract(state["center"], [0, 0, state["size"][2] / 2])
            np.testing.assert_allclose(cuboid.position, lower, atol=6e-3)
            length, width, height = state["size"]
            np.testing.assert_allclose(cuboid.scale, [height, width, length], atol=6e-3)
            assert cuboid.rotation[2] == pytest.approx(state["yaw"], abs=6e-3)
            assert cuboid.attributes["occluded"] is False
            seen += 1
    assert seen == len(states)


def test_the_devkit_of_nuscenes_reads_the_results_of_its_tracking_task(exported, drive, states, tmp_path):
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.loaders import load_prediction
    from nuscenes.eval.tracking.data_classes import TrackingBox

    names = [sweep.stem for sweep in sorted(drive.glob("3*.pcd"))]
    place = {"translation": [100, 0, 2], "rotation": [1, 0, 0, 0]}
    tables = {
        "sensor": [{"token": "l", "channel": "LIDAR_TOP"}],
        "calibrated_sensor": [{"token": "c", "sensor_token": "l", **place}],
        "ego_pose": [{"token": "p", **place}],
        "sample": [{"token": f"s{index}", "scene_token": "z"} for index in range(5)],
        "scene": [{"token": "z", "name": "scene-0061"}],
        "sample_data": [
            {
                "token": f"d{index}",
                "sample_token": f"s{index}",
                "ego_pose_token": "p",
                "calibrated_sensor_token": "c",
                "filename": f"sweeps/LIDAR_TOP/{name}.pcd",
                "timestamp": index * 50_000,
                "is_key_frame": True,
            }
            for index, name in enumerate(names)
        ],
    }
    for name, rows in tables.items():
        Path(tmp_path, f"{name}.json").write_text(json.dumps(rows))
    folder, _ = exported("nuscenes-tracking", "car", ["--tables", tmp_path])
    # The classes of the task are known when its configuration has been read.
    config_factory("tracking_nips_2019")
    boxes, meta = load_prediction(str(folder / "tracking.json"), 500, TrackingBox)
    assert meta["use_lidar"] is True
    seen = 0
    for index in range(5):
        for box in boxes[f"s{index}"]:
            state = states[int(box.tracking_id), index]
            np.testing.assert_allclose(box.translation, np.add(state["center"], [200, 0, 4]), atol=1e-5)
            length, width, height = state["size"]
            np.testing.assert_allclose(box.size, [width, length, height], atol=1e-5)
            np.testing.assert_allclose(box.velocity, state["velocity"][:2], atol=1e-5)
            assert 2 * np.arctan2(box.rotation[3], box.rotation[0]) == pytest.approx(state["yaw"], abs=1e-5)
            seen += 1
    assert seen == len(states)
