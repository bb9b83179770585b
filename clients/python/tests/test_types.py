"""Types: what an editor shows is what there is."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import fnsf

pytest.importorskip("mypy")
PROJECT = Path(__file__).resolve().parents[1]


def mypy(*arguments, cwd):
    return subprocess.run([sys.executable, "-m", *arguments], cwd=cwd, capture_output=True, text=True)


def test_the_types_of_the_package_hold(tmp_path):
    done = mypy("mypy", "--strict", "--config-file", PROJECT / "pyproject.toml", "-p", "fnsf", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_stub_of_the_native_part_is_what_it_is(tmp_path):
    done = mypy("mypy.stubtest", "fnsf._native", "--ignore-missing-stub", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_public_name_has_words():
    for name in fnsf.__all__:
        thing = getattr(fnsf, name)
        if name in ("__version__", "Preset"):
            continue
        assert inspect.getdoc(thing), name
        if inspect.isclass(thing):
            for member, value in vars(thing).items():
                if not member.startswith("_") and callable(value):
                    assert inspect.getdoc(value), f"{name}.{member}"
