"""Workloads on packets and streams, compared with other code for the same bytes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import fixed_layouts
import handwritten_packets
import handwritten_serial
import libraries
import numpy as np
from environments import read_failures, separate_python
from inputs import Inputs
from libraries import Missing
from measure import Contender, Rates, Timed, times
from peers import construct_on
from remote_contender import prepare_in

import lidarspec as ls
from lidarspec.packets.packets import Packets
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.simulation.simulator import make_opening_frame
from lidarspec_ouster import make_nominal_unit

Others = dict[str, Callable[[], Timed]]
Facts = dict[str, float]

#: frames that construct parses in one run.
FEW = 150


def no_facts(backend: str, rates: Rates) -> Facts:
    """Return no numbers for the last column."""
    return {}


@dataclass(frozen=True)
class Work:
    """A workload: one line of the table for each back end.

    Attributes:
        title: name of the workload.
        unit: unit of the amount.
        amount: number of units in one run.
        size: bytes of one run; 0 if it is not compared with memcpy.
        ours: returns lidarspec's function for a back end.
        others: contenders to compare with.
        own: returns additional contenders for a back end, for `facts`.
        facts: returns numbers for the last column, from back end and rates.
        has_backends: False if the back end makes no difference.
        after: called after each run of ours, not timed. Set if a run takes so long that it is not
            repeated.
    """

    title: str
    unit: str
    amount: int
    size: int
    ours: Callable[[str], Callable[[], Any]]
    others: Others = field(default_factory=dict)
    own: Callable[[str], dict[str, Contender]] = lambda backend: {}
    facts: Callable[[str, Rates], Facts] = no_facts
    has_backends: bool = True
    after: Callable[[], None] | None = None

    def prepare_others(self) -> tuple[dict[str, Timed], dict[str, str]]:
        """Prepare the contenders; return them, and the reason for each missing one."""
        contenders: dict[str, Timed] = {}
        missing: dict[str, str] = {}
        for name, prepare in self.others.items():
            try:
                contenders[name] = prepare()
            except Missing as error:
                reason = read_failures().get(name)
                missing[name] = f"{error} ({reason})" if reason else str(error)
        return contenders, missing


def columns(cloud: ls.PointCloud) -> tuple[Any, ...]:
    """Return the columns that every workload needs.

    An engine that computes columns on access computes them here.
    """
    if cloud.shape is None:
        return cloud.x, cloud.y, cloud.intensity  # only planar sensors have no shape here
    return cloud.x, cloud.y, cloud.z, cloud.intensity


def points_of(sensor: ls.Sensor, data: Any, backend: str) -> Callable[[], Any]:
    """Return a function that decodes data to x, y, z and intensity."""
    return lambda: columns(sensor.decode(data, backend=backend).points())


def make_plain_decoding(sensor: ls.Sensor, data: Any) -> Callable[[], Any]:
    """Return a function that decodes data with the plain evaluation of `points`."""
    return lambda: columns(evaluate_plainly(sensor.decode(data, backend="numpy")).cloud)


def make_evaluation(packets: Packets) -> Callable[[], Any]:
    """Return a function that computes the points of decoded packets."""
    return lambda: columns(packets.points())


def beside_construct(inputs: Inputs, key: str) -> Others:
    """Prepare construct, plain and compiled, on some undamaged frames of full length."""
    rows = inputs.array(key)
    frames = [row.tobytes() for row in rows[:FEW]]
    points = (
        len(inputs.sensor(key).decode(inputs.array(key)[:FEW]).points())
        if key != "rplidar"
        else len(frames)
    )
    return {
        "construct": lambda: construct_on(key, frames, points, compiled=False),
        "compiled": lambda: construct_on(key, frames, points, compiled=True),
    }


def in_memory(inputs: Inputs, key: str, title: str, more: Others | None = None) -> Work:
    """Return the workload of packets of one length in an array."""
    sensor = inputs.sensor(key)
    rows = inputs.array(key)
    points = len(sensor.decode(rows).points())
    others: Others = {
        **beside_construct(inputs, key),
        "plain": lambda: Contender(make_plain_decoding(sensor, rows), points),
        "by hand": lambda: Contender(lambda: BY_HAND[key](rows), points),
    }
    return Work(
        title,
        "points",
        points,
        rows.size,
        lambda backend: points_of(sensor, rows, backend),
        {**others, **(more or {})},
        lambda backend: {
            "points alone": Contender(make_evaluation(sensor.decode(rows, backend=backend)), points)
        },
        lambda backend, rates: {
            "% of the time for points()": 100 * times(rates, "ours", "points alone")
        },
    )


def in_stream(
    inputs: Inputs,
    key: str,
    title: str,
    data: bytes,
    by_us: Callable[[bytes], Any],
    more: Others,
    facts: Any = no_facts,
) -> Work:
    """Return the workload of a byte stream to points, with framing and checksums."""
    sensor = inputs.sensor(key)
    points = len(sensor.decode(data).points())
    others: Others = {
        **beside_construct(inputs, key),
        "plain": lambda: Contender(make_plain_decoding(sensor, data), points),
        "by hand": lambda: Contender(lambda: by_us(data), points),
    }
    ours: Callable[[str], Any] = lambda backend: points_of(sensor, data, backend)  # noqa: E731
    return Work(title, "points", points, len(data), ours, {**others, **more}, facts=facts)


#: hand-written decoders of packets in an array.
BY_HAND: Mapping[str, Callable[[Any], Any]] = {
    "m1": handwritten_packets.m1_points,
    "stl27l": handwritten_serial.stl27l_points,
    "m1c1": handwritten_serial.m1c1_points,
    "vlp16": handwritten_packets.vlp16_points,
    "xt32": handwritten_packets.xt32_points,
    "rplidar": handwritten_serial.rplidar_points,
}


def vlp16(inputs: Inputs) -> Work:
    return in_memory(
        inputs, "vlp16", "VLP-16 packets, look-ahead", beside_velodyne_decoder(inputs, "vlp16")
    )


def beside_velodyne_decoder(inputs: Inputs, key: str) -> Others:
    """Prepare velodyne-decoder on all packets."""
    frames = inputs.frames(key)
    return {"velodyne-decoder": lambda: libraries.velodyne_packets(key, frames, len(frames) * 384)}


def velodyne(inputs: Inputs, key: str, title: str) -> Work:
    """Return the workload of packets of a model without a handwritten decoder."""
    sensor = inputs.sensor(key)
    rows = inputs.array(key)
    points = len(rows) * 384
    others: Others = {
        "plain": lambda: Contender(make_plain_decoding(sensor, rows), points),
        **beside_velodyne_decoder(inputs, key),
    }
    return Work(
        title, "points", points, rows.size, lambda backend: points_of(sensor, rows, backend), others
    )


def beside_ouster_sdk(prepare: Callable[..., Contender], *arguments: Any) -> Timed:
    """Prepare a contender that uses ouster-sdk."""
    return prepare_in(separate_python("ouster-sdk"), prepare, *arguments)


def ouster(inputs: Inputs) -> Work:
    """Return the workload of every field and the coordinates, compared with ouster-sdk.

    CRCs are not verified, because ouster-sdk does not verify them.
    """
    sensor = inputs.sensor("ouster")
    rows = inputs.array("ouster").copy()
    rows[:, -8:] = 0
    frames = [row.tobytes() for row in rows]
    points = len(sensor.decode(rows).points())
    metadata = json.loads(
        make_nominal_unit("OS1", 128, 1024, "RNG19_RFL8_SIG16_NIR16").to_metadata()
    )

    def ours(backend: str) -> Any:
        cloud = sensor.decode(rows, backend=backend).points()
        return cloud.read("x", "y", "z", "intensity", *cloud.extra)

    return Work(
        "Ouster RNG19 packets of 128 pixels, all fields",
        "points",
        points,
        rows.size,
        lambda backend: lambda: ours(backend),
        {
            "ouster-sdk": lambda: beside_ouster_sdk(
                libraries.ouster_scans, frames, metadata, points
            ),
            "plain": lambda: Contender(make_plain_decoding(sensor, rows), points),
        },
    )


#: frames with parts, counts or conditions: title, the same with every field at a fixed place,
#: whether they come as a stream.
FIXED: Mapping[str, tuple[str, Callable[[ls.Sensor, bytes], ls.Sensor], bool]] = {
    "livox": ("Livox Mid-360 packets, Cartesian", fixed_layouts.livox_packet, False),
    "multiscan": ("multiScan136 telegrams", fixed_layouts.compact_telegram, False),
    "picoscan": ("picoScan150 telegrams", fixed_layouts.compact_telegram, False),
    "colab-tim": ("TiM571 stream, CoLa B", fixed_layouts.cola_telegram, True),
    "colab-lms": ("LMS511 stream, CoLa B", fixed_layouts.cola_telegram, True),
}


def beside_fixed(inputs: Inputs, key: str) -> Work:
    """Return the workload of the sensor's frames, compared with fields at fixed offsets."""
    title, made, is_stream = FIXED[key]
    sensor = inputs.sensor(key)
    simple = made(inputs.sensor(key), inputs.frames(key)[0])
    data: Any = b"".join(inputs.frames(key)) if is_stream else inputs.array(key)
    points = len(sensor.decode(data).points())
    return Work(
        title,
        "points",
        points,
        memoryview(data).nbytes,
        lambda backend: points_of(sensor, data, backend),
        own=lambda backend: {"fixed": Contender(points_of(simple, data, backend), points)},
        facts=lambda backend, rates: {
            "times as long as with fixed places": times(rates, "fixed", "ours")
        },
    )


