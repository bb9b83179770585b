#!/usr/bin/env python3
"""Scene flow over gRPC, from the protocol file alone: one pair, or a drive as it happens.

    fnsf_client.py pair a.pcd b.pcd -o flow.npz
    fnsf_client.py sequence drive/*.pcd --interval 0.1
    fnsf_client.py tracks JOB -o tracks.json

As a library: Client.pair and Client.sequence take and give bytes and need no numpy.
"""

import argparse
import importlib
import json
import os
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import grpc
from clouds import BadFile, Cloud, mean_length, read_cloud, read_poses, write_flow

PRESETS = ["default", "label", "neural", "paper", "nsfp-baseline", "nsfp"]
PRESETS += ["nsfp++", "nsfp++-dt", "nsfp-kdtree", "fnsf-linear", "nsfp-linear", "nsfp-kdtree-linear"]
# 48 Ki points and their flags stay below the 1 MiB that the server takes in a message.
CHUNK_POINTS = 48 * 1024
REPOSITORY_PROTO = Path(__file__).resolve().parents[2] / "proto"
PROTO = "fnsf/v1/scene_flow.proto"
# Bad input, as the fnsf program says it.
EXIT_BAD_INPUT, EXIT_FAILED = 65, 70


def load_stubs(proto_root):
    """Compiles the protocol into a temporary folder, so that no generated code is kept anywhere."""
    from grpc_tools import protoc

    if not (Path(proto_root) / PROTO).is_file():
        raise BadFile(f"{proto_root}: no {PROTO} below it; say --proto DIR")
    with tempfile.TemporaryDirectory() as folder:
        command = ["protoc", f"-I{proto_root}", f"--python_out={folder}", f"--grpc_python_out={folder}", PROTO]
        if protoc.main(command) != 0:
            raise BadFile(f"{proto_root}/{PROTO} cannot be compiled")
        sys.path.insert(0, folder)
        try:
            messages = importlib.import_module("fnsf.v1.scene_flow_pb2")
            calls = importlib.import_module("fnsf.v1.scene_flow_pb2_grpc")
        finally:
            sys.path.remove(folder)
    return messages, calls


@dataclass(frozen=True)
class Flow:
    """A header, and one value a row: packed float32 displacements, and a byte with bit 0 valid, bit 1 dynamic.

    Of an object search also: the index of the row's cluster (packed int32, -1 for none), the chances that its flow is
    right and that it moves (packed float32), and the clusters, each with its box, velocity and yaw rate.
    """

    header: object
    rows: bytes
    flags: bytes
    cluster: bytes = b""
    confidence: bytes = b""
    moving: bytes = b""
    clusters: tuple = ()


@dataclass(frozen=True)
class Pair:
    """Two consecutive sweeps of a sequence: their flow, or why there is none."""

    index: int
    source: str
    target: str
    flow: Flow | None
    error: object | None


class Client:
    """Calls of one server. `deadline` is in seconds and holds for a whole call."""

    def __init__(self, server, api_key=None, tls=False, proto_root=REPOSITORY_PROTO):
        self.messages, calls = load_stubs(proto_root)
        self.channel = grpc.secure_channel(server, grpc.ssl_channel_credentials()) if tls else grpc.insecure_channel(server)
        self.calls = calls.SceneFlowStub(self.channel)
        self.metadata = [("authorization", f"Bearer {api_key}")] if api_key else []

    def options(self, **named):
        """Options of a request; names and values are the protocol's, enumerations in words."""
        fields = {name: value for name, value in named.items() if value is not None}
        for name in ("preset", "ground", "ego", "priority"):
            if name in fields:
                fields[name] = f"{name}_{fields[name]}".upper().replace("-", "_")
        return self.messages.Options(**fields)

    def _chunks(self, cloud):
        for first in range(0, len(cloud), CHUNK_POINTS):
            last = first + CHUNK_POINTS
            yield self.messages.Chunk(points=cloud.points[12 * first : 12 * last], ground=cloud.ground[first:last])

    def pair(self, source, target, options=None, deadline=None, on_progress=None):
        """The flow from source to target. `on_progress` gets the protocol's Progress now and then."""
        request = self.messages.EstimateFlowRequest

        def requests():
            yield request(begin=request.Begin(options=options, progress_ms=200 if on_progress else 0))
            for name, cloud in ((self.messages.CLOUD_SOURCE, source), (self.messages.CLOUD_TARGET, target)):
                for chunk in self._chunks(cloud):
                    yield request(cloud=request.CloudChunk(cloud=name, chunk=chunk))

        header, chunks = None, []
        for answer in self.calls.EstimateFlow(requests(), timeout=deadline, metadata=self.metadata):
            part = answer.WhichOneof("part")
            if part == "progress" and on_progress:
                on_progress(answer.progress)
            elif part == "header":
                header = answer.header
            elif part == "chunk":
                chunks.append(answer.chunk)
        return _joined(header, chunks)

    def sequence(self, sweeps, options=None, deadline=None):
        """Yields a Pair for each two consecutive sweeps of `sweeps`, as soon as it is there.

        A sweep is (name, Cloud), or (name, Cloud, pose) with the 16 numbers of world_from_sensor, row by row. `sweeps`
        is read from another thread, no faster than the server takes them.
        """
        request, broken = self.messages.EstimateSequenceRequest, []

        def requests():
            yield request(begin=request.Begin(options=options))
            try:
                for name, cloud, *pose in sweeps:
                    yield request(sweep=request.Sweep(name=name, pose=pose[0] if pose else ()))
                    for chunk in self._chunks(cloud):
                        yield request(chunk=chunk)
            except Exception as error:
                # gRPC would end the call without saying why.
                broken.append(error)
                raise

        answers = self.calls.EstimateSequence(requests(), timeout=deadline, metadata=self.metadata)
        try:
            yield from self._pairs(answers)
        except grpc.RpcError:
            if broken:
                raise broken[0] from None
            raise

    def tracks(self, job):
        """The tracks of a sequence's moving objects, by the id of its job: a list of the protocol's Track."""
        return list(self.calls.GetTracks(self.messages.GetTracksRequest(id=job), metadata=self.metadata))

    @staticmethod
    def _pairs(answers):
        pair, chunks, rows = None, [], 0
        for answer in answers:
            if answer.WhichOneof("part") == "pair":
                pair, chunks, rows = answer.pair, [], 0
            else:
                chunks.append(answer.chunk)
                rows += len(answer.chunk.flags)
            if pair.WhichOneof("outcome") == "error":
                yield Pair(pair.index, pair.source, pair.target, None, pair.error)
            elif rows == pair.header.points:
                yield Pair(pair.index, pair.source, pair.target, _joined(pair.header, chunks), None)


