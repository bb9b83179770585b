"""Flows of pairs: the numbers, and what is refused."""

import pickle
import subprocess

import numpy as np
import pytest

import fnsf

ARRAYS = ["flow", "valid", "dynamic", "ego", "cluster", "confidence", "moving"]


def same(one, other):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)


def test_a_flow_has_the_bits_of_the_command_line(program, pair, tmp_path):
    np.savez(tmp_path / "pair.npz", pc1=pair.source, pc2=pair.target)
    for options, words in [({}, []), ({"max_points": 500, "seed": 3}, ["--max-points", "500", "--seed", "3"])]:
        command = [program, "flow", tmp_path / "pair.npz", "-o", tmp_path / "flow.npz", *words]
        subprocess.run(command, check=True, capture_output=True)
        with np.load(tmp_path / "flow.npz") as theirs:
            ours = fnsf.flow(pair.source, pair.target, **options)
            for name in ARRAYS:
                assert np.array_equal(getattr(ours, name), theirs[name]), name
            for name in ours.clusters.dtype.names:
                assert np.array_equal(ours.clusters[name], theirs[f"clusters_{name}"]), name


def test_a_field_fits_too_and_moves_any_point(pair):
    flow = fnsf.flow(
        pair.source, pair.target, preset="neural", max_points=1000, field={"max_iterations": 30}, device="cpu"
    )
    assert flow.cluster is None and flow.clusters is None
    assert flow.stop_reason == "max_iterations"
    drawn = flow.valid
    # The points of the ground have the ego motion alone, and only a thousand were drawn.
    assert drawn.sum() <= 1000
    assert np.allclose(flow(pair.source[drawn]), flow.flow[drawn], atol=1e-4)
    assert flow(np.array([[5.0, 1.0, 0.2]])).shape == (1, 3)


def test_the_flow_at_any_point_is_that_of_the_points_that_are_there(pair):
    flow = fnsf.flow(pair.source, pair.target)
    moved = flow(pair.source)
    apart = np.linalg.norm(moved - flow.flow, axis=1)
    # Ground points beside an object differ: alone they have the ego motion.
    assert np.quantile(apart, 0.95) < 1e-4
    assert (apart[flow.cluster >= 0] < 1e-3).mean() > 0.99


@pytest.mark.parametrize("kind", [np.float64, np.float16, np.int32, list, "strided", "wide", "fortran"])
def test_every_kind_of_numbers_is_taken(pair, kind):
    source, target = np.round(pair.source), np.round(pair.target)
    wanted = fnsf.flow(source, target, force=True)
    if kind is list:
        given = source.tolist(), target.tolist()
    elif kind == "strided":
        given = np.repeat(source, 2, axis=0)[::2], target[::-1][::-1]
    elif kind == "wide":
        given = np.hstack([source, source]), np.hstack([target, target])
    elif kind == "fortran":
        given = np.asfortranarray(source), np.asfortranarray(target)
    else:
        given = source.astype(kind), target.astype(kind)
    assert same(fnsf.flow(*given, force=True), wanted)


def test_arrays_that_begin_between_two_words_are_taken(pair):
    wanted = fnsf.flow(pair.source, pair.target)
    record = b"x" + pair.source.astype("<f4").tobytes()
    found = fnsf.flow(np.frombuffer(record, "<f4", offset=1).reshape(-1, 3), pair.target)
    assert np.array_equal(found.flow, wanted.flow)


def test_masks_times_and_ego_motions_are_taken(street, pair):
    masked = fnsf.flow(pair.source, pair.target, ground=pair.masks, ego=pair.ego)
    assert np.allclose(masked.ego, pair.ego)
    assert masked.ego_covariance is None
    assert fnsf.evaluate(masked, pair)["epe"] < 0.03
    left_out = fnsf.flow(pair.source, pair.target, ground="keep", crop_m=20, min_range_m=3)
    far = np.abs(pair.source[:, :2]).max(axis=1) > 20
    assert not left_out.valid[far].any()
    # The preset of the paper keeps the ground, but not that of masks.
    cut = fnsf.flow(pair.source, pair.target, preset="paper", ground=pair.masks, field={"max_iterations": 5})
    assert not cut.valid[pair.masks[0]].any() and cut.valid[~pair.masks[0]].all()
    unknown = np.zeros(len(pair.source))
    unknown[3] = np.nan
    for wrong, said in [
        (unknown, "nan in row 3"),
        (np.arange(len(pair.source)) * 1000, "seconds after the sweep"),
        (np.full(len(pair.source), 1.6e9), "seconds after the sweep"),
    ]:
        with pytest.raises(fnsf.InputError, match=said):
            fnsf.flow(pair.source, pair.target, times=(wrong, np.zeros(len(pair.target))))
    timed = np.zeros(len(pair.source)), np.zeros(len(pair.target))
    assert fnsf.flow(pair.source, pair.target, times=timed).valid.all()


