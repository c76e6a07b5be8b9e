"""Record the engine's results on fixed bytes of every sensor, and compare versions.

    make referee ARGS=--record     write the record: run this on the tree before a change
    make referee                   compare: list the differences of this tree, and exit with 1

The record holds its inputs: example frames, a simulated stream, and damaged copies of both. So a
change of the generators does not change the compared inputs. `tests/cli/test_golden.py` compares
the output of the command line.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import itertools
import json
import lzma
import random
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import lidarspec as ls
from lidarspec import Sensor
from lidarspec.errors import LidarSpecError
from lidarspec.testing.sensor_under_test import mutate
from tests.every_sensor import every_sensor

RECORD = Path(__file__).parents[1] / ".referee" / "record.json.xz"
#: examples of each frame type.
EXAMPLES = 3
#: damaged frames of each sensor, all frame types in turn.
DAMAGED = 200
#: bytes and packets of a simulated stream, at most.
STREAM_BYTES, STREAM_PACKETS = 60_000, 120
#: differences that are printed for one sensor.
PRINTED = 5

#: what was found, by what it is of: "frame data, seed 1: parsed" -> a digest or a text.
Results = dict[str, str]


def main() -> int:
    """Return 1 if anything differs from the record, else 0."""
    parser = argparse.ArgumentParser(
        prog="make referee",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--record", action="store_true", help="write the record instead of comparing with it"
    )
    parser.add_argument(
        "--file", type=Path, default=RECORD, help=f"the record; default: {RECORD.name}"
    )
    given = parser.parse_args()
    if given.record:
        record = _for_each(_inputs_and_results, [(name,) for name in every_sensor()])
        given.file.parent.mkdir(parents=True, exist_ok=True)
        given.file.write_bytes(lzma.compress(json.dumps(record).encode(), preset=1))
        print(
            f"{len(record)} sensors, {sum(len(one['results']) for one in record.values())} results"
        )
        return 0
    record = json.loads(lzma.decompress(given.file.read_bytes()))
    found = _for_each(_results_of, [(name, one["inputs"]) for name, one in record.items()])
    different = 0
    for name, one in record.items():
        different += _report(name, one["results"], found[name])
    for name in every_sensor().keys() - record.keys():
        print(f"{name}: not in the record")
    print(
        f"{len(record)} sensors, {sum(len(one['results']) for one in record.values())} results,"
        f" {different} differences"
    )
    return int(different > 0)


def _for_each(function: Any, arguments: list[tuple[Any, ...]]) -> dict[str, Any]:
    """Return what a function makes of each sensor, by id, in several processes."""
    with ProcessPoolExecutor() as pool:
        made = pool.map(function, *zip(*arguments, strict=True), chunksize=4)
        return {name: result for (name, *_), result in zip(arguments, made, strict=True)}


def _report(name: str, before: Results, now: Results) -> int:
    """Print the differences of one sensor, and return their number."""
    keys = [key for key in before.keys() | now.keys() if before.get(key) != now.get(key)]
    for key in sorted(keys)[:PRINTED]:
        print(f"{name}, {key}:\n    {before.get(key, 'nothing')}\n    {now.get(key, 'nothing')}")
    if len(keys) > PRINTED:
        print(f"{name}: and {len(keys) - PRINTED} more")
    return len(keys)


def _inputs_and_results(name: str) -> dict[str, Any]:
    inputs = _make_inputs(every_sensor()[name])
    return {"inputs": inputs, "results": _results_of(name, inputs)}


def _make_inputs(sensor: Sensor) -> dict[str, list[Any]]:
    """Return the inputs of a sensor in base64, with the names of their frame types."""
    chance = random.Random(sensor.id)
    frames = [
        (name, sensor.example(name, seed=seed))
        for name in sensor.frames
        for seed in range(EXAMPLES)
    ]
    damaged = [
        (name, mutate(data, chance))
        for name, data in itertools.islice(itertools.cycle(frames), DAMAGED)
    ]
    stream = _make_stream(sensor)
    broken = [mutate(data, chance) if chance.random() < 0.1 else data for data in stream]
    return {
        "frames": [(name, _encode(data)) for name, data in frames],
        "damaged": [(name, _encode(data)) for name, data in damaged],
        "stream": [_encode(data) for data in stream],
        "broken": [_encode(data) for data in broken],
    }


def _make_stream(sensor: Sensor) -> list[bytes]:
    """Return the frames of a simulated sensor, or examples of its data frames if it cannot be
    simulated.
    """
    try:
        frames = ls.simulate(sensor, STREAM_PACKETS)
    except LidarSpecError:
        frames = [
            sensor.example(name, seed=seed)
            for name in sensor.data_frames
            for seed in range(EXAMPLES)
        ]
    sizes = itertools.accumulate(map(len, frames))
    return [
        frame for frame, size in zip(frames, sizes, strict=True) if size <= STREAM_BYTES
    ] or frames[:1]


def _results_of(name: str, inputs: dict[str, list[Any]]) -> Results:
    """Return what the engine makes of the inputs of one sensor."""
    sensor, found = every_sensor()[name], Results()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for kind in ("frames", "damaged"):
            for number, (frame, text) in enumerate(inputs[kind]):
                found |= _results_of_frame(
                    sensor, frame, f"{kind} {number}, {frame}", _decode(text)
                )
        for frame, texts in itertools.groupby(inputs["frames"], key=lambda pair: pair[0]):
            parts = [_decode(text) for _, text in texts]
            found |= _results_of_table(sensor, frame, parts)
        for kind in ("stream", "broken"):
            parts = [_decode(text) for text in inputs[kind]]
            found |= _results_of_stream(
                sensor, kind, parts if sensor.datagrams else b"".join(parts)
            )
    return found


def _results_of_frame(sensor: Sensor, frame: str, key: str, data: bytes) -> Results:
    """Return what a frame is parsed as, and whether it is built again; or the error."""
    try:
        parsed = sensor.parse(data, frame=frame)
        built = sensor.build(frame, parsed)
        typed = sensor.parse(data)
    except LidarSpecError as error:
        return {f"{key}: error": f"{type(error).__name__}: {error}"}
    return {
        f"{key}: parsed": _digest(json.dumps(_plain(parsed))),
        f"{key}: built": "the same" if built == data else built.hex(),
        f"{key}: with its type found": _digest(json.dumps(_plain(typed))),
    }


def _results_of_table(sensor: Sensor, frame: str, parts: list[bytes]) -> Results:
    """Return the raw table of some frames of one type."""
    if frame not in sensor.incoming:
        return {}
    key = f"table {frame}"
    try:
        packets = sensor.decode(parts if sensor.datagrams else b"".join(parts), frame)
        raw = packets.raw
    except LidarSpecError as error:
        return {f"{key}: error": f"{type(error).__name__}: {error}"}
    return {
        f"{key}: layout": str(raw.dtype),
        f"{key}: values": _digest(raw.tobytes()),
        f"{key}: counters": str(packets.stats),
    }


def _results_of_stream(sensor: Sensor, kind: str, data: Any) -> Results:
    """Return points, scans and counters of a stream."""
    try:
        packets = sensor.decode(data)
        cloud = packets.points()
        found = {
            f"{kind}, points, {name}": _digest(np.ascontiguousarray(column).tobytes())
            for name, column in cloud.columns.items()
        }
        found[f"{kind}, counters"] = repr(packets.stats)
        for number, scan in enumerate(sensor.scans(data)):
            said = (len(scan.points), scan.stamp_ns, scan.complete, scan.whole)
            columns = (
                np.ascontiguousarray(column).tobytes() for column in scan.points.columns.values()
            )
            found[f"{kind}, scan {number}"] = f"{said} {_digest(b''.join(columns))}"
    except LidarSpecError as error:
        return {f"{kind}: error": f"{type(error).__name__}: {error}"}
    return found


def _plain(value: Any) -> Any:
    """Return a parsed value in types that JSON has."""
    if isinstance(value, dict):
        return {str(key): _plain(part) for key, part in value.items() if key != "_io"}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, bytes | bytearray):
        return bytes(value).hex()
    return value if isinstance(value, bool | int | float | str | None) else repr(value)


def _digest(data: str | bytes) -> str:
    return hashlib.blake2b(
        data.encode() if isinstance(data, str) else data, digest_size=12
    ).hexdigest()


def _encode(data: bytes) -> str:
    return base64.b85encode(data).decode()


def _decode(text: str) -> bytes:
    return base64.b85decode(text)


if __name__ == "__main__":
    sys.exit(main())