def _joined(header, chunks):
    def joined(name):
        return b"".join(getattr(chunk, name) for chunk in chunks)

    clusters = tuple(cluster for chunk in chunks for cluster in chunk.clusters)
    return Flow(header, *map(joined, ("flow", "flags", "cluster", "confidence", "moving")), clusters)


def describe(error):
    """One line about a failed call: the server's own code where it says one, and when to come again."""
    code, retry = None, ""
    try:
        from google.rpc.error_details_pb2 import ErrorInfo, RetryInfo
        from grpc_status import rpc_status

        status = rpc_status.from_call(error)
        for detail in status.details if status else ():
            info, pause = ErrorInfo(), RetryInfo()
            if detail.Unpack(info):
                code = info.reason
            elif detail.Unpack(pause) and pause.HasField("retry_delay"):
                retry = f" (try again in {pause.retry_delay.ToSeconds()} s)"
    except ImportError:
        # The code stands in the metadata too, for clients without the richer form.
        code = dict(error.trailing_metadata() or ()).get("fnsf-code")
    return f"{code or 'no answer'} [{error.code().name}]: {error.details()}{retry}"


class Clock:
    """Lines with the seconds since the start, from any thread."""

    def __init__(self):
        self.start, self.lock = time.monotonic(), threading.Lock()

    def say(self, text):
        with self.lock:
            print(f"{time.monotonic() - self.start:8.3f} s  {text}", flush=True)


def summary(flow):
    header = flow.header
    length, moving = mean_length(flow)
    method = header.WhichOneof("method")
    if method == "objects":
        done = f"{header.objects.searched} clusters, {header.objects.moving} move"
    else:
        done = f"{header.field.iterations} iterations"
    return (
        f"{header.valid_points} of {header.points} points, mean {length:.3f} m, {moving:.1%} moving, "
        f"{done}, {header.stop_reason}, {header.seconds.total:.3f} s on {header.device}"
    )


def run_pair(client, options, arguments):
    if not arguments.target and not arguments.source.endswith(".npz"):
        raise BadFile(f"{arguments.source}: TARGET may be left out only where an .npz holds both sweeps")
    source, target = read_cloud(arguments.source, "1"), read_cloud(arguments.target or arguments.source, "2")
    clock = Clock()
    clock.say(f"sending {len(source)} and {len(target)} points")
    flow = client.pair(
        source,
        target,
        options,
        arguments.deadline,
        lambda progress: clock.say(f"{progress.done} of {progress.total}, loss {progress.loss:.4f} m"),
    )
    clock.say(f"flow: {summary(flow)}")
    write_flow(arguments.output, flow)
    print(f"written to {arguments.output}")


