"""What these tests share: the program, and a simulated drive with its tracks."""

import json
import os
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[3]
PROGRAM = Path(os.environ.get("FNSF_PROGRAM") or REPOSITORY / "target/release/fnsf")


def called(*arguments):
    subprocess.run([PROGRAM, *arguments], check=True)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    called("synth", "-o", folder, "--beams", "16", "--sweeps", "5")
    for sweep in range(5):
        (folder / f"sweep_{sweep:04}.pcd").rename(folder / f"31596626{sweep}359836000.pcd")
    return folder


@pytest.fixture(scope="module")
def tracks(drive):
    return json.loads((drive / "tracks.json").read_text())["tracks"]


@pytest.fixture
def exported(drive, tmp_path):
    def export(layout, name="Car", options=()):
        sweeps = sorted(drive.glob("3*.pcd"))
        called("export", drive / "tracks.json", *sweeps, "--layout", layout, "--class", name, "-o", tmp_path, *options)
        return tmp_path, [sweep.stem for sweep in sweeps]

    return export


@pytest.fixture(scope="module")
def states(tracks):
    """The states of all tracks by (track, sweep)."""
    return {(track["id"], state["sweep"]): state for track in tracks for state in track["states"]}
