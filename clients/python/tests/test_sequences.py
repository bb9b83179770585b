"""Sequences, tracks and dense clouds."""

import json
import subprocess

import numpy as np
import pytest

import fnsf


@pytest.fixture(scope="module")
def files(street, tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    paths = [folder / f"{index:06}.pcd" for index in range(len(street))]
    for index, path in enumerate(paths):
        fnsf.write(path, street.sweep(index).points)
    return paths


def test_a_sequence_has_the_bits_and_the_tracks_of_the_command_line(program, street, files, tmp_path):
    command = [program, "flow", *files, "--preset", "label", "--dt", "0.1", "-o", tmp_path / "flow.npz"]
    subprocess.run([*command, "--tracks", tmp_path / "tracks.json"], check=True, capture_output=True)
    sequence, flows = fnsf.Sequence(track=True, dt_s=0.1), []
    for index in range(len(street)):
        flows += sequence.push(street.sweep(index).points)
    flows += sequence.finish()
    assert len(flows) == len(street) - 1 and sequence.finish() == []
    for index, flow in enumerate(flows):
        theirs = fnsf.read_flow(tmp_path / f"flow_{index:04}.npz")
        assert np.array_equal(flow.flow, theirs.flow) and np.array_equal(flow.clusters, theirs.clusters)
    states = [
        (track["id"], state)
        for track in json.loads((tmp_path / "tracks.json").read_text())["tracks"]
        for state in track["states"]
    ]
    tracks = sequence.tracks()
    assert len(tracks) == len(states) > 0
    for ours, (identity, theirs) in zip(tracks, states, strict=True):
        assert ours["id"] == identity
        for name, value in theirs.items():
            assert np.allclose(ours[name], value), name


def test_known_motions_and_masks_are_taken(street):
    sequence = fnsf.Sequence(preset="default")
    assert sequence.tracks() is None
    pair = street.pair(0)
    sequence.push(pair.source, ground=pair.masks[0])
    (flow,) = sequence.push(pair.target, ground=pair.masks[1], ego=pair.ego, dt_s=0.2)
    assert np.allclose(flow.ego, pair.ego)
    assert flow.report["dt_s"] == 0.2
    refused = fnsf.Sequence(preset="default")
    refused.push(pair.source)
    with pytest.raises(fnsf.InputError, match="0 usable points"):
        refused.push(np.zeros((0, 3)))
    assert len(refused.push(pair.target)) == 1


def test_after_an_exception_no_flow_has_the_sweep_of_another(street):
    def interrupted(*_):
        raise KeyboardInterrupt

    sweeps = [street.sweep(index).points for index in range(3)]
    sequence = fnsf.Sequence(preset="default")
    sequence.push(sweeps[0])
    with pytest.raises(KeyboardInterrupt):
        sequence.push(sweeps[1], progress=interrupted)
    try:
        (flow,) = sequence.push(sweeps[1])
    except fnsf.Error:
        # The flow had been found, and is lost.
        with pytest.raises(fnsf.Error, match="ended this sequence"):
            sequence.finish()
    else:
        assert np.array_equal(flow.source, sweeps[0])


def test_times_of_points_give_the_time_between_sweeps():
    street = fnsf.simulate(2, seed=5, beams=16, azimuth_steps=400, rolling=True)
    sweeps = [street.sweep(index) for index in range(2)]
    duration = float(np.ptp(sweeps[0].times[np.isfinite(sweeps[0].points).all(axis=1)]))
    sequence = fnsf.Sequence(preset="default")
    sequence.push(sweeps[0].points, times=sweeps[0].times)
    (flow,) = sequence.push(sweeps[1].points, times=sweeps[1].times)
    alone = fnsf.flow(sweeps[0].points, sweeps[1].points, times=(sweeps[0].times, sweeps[1].times))
    for found in (flow, alone):
        assert found.report["dt_s"] == pytest.approx(duration) and duration > 0.05


def test_neighbor_sweeps_lie_at_their_times_where_a_sweep_is_missing(program, street, tmp_path):
    kept = [index for index in range(len(street)) if index != 2]
    paths = [tmp_path / f"{1_700_000_000_000 + 100 * index}.pcd" for index in kept]
    sequence, even, flows, flows_of_even = fnsf.Sequence(), fnsf.Sequence(), [], []
    for index, before, path in zip(kept, [0, *kept], paths, strict=False):
        points = street.sweep(index).points
        fnsf.write(path, points)
        flows += sequence.push(points, dt_s=0.1 * (index - before) or None)
        flows_of_even += even.push(points, dt_s=0.1)
    flows += sequence.finish()
    flows_of_even += even.finish()
    command = [program, "flow", *paths, "--preset", "label", "-o", tmp_path / "flow.npz"]
    subprocess.run(command, check=True, capture_output=True)
    for index, flow in enumerate(flows):
        assert np.array_equal(flow.flow, fnsf.read_flow(tmp_path / f"flow_{index:04}.npz").flow)
    assert any(not np.array_equal(one.flow, other.flow) for one, other in zip(flows, flows_of_even, strict=True))


def test_a_dense_cloud_has_the_bits_of_the_command_line(program, street, files, tmp_path):
    command = [program, "densify", *files[:4], "--reference-time", "1.5", "-o", tmp_path / "dense.npz"]
    subprocess.run(command, check=True, capture_output=True)
    told = []
    clouds = [street.sweep(index).points for index in range(4)]
    cloud = fnsf.densify(clouds, 1.5, dt_s=0.1, progress=lambda *step: told.append(step))
    with np.load(tmp_path / "dense.npz") as theirs:
        for name in ["points", "sweep", "age", "dynamic", "converged"]:
            assert np.array_equal(getattr(cloud, name), theirs[name]), name
    assert told
    for ending in ["npz", "ply", "pcd", "laz", "las"]:
        cloud.save(tmp_path / f"dense.{ending}")
        assert (tmp_path / f"dense.{ending}").stat().st_size > len(cloud)


def test_a_given_ego_motion_of_two_sweeps_leads_a_dense_cloud_back_as_well(street):
    pair = street.pair(0)
    found = fnsf.densify([pair.source, pair.target], 0)
    given = fnsf.densify([pair.source, pair.target], 0, ego=pair.ego)
    # The sensor moves by a metre.
    assert np.linalg.norm(found.points[:, :2] - given.points[:, :2], axis=1).mean() < 0.1


def test_what_no_sequence_can_be_asked_is_refused(street):
    pair, third = street.pair(0), street.sweep(2).points
    poses = [street.pose(index) for index in range(2)]
    for refused in [
        lambda: fnsf.densify([pair.source, pair.target, third], 0, ego=pair.ego),
        lambda: fnsf.densify([pair.source, pair.target], 0, poses=poses, ego="off"),
        lambda: fnsf.Sequence(ego=pair.ego),
        lambda: fnsf.Sequence(track=True, preset="neural"),
        lambda: fnsf.Sequence(track=True, ego="off"),
    ]:
        with pytest.raises(fnsf.InputError):
            refused()
    sequence = fnsf.Sequence(preset="default", ego="off")
    sequence.push(pair.source)
    with pytest.raises(fnsf.InputError, match="push takes no ego"):
        sequence.push(pair.target, ego=pair.ego)
    assert len(sequence.push(pair.target)) == 1


def test_flows_before_a_refused_pair_are_not_lost(street):
    sequence = fnsf.Sequence()
    other = fnsf.simulate(2, seed=99, beams=32, azimuth_steps=1000)
    flows = []
    for points in [street.sweep(0).points, street.sweep(1).points, street.sweep(2).points, other.sweep(1).points]:
        flows += sequence.push(points)
    flows += sequence.finish()
    assert len(flows) == 2
    with pytest.raises(fnsf.InputError, match="scene"):
        sequence.finish()


def test_poses_lead_a_dense_cloud(street):
    clouds, poses = [street.sweep(index).points for index in range(3)], [street.pose(index) for index in range(3)]
    masks = [street.pair(0).masks[0], street.pair(0).masks[1], street.pair(1).masks[1]]
    cloud = fnsf.densify(clouds, 2, poses=poses, masks=masks, later_sweeps="inverse")
    assert len(cloud) == sum(map(len, clouds))
    # The static world does not drift: a ground point of sweep 0 lies where its pose says.
    moved = clouds[0] @ (np.linalg.inv(poses[2]) @ poses[0])[:3, :3].T + (np.linalg.inv(poses[2]) @ poses[0])[:3, 3]
    still = (cloud.sweep == 0) & ~cloud.dynamic
    assert np.abs(cloud.points[still] - moved[~cloud.dynamic[cloud.sweep == 0]]).max() < 1e-3
    for wrong, said in [({"poses": poses[:2]}, "2 poses for 3 sweeps"), ({"masks": masks[:2]}, "2 masks for 3 sweeps")]:
        with pytest.raises(fnsf.InputError, match=said):
            fnsf.densify(clouds, 1, **wrong)
    with pytest.raises(fnsf.InputError, match="outside the sequence"):
        fnsf.densify(clouds, 7)
