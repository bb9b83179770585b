"""Labels of many pairs, without an engine."""

import os
import threading
from pathlib import Path

import numpy as np
import pytest

import fnsf

pytest.importorskip("pyarrow")
from fnsf.bulk import COLUMNS, Labeller


@pytest.fixture
def table(street, tmp_path):
    for index in range(4):
        fnsf.write(tmp_path / f"{index}.pcd", street.sweep(index).points)
    keys = [f"drive/{index}" for index in range(3)]
    return {
        "key": np.array(keys, dtype=object),
        "source": np.array([str(tmp_path / f"{index}.pcd") for index in range(3)], dtype=object),
        "target": np.array([f"file://{tmp_path / f'{index + 1}.pcd'}" for index in range(3)], dtype=object),
    }


def test_rows_are_labelled_once_and_have_the_flow_of_their_pair(table, street, tmp_path):
    labeller = Labeller(str(tmp_path / "labels"), preset="default")
    report = labeller(table)
    assert tuple(report) == COLUMNS
    assert list(report["outcome"]) == ["labelled"] * 3
    assert report["points"].dtype == np.int64 and report["moving"].sum() > 0
    flow = fnsf.read_flow(tmp_path / "labels/drive/1.npz")
    assert np.array_equal(flow.flow, fnsf.flow(street.sweep(1).points, street.sweep(2).points).flow)
    assert list(labeller(table)["outcome"]) == ["found"] * 3
    assert sorted(os.listdir(tmp_path / "labels/drive")) == ["0.npz", "1.npz", "2.npz"]


def test_rows_that_cannot_be_used_are_refused(table, tmp_path):
    table["source"][0] = str(tmp_path / "none.pcd")
    (tmp_path / "2.pcd").write_bytes(b"# .PCD v0.7\n")
    report = Labeller(str(tmp_path / "labels"))(table)
    assert list(report["outcome"]) == ["refused"] * 3
    assert "none.pcd" in report["error"][0] and "2.pcd" in report["error"][1]
    with pytest.raises(fnsf.InputError, match="labels are npz"):
        Labeller("x", ending="obj")


def test_what_is_suspicious_about_a_pair_is_in_its_report(table, street, tmp_path):
    points = street.sweep(1).points
    head = f"FIELDS x y z time\nSIZE 4 4 4 8\nTYPE F F F F\nWIDTH {len(points)}\nHEIGHT 1\nDATA ascii\n"
    rows = np.column_stack([points, np.linspace(0.0, 0.1, len(points))])
    rows[5, 3] = np.nan
    with open(table["source"][1], "w") as file:
        file.write(head)
        np.savetxt(file, rows)
    report = Labeller(str(tmp_path / "labels"))(table)
    assert list(report["outcome"]) == ["labelled"] * 3, report["error"]
    told = [warnings.count("1.pcd: its column time is NaN or infinite in row 5") for warnings in report["warnings"]]
    assert told == [1, 1, 0]


def test_names_in_a_uri_are_decoded_before_their_timestamps_are_read(table, tmp_path):
    for index, stamp in enumerate(["1532402927647951", "1532402927697731"]):
        os.rename(tmp_path / f"{index}.pcd", tmp_path / f"LIDAR {stamp}.pcd")
    uris = [f"file://{tmp_path}/LIDAR%20{stamp}.pcd" for stamp in ["1532402927647951", "1532402927697731"]]
    for key, options in [("found", {}), ("told", {"dt_s": 0.04978})]:
        report = Labeller(str(tmp_path), **options).label(key, *uris)
        assert report["outcome"] == "labelled", report
    found, told = (fnsf.read_flow(tmp_path / f"{key}.npz").clusters for key in ["found", "told"])
    assert np.array_equal(found, told) and np.abs(found["velocity"]).max() > 1


def test_a_pair_whose_fit_diverges_is_refused(table, tmp_path):
    labeller = Labeller(
        str(tmp_path / "labels"), preset="nsfp-baseline", field={"learning_rate": 1e30, "max_iterations": 20}
    )
    report = labeller(table)
    assert list(report["outcome"]) == ["refused"] * 3
    assert all("diverged" in error for error in report["error"])


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"preset": "defualt"}, fnsf.InputError, "defualt"),
        ({"threads": 0}, fnsf.InputError, "threads is 0"),
        ({"deadline": 0}, fnsf.InputError, "deadline is 0"),
        ({"device": "gpux"}, fnsf.InputError, "gpux"),
        ({"times": ([], [])}, TypeError, "times"),
        ({"ego": np.eye(4)}, fnsf.InputError, "motion of one pair"),
        ({"ground": "mask"}, fnsf.InputError, "needs masks"),
    ],
)
def test_options_that_fit_no_pair_are_refused_at_the_start(tmp_path, options, error, said):
    with pytest.raises(error, match=said):
        Labeller(str(tmp_path), **options)


