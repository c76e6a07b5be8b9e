"""Tests of the invented sensors' points, calculated by hand, on both paths."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from construct import Array, Const, ConstructError, Int8ub, Int16ub, Int16ul, Rebuild, Struct, this

from lidarspec import PointCloud, Sensor, SpecError, UsageError, simulate
from lidarspec.errors import OutOfRange, PluginError
from lidarspec.spec import (
    Checksummed,
    Frame,
    Polar,
    Scaled,
    Simulation,
    Sum,
    Xor,
    along,
    spread,
    steps,
    wrap,
)
from tests.agreement import assert_same_points
from tests.by_construct import reader
from tests.engine import against_construct
from tests.shapes import SHAPES, calibration

both = pytest.mark.parametrize("backend", ["auto", "construct"])


def degrees(cloud: PointCloud) -> list[float]:
    return [round(float(angle), 3) for angle in np.rad2deg(cloud.azimuth)]


def cloud_of(sensor: Sensor, *frames: bytes, backend: str) -> PointCloud:
    return (
        reader(sensor, backend)
        .decode(list(frames) if sensor.datagrams else b"".join(frames))
        .points()
    )


@both
def test_counts_spread_the_angles_and_wrap(backend: str) -> None:
    sensor = SHAPES["shape-count"]

    def frame(first: int, last: int, *distances: int) -> bytes:
        return sensor.build(
            "data", first=first, last=last, samples=[dict(distance=d, quality=9) for d in distances]
        )

    cloud = cloud_of(
        sensor, frame(35000, 2000, 1000, 2000, 0, 4660), frame(9000, 12000, 500), backend=backend
    )
    assert degrees(cloud) == [10.0, 0.0, -10.0, -20.0, -90.0]
    assert cloud.range.tolist() == pytest.approx([1.0, 2.0, np.inf, 4.66, 0.5])
    assert cloud.valid.tolist() == [True, True, False, True, True]
    np.testing.assert_allclose(cloud.xyz[4], [0, -0.5, 0], atol=1e-6)
    packets = reader(sensor, backend).decode(frame(0, 10, 1, 2, 3) + frame(0, 10, 7))
    assert packets.count("samples").tolist() == [3, 1]
    assert packets.raw["samples"]["distance"].tolist() == [[1, 2, 3], [7, 0, 0]]


@both
def test_the_index_of_a_sample_is_as_long_as_the_arrays_of_the_batch(backend: str) -> None:
    shape = SHAPES["shape-count"]
    timed = replace(shape, points=lambda f: replace(shape.points(f), time=steps(f.count) / 100))
    short = timed.build("data", first=0, last=100, samples=[dict(distance=1000, quality=9)] * 2)
    long = timed.build("data", first=0, last=100, samples=[dict(distance=1000, quality=9)] * 3)
    assert cloud_of(timed, short, backend=backend).time.tolist() == pytest.approx([0, 0.01])
    assert cloud_of(timed, short, long, short, backend=backend).time.tolist() == pytest.approx(
        [0, 0.01, 0, 0.01, 0.02, 0, 0.01]
    )
    assert steps(3).tolist() == [0, 1, 2]


def test_a_spread_that_folds_everything_onto_one_value_says_so() -> None:
    shape = SHAPES["shape-count"]
    folded = replace(
        shape,
        points=lambda f: replace(shape.points(f), time=spread(0, f.count - 1, f.count, full=1.0)),
    )
    packets = folded.decode(b"".join(shape.example("data", seed=seed) for seed in range(3)))
    with pytest.raises(
        PluginError, match=r"multiple of a revolution \(1\)\. Pass .*steps\(count\)"
    ):
        packets.points()


def test_a_sweep_of_one_beam_starts_and_ends_at_its_start() -> None:
    with np.errstate(all="raise"):
        for count in (1, np.array([[1.0]])):
            np.testing.assert_array_equal(
                spread(np.array([[350.0]]), np.array([[10.0]]), count, full=360.0), [[350.0]]
            )
        np.testing.assert_array_equal(
            spread(np.array([[350.0]]), np.array([[10.0]]), 3, full=360.0), [[350, 360, 370]]
        )
        np.testing.assert_array_equal(
            spread(np.array([[5.0]]), np.array([[5.0]]), 2, full=360.0), [[5, 5]]
        )
    assert wrap(np.array([360.0, -1e-20, 725.0]), 360.0).tolist() == [0, 0, 5]


def test_a_length_that_follows_from_another_is_filled_in_wherever_a_frame_is_made() -> None:
    sensor = SHAPES["shape-sized"]
    built = sensor.build("data", angle=0, samples=[dict(quality=1, distance=2000)] * 4)
    examples = [sensor.example("data", seed=seed) for seed in range(20)]
    for frame in (built, *examples, *simulate(sensor, 4)):
        parsed = sensor.parse(frame)
        assert (parsed.length, parsed.size) == (len(frame) - 2, len(frame) - 7)
        assert sensor.build("data", parsed) == frame
    assert len({len(frame) for frame in examples}) > 3
    wrong = Sum(16)(built[:1] + b"\0\0" + built[3:-2]).to_bytes(2, "big")
    assert len(sensor.decode(built[:1] + b"\0\0" + built[3:-2] + wrong)) == 0


def test_a_length_may_follow_from_a_constant() -> None:
    struct = Struct(
        "magic" / Const(b"SZ"),
        "length" / Rebuild(Int16ub, this.size + 5),
        "size" / Const(1, Int16ub),
        "speed" / Int16ub,
    )
    shape = SHAPES["shape-sized"]
    sensor = replace(
        shape,
        frames={
            **shape.frames,
            "speed": Frame(struct, max_length=8, plausible=lambda f: f.length == 6),
        },
    )
    assert sensor.build("speed", speed=7) == b"SZ\0\6\0\1\0\7"
    assert sensor.parse(sensor.example("speed"), "speed").length == 6


def test_plausible_frames_are_found_around_the_lengths_of_the_sweep() -> None:
    """Two lengths depend on each other, but the frame does not declare how.

    Random lengths would never be plausible.
    """
    shape = SHAPES["shape-sized"]
    children = [
        child if child.name != "length" else "length" / Int16ub
        for child in shape.frames["data"].struct.subcon.subcons
    ]
    plain = dataclasses.replace(
        shape.frames["data"], struct=Checksummed(Struct(*children), "sum", Sum(16))
    )
    sensor = replace(
        shape,
        frames={"data": plain},
        simulation=Simulation(
            lambda i: dict(length=7 + 3 * (i % 9), size=2 + 3 * (i % 9), angle=7.0)
        ),
    )
    assert len({len(sensor.example("data", seed=seed)) for seed in range(8)}) > 2


@both
def test_bit_fields_in_both_orders(backend: str) -> None:
    sensor = SHAPES["shape-bits"]
    sample = dict(distance=0x1234, mode=1, intensity=0xAB)
    values: dict[str, Any] = dict(
        first=0x012345,
        drift=-2,
        little=[sample] * 6,
        big=[sample] * 6,
        mirrored=dict(flags=1, tilt=-3),
    )
    data = sensor.build("data", **values)
    assert data[2:5] == bytes.fromhex("45 23 01")
    assert data[5:8] == bytes.fromhex("ff ff fe")
    # 0x1234 << 10 | 1 << 8 | 0xab = 0x48d1ab, low byte first.
    assert data[8:11] == bytes.fromhex("ab d1 48")
    assert data[26:29] == bytes.fromhex("48 d1 ab")
    assert data[44] == int(f"{1 << 5 | 0b11101:08b}"[::-1], 2)
    packets = reader(sensor, backend).decode(data)
    assert packets["little.distance"][0, 0] == packets["big.distance"][0, 5] == pytest.approx(4.66)
    assert (packets["drift"][0], packets["mirrored.tilt"][0]) == (pytest.approx(-0.002), -3)
    cloud = packets.points()
    assert len(cloud) == 12
    assert set(cloud.intensity.tolist()) == {0xAB}  # type: ignore[union-attr]
    assert cloud.return_index.tolist() == [0, 1] * 6  # type: ignore[union-attr]


def test_checksums_are_at_their_declared_positions() -> None:
    middle = SHAPES["shape-middle"].build(
        "data", angle=0x1234, samples=[dict(quality=1, distance=0x0203)] * 4
    )
    words = middle[:4] + middle[6:]
    low, high = words[0] ^ words[2], words[1] ^ words[3]
    for quality, distance_low, distance_high in zip(
        words[4::3], words[5::3], words[6::3], strict=True
    ):
        low, high = low ^ quality ^ distance_low, high ^ distance_high
    assert middle[4:6] == bytes([low, high])
    nibbles = SHAPES["shape-nibbles"].build("data", angle=64, distances=[1, 2, 3, 4, 0x1234])
    check = Xor()(nibbles[2:])
    assert nibbles[:2] == bytes([0xA0 | check & 15, 0x50 | check >> 4])
    nested = SHAPES["shape-nested"]
    frame = nested.build("data", header=dict(angle=0x1234), distances=[1, 2, 3], serial=b"abc")
    assert frame[4] == sum(frame[:4]) & 0xFF
    other = nested.build("data", header=dict(angle=0x1234), distances=[1, 2, 3], serial=b"abd")
    assert frame[14:18] == other[14:18]


@pytest.mark.parametrize(
    "name", ["shape-middle", "shape-nibbles", "shape-nested", "shape-twice", "shape-sized"]
)
def test_a_checksummed_struct_parses_and_builds_without_a_sensor(name: str) -> None:
    """An author tries the struct first, without a sensor."""
    sensor = SHAPES[name]
    struct, frame = sensor.frames["data"].struct, sensor.example("data")
    parsed = struct.parse(frame)
    assert parsed == sensor.parse(frame)
    assert struct.build(parsed) == frame
    with pytest.raises(ConstructError, match=r"expected .*, got"):
        struct.parse(frame[:-1] + bytes([frame[-1] ^ 1]))


@both
def test_following_reaches_across_packets_but_not_losses(backend: str) -> None:
    sensor = SHAPES["shape-ahead"]

    def frame(angle: int, lift: int, distance: int) -> bytes:
        return sensor.build("data", angle=angle, lift=lift, distances=[distance] * 8)

    frames = [
        frame(35600, 0, 1000),
        frame(400, 20, 2000),
        frame(1200, 0, 3000),
        frame(9000, 0, 1000),
        frame(9400, 0, 1000),
    ]
    cloud = cloud_of(sensor, *frames[:3], b"lost", *frames[3:], backend=backend)
    angles = degrees(cloud)
    assert angles[:9] == [-4, -3, -2, -1, 0, 1, 2, 3, 4]
    assert angles[16:18] == [
        12,
        13,
    ]  # nothing follows before the loss: the step of the packet before
    assert angles[24:28] == [90, 90.5, 91, 91.5]
    lifts = np.rad2deg(cloud.elevation[::8])
    np.testing.assert_allclose(lifts, [0, 2, 2, 2, 2], atol=1e-5)
    spots = np.flatnonzero(cloud.valid)
    assert spots[0] == 1  # the first beam has none before it
    assert cloud.range[8] == pytest.approx((1000 + 2000 + 2000) / 3000)
    assert np.isnan(cloud.range[23])
    assert np.isnan(cloud.range[24])


@both
def test_state_values_align_with_the_axes_of_points(backend: str) -> None:
    sensor = SHAPES["shape-state"]
    block = dict(azimuth=1000, channels=[dict(distance=500)] * 4)
    data = sensor.build(
        "data",
        twist=[0, 100, 0, 200],
        lag=[0, 10, 20],
        blocks=[block, block, dict(block, azimuth=2000)],
    )
    nominal = cloud_of(sensor, data, backend=backend)
    assert bool(nominal.nominal)
    assert degrees(nominal) == [10, 11, 10, 12, 10, 11, 10, 12, 20, 21, 20, 22]
    np.testing.assert_allclose(np.rad2deg(nominal.elevation), [-3, -1, 1, 3] * 3, atol=1e-5)
    np.testing.assert_allclose(nominal.time, np.repeat([0, 1e-5, 2e-5], 4), atol=1e-12)
    info = sensor.build("info", zero=500, vertical=[-100, 0, 100, 200])
    # Reading a whole input applies the first info from the start.
    known = cloud_of(sensor, data, info, data, backend=backend)
    assert not known.nominal
    assert degrees(known)[:4] == degrees(known)[12:16] == [5, 6, 5, 7]
    np.testing.assert_allclose(np.rad2deg(known.elevation[:4]), [-1, 0, 1, 2], atol=1e-5)


def test_a_calibration_file_decides_the_frames() -> None:
    bare, sensor = calibration.BARE, SHAPES["shape-calibration"]
    with pytest.raises(UsageError, match="configure"):
        bare.parse(b"\xca\x1b")
    with pytest.raises(UsageError, match="configure"):
        bare.decoder()
    data = sensor.build(
        "data", azimuth=9000, channels=[dict(row=row, distance=1000) for row in (0, 1, 4, 5, 255)]
    )
    cloud = sensor.decode(data).points()
    np.testing.assert_allclose(np.rad2deg(cloud.elevation[:3]), [-7.5, -2.5, 12.5], atol=1e-5)
    assert cloud.valid.tolist() == [True, True, True, False, False]
    assert "calibration" in repr(sensor)


@both
def test_header_options_change_the_layout(backend: str) -> None:
    sensor = SHAPES["shape-options"]

    def frame(
        extended: int, coarse: int, kind: int, extension: Any, extra: Any, rows: int, columns: int
    ) -> bytes:
        options = dict(extended=extended, coarse=coarse, kind=kind)
        distances = [1000] * (rows * columns)
        values = dict(
            options=options,
            rows=rows,
            columns=columns,
            extension=extension,
            extra=extra,
            angle=500,
            distances=distances,
        )
        return sensor.build("data", **values)

    frames = [
        frame(0, 0, 0, None, None, 1, 2),
        frame(1, 1, 1, dict(serial=7, trim=10), dict(rpm=600), 2, 2),
        frame(0, 1, 2, None, dict(rpm=0x1234, volts=12), 0, 9),
    ]
    assert [len(data) for data in frames] == [13, 24, 12]
    packets = reader(sensor, backend).decode(b"".join(frames))
    assert packets.count("distances").tolist() == [2, 4, 0]
    np.testing.assert_array_equal(packets["extra.rpm"], [np.nan, 600, 0x1234])
    np.testing.assert_array_equal(packets["extra.volts"], [np.nan, np.nan, 12])
    cloud = packets.points()
    assert cloud.range.tolist() == [1, 1, 4, 4, 4, 4]
    assert degrees(cloud) == [5, 5, 6, 6, 6, 6]


@both
def test_a_clock_that_wraps_runs_on(backend: str) -> None:
    sensor = SHAPES["shape-clock"]
    instants = [58.5, 59.25, 59.9999, 0.0, 29.5, 58.0, 1.0]
    frames = [
        sensor.build("data", seconds=int(t), ticks=round(t % 1 * 10_000), distances=[1, 2, 3, 4])
        for t in instants
    ]
    packets = reader(sensor, backend).decode(b"".join(frames))
    expected = [58.5, 59.25, 59.9999, 60.0, 89.5, 118.0, 121.0]
    assert packets.time_ns.tolist() == [round(t * 1e4) * 100_000 for t in expected]
    turns = [
        sensor.build("data", seconds=i * 10 % 60, ticks=0, distances=[1, 2, 3, 4])
        for i in range(300)
    ]
    assert reader(sensor, backend).decode(b"".join(turns)).time_ns.tolist() == [
        i * 10 * 10**9 for i in range(300)
    ]
    late = [turns[spot] for spot in (0, 1, 3, 2, 4)]
    assert reader(sensor, backend).decode(b"".join(late)).time_ns.tolist() == [
        i * 10 * 10**9 for i in (0, 1, 3, 2, 4)
    ]
    scans = list(reader(sensor, backend).scans(b"".join(frames[:4])))
    assert [len(scan) for scan in scans] == [4, 4, 4, 4]


@both
def test_two_echoes_stand_side_by_side_even_at_one_distance(backend: str) -> None:
    sensor = SHAPES["shape-echoes"]
    beams = [
        dict(near=250, far=500, weak=1, strong=2),
        dict(near=250, far=250, weak=3, strong=4),
    ] + [dict(near=0, far=0, weak=0, strong=0)] * 3
    cloud = cloud_of(
        sensor, sensor.build("data", turn=1, angle=10_000, beams=beams), backend=backend
    )
    assert cloud.range[:4].tolist() == [1, 2, 1, 1]
    assert cloud.return_index.tolist() == [0, 1] * 5  # type: ignore[union-attr]
    assert cloud.intensity[:4].tolist() == [1, 2, 3, 4]  # type: ignore[union-attr]
    np.testing.assert_allclose(cloud.azimuth[:4], [1.0, 1.0, 1.01, 1.01], atol=1e-6)
    assert cloud.valid.tolist() == [True] * 4 + [False] * 6


def test_lines_of_text_are_read_and_written() -> None:
    sensor = SHAPES["shape-text"]
    assert sensor.build("data", angle=9000, distance=1234, strength=7) == b"$L9000,1234,7\n"
    packets = sensor.decode(b"junk$L9000,1234,7\n$L10,x,1\n$L007,1,1\n$L40000,1,1\n$L18000,50,0\n")
    assert packets["distance"].tolist() == pytest.approx([1.234, 0.05])
    assert degrees(packets.points()) == [90, -180]
    assert packets.stats.implausible == 1


@both
def test_arrays_in_arrays_and_cartesian_points(backend: str) -> None:
    sensor = SHAPES["shape-grid"]
    depth = [[1000 * (4 * row + column) for column in range(4)] for row in range(3)]
    skew = [[-1, 0, 0, 0], [0] * 4, [0, 0, 0, 50]]
    packets = reader(sensor, backend).decode(sensor.build("data", frame=1, depth=depth, skew=skew))
    assert packets.raw["depth"].shape == (1, 3, 4)
    cloud = packets.points()
    assert cloud.shape == (3, 4)
    np.testing.assert_allclose(cloud.xyz[5], [5, 0.25, 0], atol=1e-6)
    np.testing.assert_allclose(cloud.xyz[11], [11, -1.65, -0.6], atol=1e-6)
    assert cloud.ring.tolist() == [0] * 4 + [1] * 4 + [2] * 4  # type: ignore[union-attr]


@both
def test_numbers_keep_every_bit(backend: str) -> None:
    sensor = SHAPES["shape-numbers"]
    sample = dict(range=1.5, elevation=-9000, spare=255)
    values: dict[str, Any] = dict(
        reserved=b"\x01\x02\x03",
        stamp=12_345_678_901,
        serial=-(2**63),
        offset=-1,
        azimuth=0.25,
        samples=[sample] * 3,
    )
    data = sensor.build("data", **values)
    assert data[-2:] not in (b"\0\0", b"\xff\xff")
    packets = reader(sensor, backend).decode(data)
    assert packets.raw["serial"][0] == -(2**63)
    assert packets.time_ns.tolist() == [12_345_678_901]
    cloud = packets.points()
    assert cloud.range.tolist() == [1.5] * 3
    np.testing.assert_allclose(cloud.z, -1.5, atol=1e-6)
    signalling = data[:34] + bytes.fromhex("7f 80 00 01") + data[38:]
    for absent in (b"\0\0", b"\xff\xff"):
        unfilled = signalling[:-2] + absent
        assert sensor.build("data", sensor.parse(unfilled)) == unfilled
        found = reader(sensor, backend).decode(unfilled + signalling)
        assert (len(found), found.stats.bad_checksum) == (1, 1)
        assert found.points().valid.tolist() == [False, True, True]


def test_commands_take_arguments_in_units_and_name_their_reply() -> None:
    sensor = SHAPES["shape-commands"]
    data = sensor.command("speed", rate=12.34, trim=-9.9)
    assert data[:5] == b"\x16\x03" + Int16ul.build(1234) + bytes([round((-9.9 + 64) / 0.5)])
    assert data[5] == Xor()(data[:5])
    assert sensor.command("spin") == b""
    with pytest.raises(OutOfRange, match="rate"):
        sensor.command("speed", rate=20.5, trim=0)
    with pytest.raises(UsageError, match="trim"):
        sensor.command("speed", rate=10)
    with pytest.raises(UsageError, match="did you mean 'rate'"):
        sensor.command("speed", rat=10, trim=0)
    assert sensor.split(data) == []  # what is sent is not looked for in what is received


@both
def test_a_sequence_counts_lost_duplicate_and_late_packets(backend: str) -> None:
    sensor = SHAPES["shape-datagrams"]

    def frame(number: int) -> bytes:
        block = dict(azimuth=number, channels=[dict(distance=number, intensity=1)] * 3)
        return sensor.build("data", number=number, reserved=bytes(3), blocks=[block] * 4)

    stats = reader(sensor, backend).decode([frame(n) for n in (198, 199, 200, 1, 2, 3)]).stats
    assert (stats.lost, stats.duplicates, stats.late) == (0, 0, 0)
    stats = reader(sensor, backend).decode([frame(n) for n in (199, 2, 3, 3, 1, 6)]).stats
    assert (stats.lost, stats.duplicates, stats.late) == (3, 1, 1)
    assert stats.frames == {"data": 6}
    ordered = list(reader(sensor, backend).scans([frame(n) for n in range(1, 9)]))
    shuffled = list(
        reader(sensor, backend).scans([frame(n) for n in (1, 2, 4, 3, 3, 5, 7, 6, 8, 8)])
    )
    for one, other in zip(ordered, shuffled, strict=True):
        np.testing.assert_array_equal(one.points.xyz, other.points.xyz)


#: three ranges beside a deeper array, which says nothing of them.
ANGLES = np.array([0.1, 0.2, 0.3])
BESIDE = Struct("first" / Int8ub, "near" / Array(3, Int8ub), "other" / Array(4, Array(3, Int8ub)))


@both
@pytest.mark.parametrize(
    "points",
    [
        lambda f: Polar(range=f.near, azimuth=ANGLES),
        lambda f: Polar(range=f.near, azimuth=f.near * 0 + ANGLES),
        lambda f: Polar(range=f.near, azimuth=ANGLES[:, None]),
        lambda f: Polar(range=f.near, azimuth=along("near", ANGLES)),
        lambda f: Polar(range=f.near, azimuth=f.first * 0 + along("near", ANGLES)),
        lambda f: Polar(range=f.near, azimuth=(f.near.index + 1) * 0.1),
        lambda f: Polar(range=np.asarray(f.near), azimuth=ANGLES[:, None]),
    ],
)
def test_numbers_go_along_the_one_array_that_is_as_long_or_that_is_named(
    points: Any, backend: str
) -> None:
    sensor = replace(against_construct.sensor(BESIDE), points=points)
    cloud = reader(sensor, backend).decode([bytes(range(16))] * 2).points()
    assert cloud.range.tolist() == [1, 2, 3] * 2
    np.testing.assert_allclose(cloud.azimuth, [*ANGLES] * 2, rtol=1e-6)


@both
@pytest.mark.parametrize(
    ("points", "said"),
    [
        (
            lambda f: Polar(range=f.near, azimuth=f.first * ANGLES),
            r"3 values match several .*, near and other\[\]: .*along\('other\[\]', ",
        ),
        (
            lambda f: Polar(range=f.near, azimuth=np.zeros(7)),
            r"7 values match no array .* have the lengths near 3, other 4, other\[\] 3",
        ),
        (
            lambda f: Polar(range=f.near, azimuth=along("other[]", ANGLES)),
            r"along the array 'other\[\]', but no value uses a field of this array \(.*other\[\] 3",
        ),
        (
            lambda f: Polar(range=f.near, azimuth=along("other", np.zeros(4))),
            r"values along the arrays 'near' and 'other' cannot be combined",
        ),
        (
            lambda f: Polar(range=f.near, azimuth=along("further", ANGLES)),
            r"no array 'further'; expected one of near, other, other\[\]",
        ),
        (
            lambda f: Polar(range=np.asarray(f.near)[:, :, 0], azimuth=0),
            r"along the array 'other(\[\])?', but no value uses a field of this array",
        ),
        (lambda f: Polar(range=f.first, azimuth=f.first.index), r"a field inside an array"),
    ],
)
def test_numbers_that_go_along_several_arrays_or_none_are_refused_by_their_names(
    points: Any, said: str, backend: str
) -> None:
    packets = reader(replace(against_construct.sensor(BESIDE), points=points), backend).decode(
        [bytes(range(16))] * 2
    )
    with pytest.raises(SpecError, match=said):
        packets.points()


@both
def test_lengths_that_do_not_fit_are_named_with_their_axes(backend: str) -> None:
    sensor = against_construct.sensor(BESIDE)
    terms = reader(
        replace(sensor, points=lambda f: Polar(range=f.other * np.ones((3, 1)), azimuth=0)), backend
    ).decode([bytes(16)])
    with pytest.raises(
        SpecError,
        match=r"have different lengths: 1: other 4 x other\[\] 3, 2: other 3",
    ):
        terms.points()
    parts = reader(
        replace(sensor, points=lambda f: Polar(range=f.other, azimuth=along("other", np.zeros(2)))),
        backend,
    ).decode([bytes(16)])
    with pytest.raises(
        SpecError,
        match=r"have different lengths: range: other 4 x other\[\] 3, azimuth: other 2",
    ):
        parts.points()


def test_simulation_reports_the_same_axis_errors() -> None:
    sensor = replace(
        against_construct.sensor(
            Struct(
                "near" / Array(3, Scaled(Int8ub, 0.1, "m")), "other" / Array(4, Array(3, Int8ub))
            )
        ),
        points=lambda f: Polar(range=f.near * along("other[]", np.ones(3)), azimuth=0),
        simulation=Simulation(lambda i: {}, rate=10),
    )
    with pytest.raises(SpecError, match=r"along the array 'other\[\]'"):
        simulate(sensor, 2)


@pytest.mark.parametrize(
    "sizes", [[(7, 0)], [(0, 3)], [(7, 0), (3, 2)], [(0, 3), (3, 2)], [(7, 0), (0, 3)]]
)
def test_arrays_in_empty_ones_have_no_length(sizes: list[tuple[int, int]]) -> None:
    sensor, each = SHAPES["shape-segments"], dict(turn=0, time=0, start=0)
    segments = [
        dict(
            each,
            channels=channels,
            beams=beams,
            elevations=[1] * channels,
            data=[[dict(distance=1, strength=1)] * channels] * beams,
        )
        for channels, beams in sizes
    ]
    frame = sensor.build("data", counter=1, step=1.5, segments=segments, units=True)
    plain, parsed = (
        cloud_of(sensor, frame, backend="numpy"),
        cloud_of(sensor, frame, backend="construct"),
    )
    assert len(plain) == sum(channels * beams for channels, beams in sizes)
    assert_same_points(plain, parsed)
