#!/usr/bin/env python3
"""Checks what the schemas of Kubernetes do not: the rules of these manifests.

kubernetes_files.py SHUTDOWN_TIMEOUT FILE... reads what kustomize has built. It prints the variables of the fleet's
configuration, one a line, for the program to check.
"""

import sys

import yaml

shutdown_timeout = int(sys.argv[1])
for path in sys.argv[2:]:
    with open(path, encoding="utf-8") as file:
        documents = list(yaml.safe_load_all(file))
    workloads = [d for d in documents if d["kind"] in ("Deployment", "StatefulSet")]
    assert workloads, f"{path} runs nothing"
    for workload in workloads:
        name = f"{path}: {workload['metadata']['name']}"
        pod = workload["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        grace = pod["terminationGracePeriodSeconds"]
        assert grace > shutdown_timeout, f"{name}: killed after {grace} s, the server takes {shutdown_timeout}"
        assert pod["securityContext"]["runAsNonRoot"], f"{name} may run as root"
        assert pod["securityContext"]["fsGroup"] == 65532, f"{name} cannot write its volume"
        assert container["securityContext"]["readOnlyRootFilesystem"], f"{name} writes its image"
        assert container["image"].count(":") == 1, f"{name} runs any version of its image"
        for probe, route in (("startup", "/readyz"), ("liveness", "/livez"), ("readiness", "/readyz")):
            asked = container[f"{probe}Probe"]["httpGet"]
            assert (asked["path"], asked["port"]) == (route, "admin"), f"{name}: the {probe} probe asks {asked}"
    for document in documents:
        if document["kind"] == "ScaledObject":
            target = document["spec"]["scaleTargetRef"]["name"]
            assert any(w["metadata"]["name"] == target for w in workloads), f"{path} scales {target}, which is not there"
            # KEDA refuses numbers here.
            for trigger in document["spec"]["triggers"]:
                assert all(isinstance(value, str) for value in trigger["metadata"].values()), f"{path}: {trigger}"
        if document["kind"] == "ConfigMap" and path == sys.argv[-1]:
            for key, value in document["data"].items():
                print(f"{key}={value}")
