"""What an undisturbed server makes of every case, compared with the command line, and what bad files cost it."""

import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from cases import Case, differences, digest
from client import form
from clouds import bad_files
from context import Soak
from ledger import ENDS
from samples import of_process

TENANT = "alpha"
MIB = 1 << 20
# The bomb of `bad_files` may unfold to 32 MiB and 32 times its own size of about 50 KB; the rest is its decoder's.
MOST_PEAK = 80 * MIB
MOST_KEPT = 12 * MIB


def compute(soak: Soak, binary: Path, key: str) -> None:
    """Fills `soak.references`, from the folder of the soak where they are of this program."""
    held = soak.state.folder / f"references-{key}.json"
    if held.exists():
        soak.references = json.loads(held.read_text())
        return
    for case in soak.cases.values():
        if case.error:
            continue
        soak.references[case.name] = _of(soak, case)
        if case.kind == "pair":
            _compare(soak, case, binary)
    held.write_text(json.dumps(soak.references))


def _of(soak: Soak, case: Case) -> dict[str, dict[str, str]]:
    """Digests of the result of one case in every format."""
    options = {**case.options, "labels": {"reference": case.name, "case": case.name}}
    view = soak.call("POST", "/v1/jobs", TENANT, form(case.parts, options)).json()
    job = view.get("id")
    while job and view.get("id") == job and view["state"] not in ENDS:
        view = soak.call("GET", f"/v1/jobs/{job}?wait=30", TENANT).json()
    # An answer without the job is an error's, such as that an acknowledged job is not there.
    if view.get("state") != "succeeded":
        raise RuntimeError(f"the reference of {case.name} fails: {view}")
    found = {}
    for name, media in case.formats.items():
        answer = soak.call("GET", f"/v1/jobs/{job}/result", TENANT, headers={"Accept": media})
        found[name] = digest(name, answer.body)
    return found


def _compare(soak: Soak, case: Case, binary: Path) -> None:
    """The server's flow of a pair is that of `fnsf flow` on the same files."""
    with tempfile.TemporaryDirectory() as name:
        files = []
        for _, file, data in case.parts:
            files.append(Path(name, file))
            files[-1].write_bytes(data)
        command = [binary, "flow", *files, "-o", Path(name, "flow.npz"), "--device", "cpu", "--force"]
        for option in ("preset", "seed", "max_points", "crop_m", "ground", "ego"):
            if option in case.options:
                command += ["--" + option.replace("_", "-"), str(case.options[option])]
        if "field" in case.options:
            command += ["--max-iterations", str(case.options["field"]["max_iterations"])]
        subprocess.run(command, check=True, capture_output=True)
        found = digest("npz", Path(name, "flow.npz").read_bytes())
    wrong = differences(soak.references[case.name]["npz"], found)
    if wrong:
        soak.state.violation("command line and server differ", case=case.name, parts=wrong)


def bad_files_cost_nothing(soak: Soak) -> None:
    """Sends every bad file five times to a quiet server, twice over. The second time its memory must not rise."""
    node = soak.nodes[0]
    good = soak.cases["default-npy"].parts[1]
    costs: list[dict[str, Any]] = []
    for turn in range(2):
        before = of_process(node.pid)["rss"]
        for name, (file, data) in bad_files(turn).items():
            Path(f"/proc/{node.pid}/clear_refs").write_text("5")
            parts = [("source", file, data)] + ([] if file.endswith(".npz") else [good])
            now = of_process(node.pid)["rss"]
            for _ in range(5):
                answer = soak.call("POST", "/v1/flow", TENANT, form(parts, None))
                if answer.status not in (400, 413, 422):
                    soak.state.violation("bad file", name=name, status=answer.status, body=answer.body[:300].decode())
            lines = Path(f"/proc/{node.pid}/status").read_text().splitlines()
            peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 - now
            costs.append({"turn": turn, "name": name, "peak": peak})
            if peak > MOST_PEAK:
                soak.state.violation("bad file takes memory", name=name, peak_bytes=peak)
        time.sleep(1.0)
        kept = of_process(node.pid)["rss"] - before
        soak.state.write("bad_files", {"turn": turn, "kept": kept, "costs": costs[-len(bad_files(turn)) :]})
        if turn and kept > MOST_KEPT:
            soak.state.violation("bad files keep memory", kept_bytes=kept)
