"""Labels of many pairs on engines that exist: Ray Data and Spark.

    import fnsf.bulk, ray
    pairs = ray.data.read_parquet("pairs.parquet")            # columns key, source, target
    done = fnsf.bulk.ray_label(pairs, "s3://lake/flow/run-7", preset="default", num_cpus=2)
    done.write_parquet("s3://lake/flow/run-7-report")

A label is written under the name of its key, and a key that is there is not computed again: a run that was cut off goes
on. Without such an engine use the program's `fnsf label`.
"""

from __future__ import annotations

import os
import re
import time
import uuid
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from . import _native
from ._files import MAX_FILE, Sweep
from ._flow import check, flow

COLUMNS = ("key", "source", "target", "outcome", "error", "seconds", "points", "moving", "warnings")
"""The columns of the report."""
ENDINGS = ("npz", "feather", "npy", "ply", "pcd", "json")


PART = r"[^/\\?#\x00-\x1f\x7f]{1,200}"
KEY = re.compile(rf"{PART}(/{PART}){{0,19}}")
"""Parts of up to 200 letters, without what has a meaning in a URI."""
REFUSED = (
    _native.Error,
    ValueError,
    FileExistsError,
    FileNotFoundError,
    IsADirectoryError,
    NotADirectoryError,
)
"""Errors that occur again when the pair is tried again; `DeviceError` is excepted. Other errors are those of a disk or
a network: the engine tries again."""
# Other schemes, and Azure's other ways to name a server, would send the credentials of this machine there.
AUTHORITY = {
    "file": re.compile(""),
    "s3": re.compile(r"[A-Za-z0-9._-]+"),
    "gs": re.compile(r"[A-Za-z0-9._-]+"),
    "abfs": re.compile(r"([A-Za-z0-9-]+@)?[A-Za-z0-9-]+(\.(dfs|blob)\.core\.windows\.net)?"),
}
AUTHORITY |= {"gcs": AUTHORITY["gs"], "abfss": AUTHORITY["abfs"]}
"""What may stand between `://` and the path, by scheme."""


