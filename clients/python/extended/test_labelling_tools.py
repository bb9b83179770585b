"""Boxes of tracks, read by the code of labelling tools: Supervisely, and Datumaro, which CVAT reads with.

`check extended` runs this in an environment of its own, because these need an older numpy.
"""

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
