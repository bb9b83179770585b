"""Plays sweeps to a server at a lidar's rate in one call of `EstimateSequence`, and measures latency and memory.

    python3 benches/stream_grpc.py --fnsf target/release/fnsf --sweeps 300 --hz 10 SWEEP.pcd...

The sweeps (binary PCD with x, y, z as the first fields, float32) are played forward and backward until there are enough.
The latency of a flow is the time from the last byte of its target to the last byte of the flow, in the client. The
server is started for the run, on the same machine, with its own folder. Needs `pip install grpcio-tools`.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import grpc_tools
from grpc_tools import protoc
from stream import at_rate, stream_parser, summary, watch

PROTO = Path(__file__).resolve().parent.parent / "proto"
LISTEN, ADMIN = "127.0.0.1:18080", "127.0.0.1:19090"
POINT = 12
CHUNK = 80_000 * POINT


def read(path: Path) -> bytes:
    """The points of a binary PCD file, 12 bytes each."""
    head, found, body = path.read_bytes().partition(b"DATA binary\n")
    lines = [line.split() for line in head.decode().splitlines() if line and not line.startswith("#")]
    fields = {line[0]: line[1:] for line in lines}
    if not found or fields["FIELDS"][:3] != ["x", "y", "z"] or fields["SIZE"][:3] != ["4"] * 3:
        sys.exit(f"{path}: not a binary PCD file whose first fields are x, y, z in float32")
    stride = sum(int(size) * int(count) for size, count in zip(fields["SIZE"], fields["COUNT"]))
    count = int(fields["POINTS"][0])
    return b"".join(body[row * stride : row * stride + POINT] for row in range(count))


def generated(folder: str) -> tuple[Any, Any]:
    """The modules of the messages and of the service."""
    known = Path(grpc_tools.__file__).parent / "_proto"
    file = PROTO / "fnsf/v1/scene_flow.proto"
    output = [f"--python_out={folder}", f"--grpc_python_out={folder}"]
    if protoc.main(["", f"-I{PROTO}", f"-I{known}", *output, str(file)]) != 0:
        sys.exit("protoc failed")
    sys.path.insert(0, folder)
    from fnsf.v1 import scene_flow_pb2, scene_flow_pb2_grpc

    return scene_flow_pb2, scene_flow_pb2_grpc


def wait_until_ready(server: subprocess.Popen[bytes]) -> None:
    for _ in range(300):
        try:
            urllib.request.urlopen(f"http://{ADMIN}/readyz").read()
            return
        except (urllib.error.URLError, ConnectionError):
            if server.poll() is not None:
                sys.exit("the server ended")
            time.sleep(0.1)
    sys.exit("the server is not ready after 30 s")


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    asked = stream_parser(__doc__).parse_args()
    sweeps = [read(path) for path in asked.files]
    with tempfile.TemporaryDirectory() as folder:
        messages, service = generated(folder)
        command = [asked.fnsf, "serve", "--listen", LISTEN, "--admin-listen", ADMIN, "--device", "cpu"]
        quiet = subprocess.DEVNULL
        with subprocess.Popen([*command, "--data-dir", f"{folder}/data"], stdout=quiet, stderr=quiet) as server:
            try:
                wait_until_ready(server)
                report(asked, sweeps, server, messages, service)
            finally:
                server.terminate()


def report(
    asked: argparse.Namespace, sweeps: list[bytes], server: subprocess.Popen[bytes], messages: Any, service: Any
) -> None:
    request = messages.EstimateSequenceRequest
    sent: dict[int, float] = {}
    resident: list[float] = []
    threading.Thread(target=watch, args=(server, resident), daemon=True).start()

    def requests() -> Iterator[Any]:
        yield request(begin=request.Begin())
        for number, sweep, _ in at_rate(sweeps, asked):
            yield request(sweep=request.Sweep(name=str(number), points=len(sweep) // POINT))
            for first in range(0, len(sweep), CHUNK):
                yield request(chunk=messages.Chunk(points=sweep[first : first + CHUNK]))
            sent[number] = time.monotonic()

    used = [cpu_seconds(server.pid), time.process_time()]
    latencies: list[float] = []
    waited, rows, pair = 0, 0, None
    channel = grpc.insecure_channel(LISTEN, [("grpc.max_receive_message_length", 8 << 20)])
    for answer in service.SceneFlowStub(channel).EstimateSequence(requests()):
        if answer.WhichOneof("part") == "pair":
            pair, rows = answer.pair, 0
        else:
            rows += len(answer.chunk.flags)
        if pair.WhichOneof("outcome") == "error":
            sys.exit(f"pair {pair.index}: {pair.error.message}")
        if rows == pair.header.points:
            latencies.append((time.monotonic() - sent[pair.index + 1]) * 1e3)
            waited = max(waited, len(sent) - pair.index - 2)
    if len(latencies) != asked.sweeps - 1:
        sys.exit(f"{len(latencies)} flows of {asked.sweeps} sweeps")
    server_ms, client_ms = (
        (after - before) * 1e3 / len(latencies)
        for before, after in zip(used, [cpu_seconds(server.pid), time.process_time()])
    )
    print(
        f"{summary(asked, latencies, waited, resident)}; "
        f"CPU time of a pair: server {server_ms:.0f} ms, client {client_ms:.0f} ms"
    )


if __name__ == "__main__":
    main()
