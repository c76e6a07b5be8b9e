"""Tests that the fused back end gives the points of the reference evaluator.

Masks are equal, coordinates within six units in the last place.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from construct import Bytes, Int8ub, Struct, this

import lidarspec
from lidarspec import Packets, Sensor, UsageError, simulate
from lidarspec.frames.frame_table import CompiledTable
from lidarspec.frames.layout import FrameChecksum
from lidarspec.frames.row_checksums import compute_checksums
from lidarspec.points import backends
from lidarspec.points.evaluate import evaluate
from lidarspec.points.numba_kernels import checksums as kernelsums
from lidarspec.points.numba_kernels.source import write_kernel
from lidarspec.points.plan import Plan, plan_for
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.simulation.simulator import make_opening_frame
from lidarspec.spec import Checksum, Checksummed, Crc, Fields, Polar, WordXor, Xor
from lidarspec.spec.links import is_datagram
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.agreement import assert_same_points
from tests.engine import against_construct
from tests.installed import sensor_modules, sensors_in
from tests.points.backends import COMPILED
from tests.representatives import REPRESENTATIVES
from tests.shapes import SHAPES

pytestmark = COMPILED

#: the shape of which a kernel is compiled in the quick tier.
QUICK = "shape-middle"
#: Shapes that differ in how their points are computed; the others differ in framing and headers.
POINT_SHAPES = (
    QUICK,
    "shape-nested",
    "shape-ahead",
    "shape-state",
    "shape-calibration",
    "shape-options",
    "shape-clock",
    "shape-echoes",
    "shape-extras",
    "shape-grid",
    "shape-columns",
    "shape-scales",
    "shape-segments",
    "shape-tags",
    "shape-channels",
    "shape-choices",
    "shape-joined",
    "shape-floats",
)
#: The representatives without the one whose points are declared for parts alone, which have no
#: kernel.
COMPILED_REPRESENTATIVES = [name for name in REPRESENTATIVES if name != "sick-multiscan136"]


def tier_of(shape: str) -> tuple[pytest.MarkDecorator, ...]:
    """Return the marks of a test that compiles the kernel of a shape."""
    if shape == QUICK:
        return ()
    return (pytest.mark.slow,) if shape in POINT_SHAPES else (pytest.mark.soak,)


SHAPED = [
    pytest.param(name, marks=tier_of(name)) for name, sensor in SHAPES.items() if sensor.frames
]
ULPS = 6
WIDE = [
    Crc(64, 0x42F0E1EBA9EA3693, init=(1 << 64) - 1, refin=True, refout=True, xorout=(1 << 64) - 1),
    Crc(32, 0x04C11DB7, init=0xFFFFFFFF),
    Crc(24, 0x864CFB, init=0xB704CE, refin=True),
]
MANY = 16


def sensor_of(name: str) -> Sensor:
    """Return a shape or an installed sensor."""
    return SHAPES[name] if name in SHAPES else lidarspec.sensor(name)


@functools.cache
def frames_of(name: str) -> list[bytes]:
    sensor = sensor_of(name)
    return [sensor.example(sensor.data_frame, seed=seed) for seed in range(MANY)]


def packets_of(name: str, number: int) -> Packets:
    sensor, frames = sensor_of(name), frames_of(name)[:number]
    data: Any = frames if is_datagram(sensor.links.get("data")) else b"".join(frames)
    return sensor.decode(data, backend="jit").with_points


@pytest.mark.parametrize("name", SHAPED)
def test_kernels_equal_the_reference_evaluator(name: str) -> None:
    for number in (1, 7, MANY):
        packets = packets_of(name, number)
        if len(packets):
            assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud, ulps=ULPS)
            one, other = (
                evaluate(packets, final=False, stamp_ns=5),
                evaluate_plainly(packets, final=False, stamp_ns=5),
            )
            assert_same_points(one.cloud, other.cloud, ulps=ULPS)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SHAPED, "ldrobot-stl27l", "velodyne-vlp16"])
def test_every_column_of_damaged_and_mixed_streams(name: str) -> None:
    sensor = sensor_of(name)
    packets = sensor.decode(SensorUnderTest(sensor).stream(), backend="jit").with_points
    if len(packets):
        assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud, ulps=ULPS)


def answers_in(module: str) -> list[tuple[Sensor, str]]:
    """Load each data frame of a module with each of its `points` functions, once.

    Several sensors may share both.
    """
    answers: dict[tuple[int, object], tuple[Sensor, str]] = {}
    for sensor in sensors_in(module):
        for answer, frame in sensor.frames.items():
            if frame.data and not isinstance(frame.points, Mapping):
                answers[id(frame), sensor.points_of(answer)] = (sensor, answer)
    return list(answers.values())


def decode_simulated(sensor: Sensor, answer: str, backend: str, number: int = 2 * MANY) -> Packets:
    configured = sensor if answer == sensor.data_frame else sensor.configure(answer=answer)
    frames = simulate(configured, number)
    data: Any = frames
    if not is_datagram(configured.links.get("data")):
        data = make_opening_frame(configured) + b"".join(frames)
    return configured.decode(data, backend=backend)


@pytest.mark.soak
@pytest.mark.parametrize("module", sensor_modules())
def test_every_installed_sensor_has_a_kernel(module: str) -> None:
    for sensor, answer in answers_in(module):
        made = plan(
            decode_simulated(sensor, answer, "numpy", number=max(sensor.frames[answer].confirm, 2))
        )
        assert "def kernel(" in write_kernel(made, tuple(made.expressions), made.varying).source, (
            sensor.id
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPILED_REPRESENTATIVES)
def test_kernels_of_representatives_give_the_plain_points(name: str) -> None:
    sensor = lidarspec.sensor(name)
    assert_kernel_gives_the_plain_points(sensor, sensor.data_frame)


@pytest.mark.soak
@pytest.mark.parametrize("module", sensor_modules())
def test_kernels_of_every_sensor_give_the_plain_points(module: str) -> None:
    for sensor, answer in answers_in(module):
        assert_kernel_gives_the_plain_points(sensor, answer)


def assert_kernel_gives_the_plain_points(sensor: Sensor, answer: str) -> None:
    packets = decode_simulated(sensor, answer, "jit")
    cloud = packets.points()
    assert_same_points(cloud, evaluate_plainly(packets).cloud, ulps=ULPS)
    assert cloud.valid.any(), sensor.id
    assert any(kernel.is_ready for kernel in plan(packets).kernels.values()), sensor.id


def plan(packets: Packets) -> Plan:
    assert isinstance(packets.table, CompiledTable)
    found = plan_for(
        packets.sensor.points_of(packets.frame), packets.batch(), packets.table.groups[0]
    )
    assert isinstance(found, Plan), str(found)
    return found


@pytest.mark.slow
def test_any_number_of_threads_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = lidarspec.sensor("velodyne-vlp16")
    rows = np.tile(
        np.frombuffer(b"".join(frames_of("velodyne-vlp16")), np.uint8).reshape(MANY, -1), (40, 1)
    )
    alone = sensor.decode(rows, backend="jit").points()
    for number in ("2", "3"):
        monkeypatch.setenv("LIDARSPEC_THREADS", number)
        cloud = sensor.decode(rows, backend="jit").points()
        for name, column in alone.columns.items():
            np.testing.assert_array_equal(cloud.columns[name], column)
    monkeypatch.setenv("LIDARSPEC_THREADS", "many")
    with pytest.raises(UsageError, match="LIDARSPEC_THREADS must be a number"):
        len(sensor.decode(rows, backend="jit").points().x)


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [False, True])
def test_kernels_are_chosen_after_enough_points(
    compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = dataclasses.replace(
        lidarspec.sensor("ldrobot-stl27l"), points=functools.partial(points_of_another_kind)
    )
    packets = sensor.decode(b"".join(frames_of("ldrobot-stl27l")))
    enough = 3 * 12 * len(packets)
    monkeypatch.setattr(backends, "MIN_WARM_KERNEL_POINTS", enough if compiled else 0)
    monkeypatch.setattr(backends, "MIN_COLD_KERNEL_POINTS", 10 * enough if compiled else enough)
    monkeypatch.setattr(
        "lidarspec.points.numba_kernels.kernels.is_code_available", lambda source: compiled
    )
    used = []
    for _ in range(4):
        cloud = packets.points()
        assert_same_points(cloud, evaluate_plainly(packets).cloud, ulps=ULPS)
        used.append(any(kernel.is_ready for kernel in plan(packets).kernels.values()))
    assert used == [False, False, True, True]


def points_of_another_kind(f: Fields) -> Polar:
    return Polar(
        range=f.points.distance,
        azimuth=np.deg2rad(f.start_angle + 2 * np.arange(12)),
        intensity=f.points.intensity,
    )


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


DECODING = """
import sys, lidarspec as ls
sensor = ls.sensor("ldrobot-stl27l")
x = sensor.decode(sensor.example("data") * 3).points().x
print(bool(sys.modules.get("numba")), len(x))
"""


@pytest.mark.slow
def test_the_environment_names_the_default_and_nothing_else_imports_numba() -> None:
    assert run(DECODING).stdout.split() == ["False", "36"]
    assert run(DECODING, LIDARSPEC_BACKEND="jit").stdout.split() == ["True", "36"]
    wrong = run(DECODING, LIDARSPEC_BACKEND="fast")
    assert "LIDARSPEC_BACKEND must be one of auto, numpy, jit, not 'fast'" in wrong.stderr


@pytest.mark.slow
def test_kernels_are_cached_if_possible(
    tmp_path: Path,
) -> None:
    code = (
        DECODING + "print(any(m.kernel.stats.cache_hits for name, m in sys.modules.items() if"
        " name.startswith('lidarspec_kernel_')))"
    )
    for is_read in ("False", "True"):
        done = run(code, LIDARSPEC_BACKEND="jit", LIDARSPEC_CACHE=str(tmp_path / "kept"))
        assert done.stdout.split() == ["True", "36", is_read], done.stderr
    occupied = tmp_path / "file"
    occupied.write_text("not a folder")
    done = run(DECODING, LIDARSPEC_BACKEND="jit", LIDARSPEC_CACHE=str(occupied))
    assert done.stdout.split() == ["True", "36"], done.stderr
    assert done.stderr.count("UserWarning: compiled code cannot be stored for later runs: ") == 1


@pytest.mark.slow
def test_without_numba_asking_for_it_is_an_error_and_nothing_else_is() -> None:
    hidden = "import sys; sys.modules['numba'] = None\n"
    assert run(hidden + DECODING).stdout.split() == ["False", "36"]
    asked = run(hidden + DECODING.replace("* 3)", "* 3, backend='jit')"))
    assert "LibraryError: numba" in asked.stderr
    assert "pip install 'lidarspec[jit]'" in asked.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "algorithm",
    [
        Crc(8, 0x4D),
        Crc(16, 0x1021, init=0xFFFF),
        Crc(13, 0x1CF5, refin=True, refout=True),
        Xor(),
        WordXor(8, (1, 2)),
        *WIDE,
    ],
)
@pytest.mark.parametrize("spans", [((0, 46),), ((0, 8), (10, 45))])
def test_compiled_checksums_are_those_of_the_algorithm(
    algorithm: Checksum, spans: tuple[tuple[int, int], ...]
) -> None:
    rows = np.random.default_rng(1).integers(
        0, 256, (kernelsums.MIN_FRAMES_SEEN, 50), dtype=np.uint8
    )
    checksum = FrameChecksum((), spans, algorithm, ())
    found = kernelsums.checksums(checksum, rows)
    assert found is not None
    covered = np.concatenate([rows[:, start:stop] for start, stop in spans], axis=1)
    np.testing.assert_array_equal(found, compute_checksums(algorithm, covered), strict=True)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [Crc(16, 0x1021, init=0xFFFF), *WIDE])
def test_crcs_over_long_rows_are_those_of_the_algorithm(algorithm: Crc) -> None:
    rows = np.random.default_rng(1).integers(0, 256, (19, 2000), dtype=np.uint8)
    spans = ((1, 1003), (1005, 1998))
    found = kernelsums.checksums(FrameChecksum((), spans, algorithm, ()), rows)
    assert found is not None
    covered = np.concatenate([rows[:, start:stop] for start, stop in spans], axis=1)
    assert found.tolist() == [algorithm(row.tobytes()) for row in covered]


@pytest.mark.slow
def test_checksums_are_compiled_for_the_decoder_that_asks_and_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(kernelsums, "checksums", lambda checksum, rows: asked.append(len(rows)))
    for name in ("ldrobot-stl27l", "shape-count"):
        data = b"".join(frames_of(name))
        compiled, plain = (sensor_of(name).decoder(backend=backend) for backend in ("jit", "numpy"))
        before = len(asked)
        assert compiled.feed(data)
        assert len(asked) > before
        before = len(asked)
        assert plain.feed(data)
        assert len(asked) == before


@pytest.mark.slow
def test_streams_are_cut_equally() -> None:
    sensor = lidarspec.sensor("ldrobot-stl27l")
    data = b"".join(b"".join(frames_of("ldrobot-stl27l")) + b"T,T" for _ in range(400))
    one, other = (sensor.decode(data, backend=backend) for backend in ("numpy", "jit"))
    np.testing.assert_array_equal(one.offset, other.offset)
    assert one.stats == other.stats


@pytest.mark.slow
def test_a_checksum_over_no_bytes() -> None:
    part = Checksummed(Struct("text" / Bytes(this._.size % 3), "sum" / Int8ub), "sum", Crc(8, 0x4D))
    sensor = against_construct.sensor(Struct("size" / Int8ub, "part" / part))
    packets = sensor.decode([b"\0\0", b"\3\0", b"\0\1"], backend="jit")
    assert (len(packets), packets.stats.bad_checksum, packets.stats.plugin_errors) == (2, 1, 0)
