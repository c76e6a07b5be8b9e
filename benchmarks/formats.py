"""Conversions of captures to each format, compared with code that a user would write.

Each conversion runs in a separate process, so that its memory can be measured.
"""

from __future__ import annotations

import functools
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from inputs import Inputs
from libraries import Missing, library
from measure import Contender, Rates
from packet_workloads import Facts, Work

import lidarspec as ls
from lidarspec import formats

#: code that holds all points in memory gets a capture of 1/8 of the size, and 8 such captures are
#: converted together.
SMALLER = 8

#: Runs a command and prints the seconds that passed, those of the processors, and the bytes of
#: memory of its largest process. The command is not started directly, because a child begins with
#: the peak of its parent, which holds the inputs of all workloads. On Linux the launcher also waits
#: for workers without a parent.
LAUNCHER = """
import ctypes, json, os, resource, subprocess, sys, time
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER
start = time.perf_counter()
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
seconds = time.perf_counter() - start
try:
    while True:
        os.wait()
except ChildProcessError:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
unit = 1 if sys.platform == "darwin" else 1024
print(json.dumps([seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * unit]))
sys.exit(code)
"""

#: Code of a user: all points in memory, then one call.
BESIDE = """
import sys
import numpy as np
source, path, sensor, target, out = sys.argv[1:]

def clouds():
    if source == "velodyne-decoder":
        import velodyne_decoder as vd
        config = vd.Config()
        config.model = vd.Model.VLP16
        for _, rows in vd.read_pcap(path, config):
            yield {f"c{number}": column for number, column in enumerate(rows.T)}
        return
    import lidarspec as ls
    with ls.open(path, sensor) as device:
        for scan in device.scans():
            valid = scan.points.valid
            yield {name: column[valid] for name, column in scan.points.columns.items()}

parts = list(clouds())
columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
if target == "np.savez":
    np.savez(out, **columns)
elif target == "pyarrow.csv":
    import pyarrow, pyarrow.csv
    pyarrow.csv.write_csv(pyarrow.table(columns), out)
else:
    import pyarrow, pyarrow.parquet
    pyarrow.parquet.write_table(pyarrow.table(columns), out)
"""
TARGETS = {".npz": "np.savez", ".csv": "pyarrow.csv", ".parquet": "pyarrow.parquet"}


class Captured(NamedTuple):
    """Description of a sensor's captures.

    Attributes:
        title: name of the sensor in the table.
        sensor: id of the sensor.
        rate: bytes of a capture per second.
        suffixes: suffixes of the formats to convert to.
        period: seconds after which the sensor's clock wraps, so that a capture can be repeated.
            0: the whole capture is simulated.
        share: divisor of the usual size of a capture.
    """

    title: str
    sensor: str
    rate: float
    suffixes: tuple[str, ...]
    period: int = 0
    share: int = 1


CAPTURES: Mapping[str, Captured] = {
    "m1": Captured("RS-LiDAR-M1", "robosense-m1", 7.99e6, tuple(formats.BUILT_IN)),
    "stl27l": Captured(
        "STL-27L", "ldrobot-stl27l", 113_400, (".csv", ".parquet", ".mcap"), period=30
    ),
    "vlp16": Captured("VLP-16", "velodyne-vlp16", 1.035e6, tuple(TARGETS), share=SMALLER),
}


@dataclass
class Spent:
    """Resources that a process and its children used.

    Attributes:
        seconds: elapsed time.
        processor: processor time in seconds.
        memory: bytes of the largest process.
        flushed: additional seconds until the output was on the disk.
        size: bytes of the output.
    """

    seconds: float
    processor: float
    memory: int
    flushed: float = 0.0
    size: int = 0


def process(*command: object) -> Spent:
    """Run Python with these arguments, and return the resources it used.

    Modules are compiled once, as in an installation, even if PYTHONDONTWRITEBYTECODE is set.
    """
    line = [sys.executable, "-S", "-c", LAUNCHER, sys.executable, *map(str, command)]
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    }
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return Spent(*json.loads(done.stdout))


def capture(inputs: Inputs, key: str, size: int) -> Path:
    """Return a simulated capture of about `size` bytes."""
    path = inputs.folder / f"{key}-{size}.pcap"
    made = CAPTURES[key]
    if path.exists():
        return path
    if not made.period:
        return write_simulated_capture(path, made.sensor, max(0.2, size / made.rate))
    once = inputs.folder / f"{key}.pcap"
    return write_repeated_capture(
        once if once.exists() else write_simulated_capture(once, made.sensor, made.period),
        path,
        size,
        made.period,
    )


def write_simulated_capture(path: Path, sensor: str, seconds: float) -> Path:
    """Write a capture of a simulated sensor; return its path."""
    line = [
        sys.executable,
        "-m",
        "lidarspec",
        "sim",
        sensor,
        "--to",
        str(path),
        "-t",
        f"{seconds:.1f}s",
    ]
    subprocess.run(line, capture_output=True, check=True)
    return path


def write_repeated_capture(once: Path, path: Path, size: int, period: int) -> Path:
    """Write a capture of about `size` bytes that repeats another one; return its path.

    Each repetition is one period later. All records must have the same length.
    """
    data = np.fromfile(once, np.uint8)
    head = data[:24]
    records = data[24:]
    rows = records.reshape(-1, 16 + int(records[8:12].view("<u4")[0]))
    with path.open("wb") as file:
        file.write(head.tobytes())
        for _ in range(max(1, round(size / rows.size))):
            file.write(rows.tobytes())
            rows[:, :4] = (rows[:, :4].copy().view("<u4") + np.uint32(period)).view(np.uint8)
    return path