def in_text(inputs: Inputs, key: str, title: str) -> Work:
    """Return the workload of a stream of frames in text."""
    sensor = inputs.sensor(key)
    data = b"".join(inputs.frames(key))
    points = len(sensor.decode(data).points())
    others: Others = {"plain": lambda: Contender(make_plain_decoding(sensor, data), points)}
    return Work(
        title, "points", points, len(data), lambda backend: points_of(sensor, data, backend), others
    )


def rplidar(inputs: Inputs) -> Work:
    some = inputs.frames("rplidar")[: 10 * FEW]
    return in_memory(
        inputs, "rplidar", "RPLIDAR nodes", {"rplidar": lambda: libraries.rplidar_nodes(some)}
    )


def stl27l_stream(inputs: Inputs) -> Work:
    """Return the workload of a stream with damaged frames and noise.

    Undamaged frames that are not found are counted.
    """
    noisy = inputs.noisy("stl27l")
    sensor = inputs.sensor("stl27l")
    frames = inputs.frames("stl27l")[:FEW]
    more: Others = {
        "lds2d": lambda: libraries.lds2d_stream("LD14P", b"".join(frames), 12 * len(frames))
    }

    def facts(backend: str, rates: Rates) -> Facts:
        found = np.isin(noisy.intact, sensor.decode(noisy.data, backend=backend).offset)
        return {"intact frames": len(noisy.intact), "intact frames lost": int((~found).sum())}

    by_us = handwritten_serial.stl27l_stream
    return in_stream(inputs, "stl27l", "STL-27L stream, 2 % noise", noisy.data, by_us, more, facts)