class Labeller:
    """Labels pairs: one for each actor or task.

    Args:
        output: folder or URI for the labels.
        ending: format of the labels: npz, feather, npy, ply, pcd or json.
        options: as in `flow`, without an ego motion and masks of one pair.
    """

    def __init__(self, output: str, *, ending: str = "npz", **options: Any) -> None:
        if ending not in ENDINGS:
            raise _native.InputError(f"labels are {', '.join(ENDINGS)}, not {ending}")
        if not isinstance(options.get("ego"), (str, type(None))):
            raise _native.InputError("ego is the motion of one pair, and a run has many")
        if options.get("ground") == "mask":
            raise _native.InputError("ground='mask' needs masks, which files of sweeps do not have: try 'auto'")
        check(**options)
        self._output, self._ending, self._options = output.rstrip("/") or "/", ending, options

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Labels the rows of a batch: columns key, source and target. Returns the columns of the report."""
        rows = zip(batch["key"], batch["source"], batch["target"], strict=True)
        reports = [self.label(str(key), str(source), str(target)) for key, source, target in rows]
        # One type a column, so that batches of all kinds have one schema.
        types = {"seconds": np.float64, "points": np.int64, "moving": np.int64}
        return {name: np.array([report[name] for report in reports], dtype=types.get(name, object)) for name in COLUMNS}

    def label(self, key: str, source: str, target: str) -> dict[str, Any]:
        """Labels one pair, unless its label is there. A pair that cannot be labelled is refused, not raised."""
        report: dict[str, Any] = dict.fromkeys(COLUMNS, "")
        report |= {"key": key, "source": source, "target": target, "seconds": 0.0, "points": 0, "moving": 0}
        refused: list[str] = []
        if not KEY.fullmatch(key) or any(part in (".", "..") for part in key.split("/")):
            return report | {"outcome": "refused", "error": f"the key {key[:200]!r} is no name below the output"}
        began = time.monotonic()
        try:
            # The key is a name, not a part of a URI: `%2e` is no dot.
            filesystem, root = _filesystem(self._output)
            path = f"{root.rstrip('/')}/{key}.{self._ending}"
            if _exists(filesystem, path):
                return report | {"outcome": "found"}
            (first, name), (second, other) = _sweep(source), _sweep(target)
            apart = _native.pair_interval((name, other), (_clock(first), _clock(second)))
            times = None
            if first.times is not None and second.times is not None:
                times = (first.times, second.times)
                if apart is not None and apart < 0.0:
                    # The flow leads back in time: so do the times of the points.
                    times = (-first.times, -second.times)
            sweeps = ((source, first), (target, second))
            refused += [f"{uri}: {sweep.refused_times}" for uri, sweep in sweeps if sweep.refused_times]
            options = self._options
            if options.get("dt_s") is None and apart is not None:
                options = options | {"dt_s": abs(apart)}
            found = flow(first.points, second.points, times=times, **options)
            written = _put_new(filesystem, path, found.to_bytes(self._ending))
        except _native.DeviceError:
            raise
        except REFUSED as error:
            return report | {"outcome": "refused", "error": str(error), "warnings": "; ".join(refused)}
        return report | {
            "outcome": "labelled" if written else "raced",
            "seconds": time.monotonic() - began,
            "points": len(found),
            "moving": 0 if found.clusters is None else int(found.clusters["dynamic"].sum()),
            "warnings": "; ".join(refused + found.warnings),
        }


def _filesystem(uri: str) -> tuple[Any, str]:
    """The file system of a path or URI, and the path in it."""
    from pyarrow import fs

    # Hadoop's name of the same stores.
    uri = re.sub("^s3a://", "s3://", uri)
    scheme, separator, rest = uri.partition("://")
    if not separator:
        return fs.LocalFileSystem(), os.path.abspath(uri)
    authority = AUTHORITY.get(scheme)
    if authority is None or not authority.fullmatch(rest.split("/")[0]) or set(uri) & set("?#\\"):
        known = ", ".join(f"{scheme}://" for scheme in AUTHORITY)
        raise _native.InputError(f"{uri}: a file has a path or a URI of a bucket without options: {known}")
    filesystem, path = fs.FileSystem.from_uri(uri)
    return filesystem, path


def _exists(filesystem: Any, path: str) -> bool:
    from pyarrow import fs

    return bool(filesystem.get_file_info(path).type == fs.FileType.File)


def _sweep(uri: str) -> tuple[Sweep, str]:
    """The sweep of a path or URI, and its path: in a URI the name of the file may be encoded."""
    from pyarrow import fs

    filesystem, path = _filesystem(uri)
    about = filesystem.get_file_info(path)
    if about.type == fs.FileType.NotFound:
        raise FileNotFoundError(f"there is no {uri}")
    # A pipe may never end.
    if about.type != fs.FileType.File or about.size > MAX_FILE:
        raise _native.InputError(f"{uri} is no file of at most {MAX_FILE} bytes")
    with filesystem.open_input_file(path) as file:
        return Sweep(**_native.read_sweep(file.read(about.size), path)), path


def _clock(sweep: Sweep) -> tuple[float, float | None] | None:
    """The duration of a sweep and its time, seconds; none where its file has no times."""
    return None if sweep.duration is None else (sweep.duration, sweep.time)


def _put_new(filesystem: Any, path: str, data: bytes) -> bool:
    """Writes a file unless there is one; whether it was written. It is there whole, or not at all.

    In a bucket, two writers of one key write the same bytes, and the later one stays.
    """
    from pyarrow import fs

    if not isinstance(filesystem, fs.LocalFileSystem):
        with filesystem.open_output_stream(path) as stream:
            stream.write(data)
        return True
    folder = os.path.dirname(path)
    os.makedirs(folder, exist_ok=True)
    part = os.path.join(folder, f".{uuid.uuid4()}.part")
    try:
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        # A link, unlike a rename, does not replace a file that is there.
        os.link(part, path)
    except FileExistsError:
        if os.path.isdir(path):
            raise IsADirectoryError(f"{path} is a folder") from None
        return False
    finally:
        os.unlink(part)
    return True


def ray_label(
    dataset: Any,
    output: str,
    *,
    ending: str = "npz",
    concurrency: int | tuple[int, int] = 1,
    num_cpus: float = 1,
    num_gpus: float = 0,
    batch_size: int = 8,
    **options: Any,
) -> Any:
    """The report of the labels of a Ray dataset with the columns key, source and target, as a Ray dataset.

    Args:
        dataset: a `ray.data.Dataset`.
        output: folder or URI for the labels; every node must reach it.
        ending: format of the labels.
        concurrency: number of actors, or the least and the most.
        num_cpus: CPUs of an actor, which uses as many threads.
        num_gpus: GPUs of an actor, for presets that fit a field.
        batch_size: rows that an actor takes at once, and computes again if it dies before their report.
        options: as in `flow`.
    """
    options.setdefault("threads", max(1, int(num_cpus)))
    return dataset.map_batches(
        Labeller,
        fn_constructor_args=(output,),
        fn_constructor_kwargs={"ending": ending, **options},
        concurrency=concurrency,
        num_cpus=num_cpus,
        num_gpus=num_gpus,
        batch_size=batch_size,
    )


def spark_label(frame: Any, output: str, *, ending: str = "npz", **options: Any) -> Any:
    """The report of the labels of a Spark data frame with the columns key, source and target, as a data frame.

    Args:
        frame: a `pyspark.sql.DataFrame`. Its partitions are the tasks: some hundred rows each are a good size.
        output: folder or URI for the labels; every node must reach it.
        ending: format of the labels.
        options: as in `flow`. `threads` should be `spark.task.cpus`.
    """
    options.setdefault("threads", 1)

    def label(frames: Iterator[Any]) -> Iterator[Any]:
        import pandas

        labeller = Labeller(output, ending=ending, **options)
        for rows in frames:
            # A batch of Arrow is thousands of rows: a report for each is passed on as it is done.
            for first in range(0, len(rows), 8):
                yield pandas.DataFrame(labeller(rows.iloc[first : first + 8]))

    types = {"seconds": "double", "points": "long", "moving": "long"}
    schema = ", ".join(f"{name} {types.get(name, 'string')}" for name in COLUMNS)
    return frame.mapInPandas(label, schema=schema)
