#!/usr/bin/env python3
"""Checks that the jobs of bulk labelling call the program as it wants to be called.

farm_files.py PROGRAM FILE...
"""

import subprocess
import sys

import yaml

program, *paths = sys.argv[1:]
known = subprocess.run([program, "label", "--help"], check=True, capture_output=True, text=True).stdout


def containers(node):
    """Every container below a node of a document."""
    if isinstance(node, dict):
        if "image" in node and "args" in node:
            yield node
        for value in node.values():
            yield from containers(value)
    elif isinstance(node, list):
        for value in node:
            yield from containers(value)


for path in paths:
    with open(path, encoding="utf-8") as file:
        found = list(containers(yaml.safe_load(file)))
    assert found, f"{path} runs nothing"
    for container in found:
        first, _, *options = container["args"]
        assert first == "label", f"{path}: {container['args']}"
        for option in options:
            name = option.split("=")[0]
            assert f" {name} " in known or f" {name}\n" in known, f"{path}: fnsf label has no {name}"