def run_sequence(client, options, arguments):
    if len(arguments.sweeps) < 2:
        raise BadFile("a sequence has two sweeps or more")
    if arguments.output:
        Path(arguments.output).mkdir(parents=True, exist_ok=True)
    poses = read_poses(arguments.poses, len(arguments.sweeps)) if arguments.poses else None
    clock, sent, came = Clock(), 0, []

    def sweeps():
        nonlocal sent
        for place, path in enumerate(arguments.sweeps):
            due = clock.start + place * arguments.interval
            time.sleep(max(0.0, due - time.monotonic()))
            cloud = read_cloud(path)
            yield (Path(path).name, cloud, poses[place]) if poses else (Path(path).name, cloud)
            sent += 1
            clock.say(f"sent   {Path(path).name}, {len(cloud)} points")

    failed = 0
    for pair in client.sequence(sweeps(), options, arguments.deadline):
        name = f"flow {pair.index}: {pair.source} -> {pair.target}"
        came.append(sent)
        if pair.error:
            failed += 1
            clock.say(f"{name} failed: {pair.error.code}: {pair.error.message}")
            continue
        clock.say(f"{name}: {summary(pair.flow)}")
        if arguments.output:
            write_flow(Path(arguments.output) / f"flow_{pair.index:04}.npz", pair.flow)
    sweeps = len(arguments.sweeps)
    early = sum(place < sweeps for place in came)
    print(f"{len(came)} of {sweeps - 1} flows came, {early} of them before the last sweep was sent, {failed} failed")
    return failed == 0 and len(came) == sweeps - 1


def run_tracks(client, _options, arguments):
    from google.protobuf.json_format import MessageToDict

    tracks = client.tracks(arguments.job)
    named = [MessageToDict(track, preserving_proto_field_name=True, always_print_fields_with_no_presence=True) for track in tracks]
    Path(arguments.output).write_text(json.dumps({"tracks": named}))
    print(f"{len(tracks)} tracks written to {arguments.output}")


def arguments_of(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="127.0.0.1:8080", help="host and port [default: %(default)s]")
    parser.add_argument("--api-key", default=os.environ.get("FNSF_API_KEY"), help="[default: FNSF_API_KEY of the environment]")
    parser.add_argument("--tls", action="store_true", help="the server has a certificate that this machine trusts")
    parser.add_argument("--proto", default=REPOSITORY_PROTO, metavar="DIR", help=f"what {PROTO} lies below")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    pair = commands.add_parser("pair", help="the flow of one pair")
    pair.add_argument("source", help=".pcd, .npy, .npz or packed .f32")
    pair.add_argument("target", nargs="?", help="may be left out where SOURCE is an .npz with pc1 and pc2")
    pair.add_argument("-o", "--output", required=True, help=".npz, .npy or packed .f32")
    pair.set_defaults(run=run_pair)
    sequence = commands.add_parser("sequence", help="the flow of each two consecutive sweeps, as they come")
    sequence.add_argument("sweeps", nargs="+", metavar="SWEEP", help=".pcd, .npy, .npz or packed .f32, in order")
    sequence.add_argument("-o", "--output", metavar="DIR", help="write every flow into this folder")
    sequence.add_argument("--interval", type=float, default=0.0, metavar="SECONDS", help="between sweeps, as a sensor would")
    sequence.add_argument("--poses", metavar="FILE", help="poses of all sweeps: 12 numbers a line, world_from_sensor")
    sequence.set_defaults(run=run_sequence)
    tracks = commands.add_parser("tracks", help="the tracks of a sequence's moving objects, as JSON")
    tracks.add_argument("job", help="the id of the sequence's job")
    tracks.add_argument("-o", "--output", required=True, help=".json")
    tracks.set_defaults(run=run_tracks)
    for command in (pair, sequence):
        command.add_argument("--deadline", type=float, metavar="SECONDS", help="for the whole call; the best flow so far comes back")
        command.add_argument("--preset", choices=PRESETS)
        command.add_argument("--seed", type=int)
        command.add_argument("--max-points", type=int)
        command.add_argument("--crop-m", type=float)
        command.add_argument("--min-range-m", type=float)
        command.add_argument("--dt-s", type=float, metavar="SECONDS", help="from one sweep to the next")
        command.add_argument("--force", action="store_true", default=None)
        command.add_argument("--ground", choices=["keep", "mask", "auto"])
        command.add_argument("--ego", choices=["off", "auto"])
        command.add_argument("--priority", choices=["low", "normal", "high"])
    return parser.parse_args(argv)


def main(argv=None):
    arguments = arguments_of(argv)
    names = ("preset", "seed", "max_points", "crop_m", "min_range_m", "dt_s", "force", "ground", "ego", "priority")
    try:
        client = Client(arguments.server, arguments.api_key, arguments.tls, arguments.proto)
        options = client.options(**{name: getattr(arguments, name, None) for name in names})
        return 0 if arguments.run(client, options, arguments) in (None, True) else EXIT_FAILED
    except (BadFile, OSError) as error:
        print(f"fnsf_client: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except grpc.RpcError as error:
        print(f"fnsf_client: {describe(error)}", file=sys.stderr)
        return EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
