"""The examples of the documentation are run as they stand."""

import re
import subprocess
from typing import get_args

import pytest
from conftest import REPOSITORY, Server

import fnsf

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")


def blocks(page):
    """The Python blocks of a page that import fnsf."""
    text = (REPOSITORY / page).read_text()
    found = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return [block for block in found if "import fnsf" in block]


EXAMPLES = [
    (page, block) for page in ("README.md", "clients/python/README.md", "docs/api.md") for block in blocks(page)
]


@pytest.mark.parametrize(("page", "block"), EXAMPLES)
def test_an_example_of_the_documentation_runs(page, block, server, street, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "street").mkdir()
    for index in range(2):
        fnsf.write(f"street/sweep_{index:04}.pcd", street.sweep(index).points)
    ours = block
    for address in ("localhost:8080", "127.0.0.1:8080"):
        ours = re.sub(rf'Client\("{address}"[^)]*\)', f'Client("{server.address}", api_key="{Server.KEY}")', ours)
    exec(compile(ours, page, "exec"), {})


def test_every_page_has_examples():
    assert len(EXAMPLES) >= 6


def test_the_notebook_runs(tmp_path):
    notebooks = sorted((REPOSITORY / "clients/python/examples").glob("*.ipynb"))
    assert notebooks
    for path in notebooks:
        notebook = nbformat.read(path, as_version=4)
        assert not any(cell.get("outputs") for cell in notebook.cells), f"{path.name} is kept without outputs"
        nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": tmp_path}}).execute()
        shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
        assert any("image/png" in output.get("data", {}) for output in shown)


def test_the_words_of_the_presets_are_those_of_the_program(program):
    refused = subprocess.run([program, "flow", "a", "b", "--preset", "none of them"], capture_output=True, text=True)
    named = re.search(r"possible values: (.*?)\]", " ".join(refused.stderr.split()))
    assert named, refused.stderr
    assert set(named.group(1).split(", ")) == set(get_args(fnsf.Preset))