def test_beams_without_return_keep_their_rows(pair):
    source = pair.source.copy()
    source[::7] = np.nan
    flow = fnsf.flow(source, pair.target)
    assert len(flow) == len(source)
    assert not flow.valid[::7].any() and not flow.flow[::7].any()
    assert flow.valid.sum() > len(source) / 2


def test_a_deadline_gives_the_best_flow_so_far(pair):
    flow = fnsf.flow(pair.source, pair.target, preset="paper", deadline=0.5, device="cpu")
    assert flow.stop_reason == "deadline"
    assert flow.seconds < 2


def test_progress_is_told(pair):
    told = []
    fnsf.flow(
        pair.source,
        pair.target,
        preset="paper",
        max_points=2000,
        device="cpu",
        progress=lambda *step: told.append(step),
    )
    assert told and all(done <= total and loss >= 0 for done, total, loss in told)

    def stop(*_):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        fnsf.flow(pair.source, pair.target, preset="paper", device="cpu", progress=stop)


def test_a_flow_is_pickled_with_its_motion(pair):
    flow = fnsf.flow(pair.source, pair.target)
    again = pickle.loads(pickle.dumps(flow))
    assert same(flow, again) and again.report == flow.report
    assert np.array_equal(again(pair.source), flow(pair.source))


CLOUD = np.random.default_rng(0).uniform(-20, 20, (1000, 3)).astype(np.float32)


@pytest.mark.parametrize(
    ("source", "options", "said"),
    [
        (CLOUD[:, :2], {}, r"pc1 has shape \(1000, 2\): N x 3 is needed"),
        (CLOUD.T, {}, r"pc1 has shape \(3, 1000\), but each row is a point"),
        (CLOUD[0], {}, r"pc1 has shape \(3,\)"),
        (np.array([["a", "b", "c"]]), {}, "pc1 has type <U1: numbers are needed"),
        (CLOUD + 1j, {}, "pc1 has type complex64"),
        (np.where(CLOUD[7, 1] == CLOUD, np.inf, CLOUD), {}, "pc1 has inf in row 7, column y"),
        (np.where(CLOUD[7, 1] == CLOUD, np.nan, CLOUD), {}, "pc1 has NaN in row 7, column y"),
        (np.where(CLOUD[7, 1] == CLOUD, 2e6, CLOUD), {}, "row 7, column y: coordinates are metres"),
        (CLOUD[:2], {}, "the source cloud has 2 usable points"),
        (CLOUD[:0], {}, "the source cloud has 0 usable points"),
        (CLOUD * 1000, {}, "are these millimetres"),
        (CLOUD, {"preset": "best"}, "unknown variant `best`"),
        (CLOUD, {"seed": -1}, "invalid value"),
        (CLOUD, {"ego": np.ones((3, 3))}, "4 x 4 is needed"),
        (CLOUD, {"ego": 2 * np.eye(4)}, "not a rigid"),
        (CLOUD, {"ground": (np.zeros(3), np.zeros(1000))}, "the ground mask of pc1 has 3 rows for 1000 points"),
        (CLOUD, {"ground": "mask"}, "no ground masks"),
        (CLOUD, {"times": (np.zeros(1000), np.zeros(4))}, "the times of pc2 has 4 rows"),
        (CLOUD, {"max_points": 2}, "max_points is 2"),
        (CLOUD, {"field": {"cell": 1}}, "unknown field `cell`"),
        (CLOUD, {"threads": 0}, "threads is 0"),
        (CLOUD, {"deadline": -1.0}, "deadline is -1 s"),
        (CLOUD, {"device": "tpu"}, "none of auto, cpu, gpu"),
        (CLOUD, {"preset": "nsfp-kdtree", "device": "gpu:none of these"}, "."),
    ],
)
def test_what_is_wrong_is_refused_by_name(source, options, said):
    with pytest.raises(fnsf.Error, match=said) as caught:
        fnsf.flow(source, CLOUD, **options)
    assert isinstance(caught.value, (fnsf.InputError, fnsf.DeviceError))


def test_an_unknown_option_is_a_type_error():
    with pytest.raises(TypeError, match="sead"):
        fnsf.flow(CLOUD, CLOUD, sead=1)
    with pytest.raises(TypeError, match="no option 'sead'; there are crop_m"):
        fnsf.Sequence(sead=1)


def test_a_missing_gpu_is_a_device_error():
    with pytest.raises(fnsf.DeviceError, match="no such device"):
        fnsf.flow(CLOUD, CLOUD, preset="paper", device="gpu:no card has this name")


def test_real_pairs_have_the_errors_that_the_readme_states(real_data):
    pair = fnsf.read_pair(real_data / "av2_7fab" / "pair.npz")
    scores = fnsf.evaluate(fnsf.flow(pair.source, pair.target, ground=pair.masks), pair)
    assert scores["epe"] < 0.02 and scores["epe_dynamic"] < 0.2
