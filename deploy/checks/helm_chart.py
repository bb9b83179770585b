#!/usr/bin/env python3
"""Renders the Helm chart and compares it with what kustomize builds of deploy/kubernetes.

helm_chart.py FOLDER OUT, where FOLDER has embedded.yaml, fleet.yaml and fleet-gpu.yaml as kustomize builds them. The
rendered charts are written to OUT. Only what Helm adds may differ: labels of the release, and how a change of the
variables replaces the pods.
"""

import difflib
import sys
from pathlib import Path
from typing import Any

import helm_python as helm
import yaml

RELEASE = "fnsf"
CHART = Path("deploy/helm/fnsf")
GPU = {"limits": {"nvidia.com/gpu": "1"}}
TOLERATION = {"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}
VALUES: dict[str, dict[str, Any]] = {
    "embedded": {},
    "fleet": {"mode": "fleet"},
    "fleet-gpu": {
        "mode": "fleet",
        "worker": {"device": "gpu", "resources": GPU, "tolerations": [TOLERATION]},
    },
}
OF_HELM = {
    "app.kubernetes.io/instance",
    "app.kubernetes.io/managed-by",
    "helm.sh/chart",
    "checksum/settings",
}


def plain(node: Any, names: dict[str, str]) -> Any:
    """Without what Helm adds, and with the names of configurations that kustomize gives a hash to."""
    if isinstance(node, dict):
        return {key: plain(value, names) for key, value in node.items() if key not in OF_HELM}
    if isinstance(node, list):
        return [plain(item, names) for item in node]
    return names.get(node, node) if isinstance(node, str) else node


def texts(documents: list[dict[str, Any]]) -> list[str]:
    """Each object as YAML, in order."""
    hashed = [d["metadata"]["name"] for d in documents if d["kind"] == "ConfigMap"]
    names = {name: RELEASE for name in hashed}
    return sorted(yaml.safe_dump(plain(document, names), sort_keys=True) for document in documents)


def main() -> None:
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    chart = helm.Chart.load(str(CHART))
    for name, values in VALUES.items():
        rendered = chart.render(values, name=RELEASE, namespace="default", is_install=True)
        text = "\n---\n".join(rendered[path] for path in sorted(rendered) if rendered[path].strip())
        (out / f"helm-{name}.yaml").write_text(text, encoding="utf-8")
        found = texts([d for d in yaml.safe_load_all(text) if d])
        expected = texts(list(yaml.safe_load_all((folder / f"{name}.yaml").read_text(encoding="utf-8"))))
        if found != expected:
            lines = [t.splitlines(keepends=True) for t in ("---\n".join(expected), "---\n".join(found))]
            sys.stdout.writelines(difflib.unified_diff(*lines, "kustomize", "helm"))
            sys.exit(f"the chart's {name} is not deploy/kubernetes/{name}")
    try:
        chart.render({"mode": "other"}, name=RELEASE)
    except helm.HelmError as error:
        assert "embedded or fleet" in str(error), error
    else:
        sys.exit("the chart takes a mode that does not exist")
    print(f"the chart renders what kustomize builds: {', '.join(VALUES)}")


if __name__ == "__main__":
    main()