@functools.cache
def points_of(path: Path, sensor: str) -> int:
    """Return the number of points that a conversion of the capture writes."""
    with ls.open(path, sensor) as device:
        return sum(int(scan.points.valid.sum()) for scan in device.scans())


def files(out: Path) -> Iterator[Path]:
    """Return an iterator of the file itself, or of all files of a folder."""
    return (file for file in (out.rglob("*") if out.is_dir() else [out]) if file.is_file())


def flush(out: Path) -> None:
    """Wait until a file or folder is on the disk."""
    for file in files(out):
        with file.open("rb") as opened:
            os.fsync(opened)


def clear(folder: Path) -> None:
    """Remove the output of a run.

    Removing a large file takes time, which must not be counted in the next run.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()


def copy(out: Path) -> None:
    """Copy a file or folder to the same folder, and wait until it is on the disk."""
    for number, file in enumerate(list(files(out))):
        flush(Path(shutil.copyfile(file, out.parent / f"copy-{number}")))


class Beside(NamedTuple):
    """A command to compare with: its arguments, number of points, and required modules."""

    command: tuple[object, ...]
    amount: int
    modules: tuple[str, ...] = ()


def compare_conversion(
    title: str,
    out: Path,
    amount: int,
    size: int,
    command: tuple[object, ...],
    commands: Mapping[str, Beside],
) -> Work:
    """Return the workload of a lidarspec command that writes a file or folder.

    It is compared with copying the output and with other commands.
    """
    spent: dict[str, Spent] = {}
    clear(out.parent)

    def run(name: str, command: tuple[object, ...]) -> None:
        spent[name] = process(*command)

    def contender(name: str, other: Beside) -> Contender:
        for module in other.modules:
            library(module)
        return Contender(lambda: run(name, other.command), other.amount, partial(clear, out.parent))

    def after() -> None:
        start = time.perf_counter()
        flush(out)
        spent["ours"].flushed = time.perf_counter() - start
        spent["ours"].size = sum(file.stat().st_size for file in files(out))

    def part(other: Beside) -> str:
        return f" for 1/{round(amount / other.amount)}" if other.amount < amount else ""

    def facts(backend: str, rates: Rates) -> Facts:
        ours = spent["ours"]
        return {
            "s": ours.seconds,
            "s of the processors": ours.processor,
            "MB of memory": ours.memory / 1e6,
            "MB written": ours.size / 1e6,
            "% of the speed of copying that": 100
            * rates["copy"][0]
            * amount
            / (ours.seconds + ours.flushed),
            **{
                f"MB of memory in {name}{part(other)}": spent[name].memory / 1e6
                for name, other in commands.items()
                if name in spent
            },
        }

    return Work(
        title,
        "points",
        amount,
        size,
        lambda backend: partial(run, "ours", ("-m", "lidarspec", "convert", *command)),
        {name: partial(contender, name, other) for name, other in commands.items()},
        lambda backend: {"copy": Contender(partial(copy, out), amount, partial(clear, out.parent))},
        facts,
        has_backends=False,
        after=after,
    )


def convert_one(inputs: Inputs, key: str, suffix: str) -> Work:
    """Return the workload of converting a capture, compared with code of a user."""
    made = CAPTURES[key]
    out = inputs.folder / "out" / f"points{suffix}"
    path = capture(inputs, key, inputs.size // made.share)
    part = capture(inputs, key, inputs.size // SMALLER)
    try:
        with ls.open(part, made.sensor) as device:
            formats.write(inputs.folder / f"one{suffix}", itertools.islice(device.scans(), 1))
    except ls.UsageError as error:
        raise Missing(str(error)) from error
    commands: dict[str, Beside] = {}
    if target := TARGETS.get(suffix):
        needed = () if target == "np.savez" else ("pyarrow",)
        amount = points_of(part, made.sensor)
        commands[target] = Beside(
            ("-c", BESIDE, "lidarspec", part, made.sensor, target, out), amount, needed
        )
        if key == "vlp16":
            line = ("-c", BESIDE, "velodyne-decoder", part, made.sensor, target, out)
            commands[f"velodyne-decoder and {target}"] = Beside(
                line, amount, ("velodyne_decoder", *needed)
            )
    command = (path, out, "-s", made.sensor)
    return compare_conversion(
        f"{made.title} capture to {suffix}",
        out,
        points_of(path, made.sensor),
        path.stat().st_size,
        command,
        commands,
    )


def convert_many(inputs: Inputs, suffix: str) -> Work:
    """Return the workload of converting several captures with four processes or with one."""
    made = CAPTURES["m1"]
    out = inputs.folder / "out" / "points"
    part = capture(inputs, "m1", inputs.size // SMALLER)
    folder = inputs.folder / f"many{suffix}"
    folder.mkdir(exist_ok=True)
    for number in range(SMALLER):
        (folder / f"{number}.pcap").hardlink_to(part)
    amount = SMALLER * points_of(part, made.sensor)
    command = (*sorted(folder.iterdir()), out, "-s", made.sensor, "--to", suffix[1:], "--jobs")
    alone = Beside(("-m", "lidarspec", "convert", *command, 1), amount)
    size = SMALLER * part.stat().st_size
    return compare_conversion(
        f"{SMALLER} captures to {suffix}, 4 processes",
        out,
        amount,
        size,
        (*command, 4),
        {"one process": alone},
    )


CONVERSIONS: Mapping[str, Callable[[Inputs], Work]] = {
    **{
        f"to-{key}{suffix}": partial(convert_one, key=key, suffix=suffix)
        for key, made in CAPTURES.items()
        for suffix in made.suffixes
    },
    **{f"to-many{suffix}": partial(convert_many, suffix=suffix) for suffix in (".parquet", ".csv")},
}