def test_the_time_between_sweeps_is_that_of_their_names(street, tmp_path):
    times = [1532402927647951, 1532402927697951]
    names = [str(tmp_path / f"n015__LIDAR_TOP__{time}.pcd") for time in times]
    for index, name in enumerate(names):
        fnsf.write(name, street.sweep(index).points)
    for options, dt_s in [({}, 0.05), ({"dt_s": 0.2}, 0.2)]:
        output = tmp_path / f"labels{dt_s}"
        labeller = Labeller(str(output), preset="default", **options)
        assert labeller.label("one", *names)["outcome"] == "labelled"
        expected = fnsf.flow(street.sweep(0).points, street.sweep(1).points, dt_s=dt_s)
        velocity = fnsf.read_flow(output / "one.npz").clusters["velocity"]
        assert np.array_equal(velocity, expected.clusters["velocity"]) and np.abs(velocity).max() > 1


def test_a_pair_with_the_newer_sweep_first_takes_its_times_against_the_direction_of_time(tmp_path):
    street = fnsf.simulate(2, seed=5, beams=16, azimuth_steps=400, speed=25.0, rolling=True)
    sweeps = [street.sweep(1), street.sweep(0)]
    names = [str(tmp_path / f"{time}.pcd") for time in (1700000000100, 1700000000000)]
    for sweep, name in zip(sweeps, names, strict=True):
        rows = np.column_stack([sweep.points, sweep.times]).astype("<f4")
        header = (
            f"VERSION .7\nFIELDS x y z time\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {len(rows)}\n"
            f"HEIGHT 1\nPOINTS {len(rows)}\nDATA binary\n"
        )
        Path(name).write_bytes(header.encode() + rows.tobytes())
    read = [fnsf.read_sweep(name) for name in names]
    labeller = Labeller(str(tmp_path / "labels"), preset="default")
    assert labeller.label("one", *names)["outcome"] == "labelled"
    found = fnsf.read_flow(tmp_path / "labels/one.npz").flow
    for sign, same in [(-1.0, True), (1.0, False)]:
        times = (sign * read[0].times, sign * read[1].times)
        flow = fnsf.flow(read[0].points, read[1].points, times=times, dt_s=0.1).flow
        assert np.array_equal(flow, found) is same


@pytest.mark.parametrize(
    "uri",
    [
        "abfss://x@evil.example/c/0.pcd",
        "abfss://evil.example:443/c/0.pcd",
        "abfs://a:secret@evil/c/0.pcd",
        "s3://bucket/0.pcd?endpoint_override=evil.example",
        "s3://key:secret@bucket/0.pcd",
        "hdfs://evil.example/0.pcd",
        "file://evil.example/0.pcd",
        "abfss://c@evil.example#.dfs.core.windows.net/0.pcd",
    ],
)
def test_no_row_names_a_server_that_would_get_the_credentials_of_this_one(table, tmp_path, monkeypatch, uri):
    from pyarrow import fs

    def never(uri):
        raise AssertionError(f"{uri} was opened")

    table["source"][:] = uri
    table["target"][:] = uri
    monkeypatch.setattr(fs, "FileSystem", type("FileSystem", (), {"from_uri": staticmethod(never)}))
    report = Labeller(str(tmp_path / "labels"))(table)
    assert list(report["outcome"]) == ["refused"] * 3


def test_a_row_that_cannot_be_written_does_not_stop_the_others(table, tmp_path):
    (tmp_path / "labels/taken.npz").mkdir(parents=True)
    (tmp_path / "labels/file").write_text("")
    good = table["key"][0]
    for key in ["a?b", "a#b", "x" * 300, "../a", "/a", "a//b", "a\0b", "taken", "file/a"]:
        table["key"][1] = key
        report = Labeller(str(tmp_path / "labels"), preset="default")(table)
        assert report["outcome"][0] in ("labelled", "found"), good
        assert report["outcome"][1] == "refused", key
    os.mkfifo(tmp_path / "pipe")
    table["key"][1], table["source"][1] = "drive/1", str(tmp_path / "pipe")
    assert Labeller(str(tmp_path / "labels"))(table)["outcome"][1] == "refused"


def test_a_key_with_percent_signs_is_a_name_below_the_output(table, tmp_path):
    for output in (str(tmp_path / "labels"), f"file://{tmp_path}/labels"):
        for key in ("%2e%2e/%2e%2e/outside", "a%2Fb", "a%41", "Übung 7"):
            table["key"][1] = key
            report = Labeller(output, preset="default")(table)
            assert report["outcome"][1] in ("labelled", "found"), (output, key, report["error"][1])
            assert (tmp_path / "labels" / f"{key}.npz").is_file()
    assert {path.name for path in tmp_path.iterdir() if path.name.startswith(("outside", "labels"))} == {"labels"}


def test_racing_writers_leave_one_label(table, tmp_path):
    outcomes = []
    labeller = Labeller(str(tmp_path / "labels"), ending="feather")
    threads = [threading.Thread(target=lambda: outcomes.extend(labeller(table)["outcome"])) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(outcomes) == 24 and outcomes.count("labelled") == 3
    assert sorted(os.listdir(tmp_path / "labels/drive")) == ["0.feather", "1.feather", "2.feather"]
