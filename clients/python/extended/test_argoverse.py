"""Labels for Argoverse 2's challenge, by its own validation and its own evaluation. `.ci/extended` runs this."""

import json
import os
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import PROGRAM

FLOW = ["flow_tx_m", "flow_ty_m", "flow_tz_m"]
SWEEPS = ["315966265259836000", "315966265360032000"]
evaluation = pytest.importorskip("av2.evaluation.scene_flow.eval")
archive = pytest.importorskip("av2.evaluation.scene_flow.make_submission_archive")


@pytest.fixture
def data():
    folder = os.environ.get("FNSF_REAL_DATA")
    if not folder:
        pytest.fail("FNSF_REAL_DATA is not set")
    return Path(folder) / "av2_7fab"


def test_the_published_code_validates_the_labels_and_gives_them_the_scores_of_fnsf_eval(data, tmp_path):
    first = SWEEPS[0]
    log = tmp_path / "av2/7fab"
    (log / "sensors/lidar").mkdir(parents=True)
    for sweep in SWEEPS:
        shutil.copy(data / f"{sweep}.feather", log / "sensors/lidar")
    shutil.copy(data / "city_SE3_egovehicle.feather", log)
    truth = pd.read_feather(data / "flow_labels.feather")
    near = np.abs(pd.read_feather(data / f"{first}.feather")[["x", "y"]].to_numpy().astype(float)).max(axis=1)
    mask = (near <= 50) & ~truth["is_ground_0"].to_numpy()
    masks = tmp_path / "masks/7fab"
    masks.mkdir(parents=True)
    pd.DataFrame({"mask": mask}).to_feather(masks / f"{first}.feather")
    with zipfile.ZipFile(tmp_path / "masks.zip", "w") as packed:
        packed.write(masks / f"{first}.feather", f"7fab/{first}.feather")

    command = [PROGRAM, "label", f"av2:{tmp_path / 'av2'}", "-o", tmp_path / "labels", "--known-poses"]
    command += ["--layout", "av2-v1", "--masks", tmp_path / "masks"]
    subprocess.run(command, check=True)
    archive.validate(tmp_path / "labels", tmp_path / "masks.zip")

    asked = truth[mask].reset_index(drop=True)
    annotations = tmp_path / "annotations/7fab"
    annotations.mkdir(parents=True)
    known = {
        "category_indices": asked["classes"].to_numpy().astype(np.uint8),
        "is_close": near[mask] <= 35,
        "is_dynamic": asked["dynamic"].to_numpy(),
        "is_valid": np.ones(len(asked), dtype=bool),
        **{name: asked[name].to_numpy(np.float32) for name in FLOW},
    }
    pd.DataFrame(known).to_feather(annotations / f"{first}.feather")
    results = evaluation.evaluate_directories(annotations.parent, tmp_path / "labels")
    theirs = evaluation.results_to_dict(results)

    label = pd.read_feather(tmp_path / f"labels/7fab/{first}.feather")
    flow, dynamic = np.zeros((len(truth), 3), np.float32), np.zeros(len(truth), bool)
    flow[mask], dynamic[mask] = label[FLOW].to_numpy(np.float32), label["is_dynamic"]
    np.savez(tmp_path / "flow.npz", flow=flow, valid=mask, dynamic=dynamic)
    command = [PROGRAM, "eval", tmp_path / "flow.npz", "--truth", data / "flow_labels.feather", "--json"]
    command += ["--source", data / f"{first}.feather"]
    ours = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)["argoverse2"]
    three_way = ours["three_way"]
    for name, value in [
        ("EPE 3-Way Average", three_way["epe"]),
        ("EPE/Foreground/Dynamic", three_way["foreground_dynamic"]),
        ("EPE/Foreground/Static", three_way["foreground_static"]),
        ("EPE/Background/Static", three_way["background_static"]),
        ("Dynamic IoU", ours["dynamic_iou"]),
    ]:
        assert theirs[name] == pytest.approx(value, rel=1e-9), name
    assert theirs["EPE 3-Way Average"] < 0.06


def test_av2_reads_the_annotations(exported, states):
    from av2.structures import cuboid as cuboids

    folder, names = exported("av2", "REGULAR_VEHICLE")
    read = cuboids.CuboidList.from_feather(folder / "annotations.feather")
    known = sorted(states.items(), key=lambda known: (known[0][1], known[0][0]))
    assert len(read) == len(known)
    for cuboid, ((_, sweep), state) in zip(read, known, strict=True):
        assert cuboid.timestamp_ns == int(names[sweep])
        assert cuboid.category == "REGULAR_VEHICLE"
        np.testing.assert_allclose(cuboid.xyz_center_m, state["center"], atol=1e-6)
        np.testing.assert_allclose(cuboid.dims_lwh_m, state["size"], atol=1e-6)
        ahead = cuboid.dst_SE3_object.rotation[:2, 0]
        np.testing.assert_allclose(ahead, [np.cos(state["yaw"]), np.sin(state["yaw"])], atol=1e-6)