def m1c1_stream(inputs: Inputs) -> Work:
    frames = inputs.frames("m1c1")[:FEW]
    points = sum(frame[3] for frame in frames)
    more: Others = {"lds2d": lambda: libraries.lds2d_stream("COIN-D4", b"".join(frames), points)}
    return in_stream(
        inputs,
        "m1c1",
        "M1C1_Mini stream",
        inputs.stream("m1c1"),
        handwritten_serial.m1c1_stream,
        more,
    )


def rplidar_stream(inputs: Inputs) -> Work:
    some = inputs.frames("rplidar")[: 10 * FEW]
    first = len(make_opening_frame(inputs.sensor("rplidar")))
    more: Others = {"rplidar": lambda: libraries.rplidar_nodes(some)}
    by_us: Callable[[bytes], Any] = lambda data: handwritten_serial.rplidar_stream(data, first)  # noqa: E731
    return in_stream(
        inputs, "rplidar", "RPLIDAR nodes (stream)", inputs.stream("rplidar"), by_us, more
    )


ON_BYTES: Mapping[str, Callable[[Inputs], Work]] = {
    "m1": lambda inputs: in_memory(inputs, "m1", "RS-LiDAR-M1 packets"),
    "stl27l": lambda inputs: in_memory(inputs, "stl27l", "STL-27L frames"),
    "m1c1": lambda inputs: in_memory(inputs, "m1c1", "M1C1_Mini packets of 25 samples, corrected"),
    "vlp16": vlp16,
    "vlp32c": lambda inputs: velodyne(inputs, "vlp32c", "VLP-32C packets, look-ahead"),
    "vls128": lambda inputs: velodyne(inputs, "vls128", "VLS-128 packets, look-ahead"),
    "xt32": lambda inputs: in_memory(inputs, "xt32", "Pandar XT32 packets"),
    "ouster": ouster,
    **{key: partial(beside_fixed, key=key) for key in FIXED},
    "colaa": lambda inputs: in_text(inputs, "colaa", "TiM571 stream, CoLa A"),
    "scip": lambda inputs: in_text(inputs, "scip", "UTM-30LX-EW stream, SCIP"),
    "rplidar": rplidar,
    "stl27l-stream": stl27l_stream,
    "m1c1-stream": m1c1_stream,
    "rplidar-stream": rplidar_stream,
}
