"""The compose files, where no docker with compose is at hand: what it would refuse, and what it would not.

compose_files.py TIMEOUT_SECONDS: the default of shutdown.timeout_seconds.
"""

import re
import sys
from pathlib import Path

import yaml

DEPLOY = Path(__file__).resolve().parents[1]
TOP = {"name", "services", "volumes"}
SERVICE = {
    "image", "build", "command", "environment", "ports", "volumes", "depends_on", "restart", "read_only", "tmpfs",
    "cap_drop", "security_opt", "stop_grace_period", "deploy",
}
DEVICE = {"driver", "count", "capabilities"}
# What NVIDIA's container toolkit must mount for Vulkan.
GPU = {"gpu", "compute", "utility", "graphics"}
VARIABLE = re.compile(r"\$\{\w+:(\?|-)([^}]+)\}")


def service_faults(name, service, volumes, services):
    if unknown := set(service) - SERVICE:
        yield f"{name}: unknown keys {sorted(unknown)}"
    image = VARIABLE.sub(r"\2", service["image"])
    if not re.fullmatch(r"[\w./-]+:v?\d+\.\d+\.\d+", image):
        yield f"{name}: image {image} is not pinned to a release"
    if "build" in service and not (DEPLOY / service["build"]["context"] / "Dockerfile").is_file():
        yield f"{name}: nothing to build in {service['build']['context']}"
    for mount in service.get("volumes", []):
        source = mount.split(":")[0]
        if source.startswith("."):
            if not (DEPLOY / source).exists():
                yield f"{name}: {source} is not there"
        elif source not in volumes:
            yield f"{name}: volume {source} is not declared"
    for port in service.get("ports", []):
        if not re.fullmatch(r"127\.0\.0\.1:\d+:\d+", VARIABLE.sub(r"\2", port)):
            yield f"{name}: port {port} is not one of loopback"
    for key, value in service.get("environment", {}).items():
        if not isinstance(value, str):
            yield f"{name}: {key} is {value!r}: environments are texts, quote it"
    for other in service.get("depends_on", []):
        if other not in services:
            yield f"{name}: depends on {other}, which is not there"


def main(timeout_seconds):
    base = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    gpu = yaml.safe_load((DEPLOY / "compose.gpu.yaml").read_text())
    faults = []
    for name, file in (("compose.yaml", base), ("compose.gpu.yaml", gpu)):
        if unknown := set(file) - TOP:
            faults.append(f"{name}: unknown keys {sorted(unknown)}")
    services, volumes = base["services"], base["volumes"]
    for name, service in services.items():
        faults += service_faults(name, service, volumes, services)

    fnsf = services["fnsf"]
    environment = fnsf["environment"]
    if not environment["FNSF_SERVE_API_KEY"].startswith("${FNSF_API_KEY:?"):
        faults.append("fnsf: starts without a key")
    timeout = int(environment.get("FNSF_SERVE_SHUTDOWN__TIMEOUT_SECONDS", timeout_seconds))
    grace = int(fnsf["stop_grace_period"].removesuffix("s"))
    if grace <= timeout:
        faults.append(f"fnsf: is killed after {grace} s, within its shutdown timeout of {timeout} s")

    if set(gpu["services"]) - set(services):
        faults.append("compose.gpu.yaml: changes a service that is not there")
    for device in gpu["services"]["fnsf"]["deploy"]["resources"]["reservations"]["devices"]:
        if set(device) != DEVICE or not GPU <= set(device["capabilities"]):
            faults.append(f"compose.gpu.yaml: {device} is not a GPU with graphics")
    for fault in faults:
        print(fault, file=sys.stderr)
    print(f"{len(services)} services, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
