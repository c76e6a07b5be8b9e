"""Tests of further columns of points: types, units, formats and cost."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    ByteSwapped,
    Const,
    Int16sl,
    Int16ul,
    Int32ub,
    Struct,
)

import lidarspec
from lidarspec import PointCloud, Sensor, SpecError, simulate
from lidarspec.errors import UnknownName
from lidarspec.packets.packets import Packets
from lidarspec.points.batch_columns import BatchColumns
from lidarspec.points.cloud import LazyCloud
from lidarspec.points.evaluate import evaluate
from lidarspec.points.mount import Mount
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Cartesian, Extra, Fields, Frame, Polar, Scaled, Simulation, along, take
from lidarspec.testing.cloud_assertions import assert_well_formed
from tests.agreement import assert_same_points
from tests.by_construct import reader
from tests.points.backends import BACKENDS, EVERY_BACKEND
from tests.shapes import SHAPES

SENSOR = SHAPES["shape-extras"]
KINDS = {
    "velocity": ("f4", "m/s"),
    "near_ir": ("u2", ""),
    "signal": ("u4", "photons"),
    "tag": ("u1", ""),
    "confidence": ("f4", "1"),
    "strong": ("b1", ""),
}


def packets(number: int = 40, backend: str = "numpy") -> Packets:
    """Return packets with random values."""
    return reader(SENSOR, backend).decode(
        [SENSOR.example("data", seed=seed) for seed in range(number)]
    )


@EVERY_BACKEND
def test_columns_have_the_values_types_and_units_of_the_plain_evaluation(backend: str) -> None:
    read = packets(backend=backend)
    evaluated = evaluate(read)
    found, plain = evaluated.cloud, evaluate_plainly(read).cloud
    assert isinstance(evaluated.source, BatchColumns) == (backend != "construct")
    assert list(found.extra) == list(plain.extra) == list(KINDS)
    for cloud in (found, plain):
        assert {
            name: (cloud.extra[name].dtype.str[1:], cloud.units[name]) for name in cloud.extra
        } == KINDS
    assert_same_points(found, plain)
    channels = "blocks.channels."
    np.testing.assert_array_equal(
        found.extra["velocity"], read[f"{channels}velocity"].reshape(-1).astype(np.float32)
    )
    np.testing.assert_array_equal(
        found.extra["signal"], np.repeat(read["blocks.signal"].reshape(-1), 3)
    )  # more than float32 holds
    assert found.extra["signal"].max() > 2**24
    np.testing.assert_array_equal(
        np.isnan(found.extra["confidence"]), read[f"{channels}mark.noise"].reshape(-1) == 7
    )


def test_a_scan_computes_columns_of_its_own_packets_only() -> None:
    sensor = lidarspec.sensor("ouster-os1").configure(rows=32)
    frames = simulate(sensor, 3 * 64)
    scans, whole = list(sensor.scans(frames)), sensor.decode(frames).points()
    assert len(scans) == 3
    for name in ("signal", "flags"):
        columns = [scan.points.extra[name] for scan in scans]
        assert all(
            column.base is not None and column.base.nbytes == column.nbytes for column in columns
        )
        np.testing.assert_array_equal(np.concatenate(columns), whole.extra[name])


def test_unread_columns_are_not_computed() -> None:
    cloud = packets().points()
    assert isinstance(cloud, LazyCloud)
    assert cloud.xyz.shape == (len(cloud), 3)
    assert len(cloud.extra) == len(cloud.units) == 6
    assert "velocity" in repr(cloud.extra)
    assert not any(name in cloud.lazy.computed for name in cloud.extra)
    assert cloud.extra["velocity"] is cloud.extra["velocity"]
    assert [name for name in cloud.extra if name in cloud.lazy.computed] == ["velocity"]
    with pytest.raises(KeyError, match="velocty: expected one of velocity, near_ir"):
        cloud.extra["velocty"]


def assert_carried(cloud: PointCloud, whole: PointCloud, which: object) -> None:
    """Fail unless a cloud has some of the points of another one, with all of their columns."""
    assert dict(cloud.units) == dict(whole.units)
    assert list(cloud.extra) == list(whole.extra)
    for name, column in whole.extra.items():
        assert cloud.extra[name].dtype == column.dtype
        np.testing.assert_array_equal(cloud.extra[name], column[which])  # type: ignore[call-overload]


def test_replace_gives_a_cloud_with_the_other_columns() -> None:
    cloud, reader = packets().points(), packets().points()
    replaced = dataclasses.replace(cloud, intensity=reader.range)
    assert len(replaced) == len(reader)
    assert_carried(replaced, reader, slice(None))
    np.testing.assert_array_equal(replaced.intensity, reader.range)
    np.testing.assert_array_equal(replaced.x, reader.x)
    assert replaced.columns.keys() == {*reader.columns, "intensity"}


def test_masks_slices_scans_mounts_and_pickles_carry_them() -> None:
    cloud, reader = packets().points(), packets().points()
    mask = reader.extra["near_ir"] > 20_000
    assert_carried(cloud[mask], reader, mask)
    assert_carried(cloud[[3, 1, 99]], reader, [3, 1, 99])
    assert_carried(cloud[7:200], reader, slice(7, 200))
    assert_carried(cloud[7:200][3:9], reader, slice(10, 16))
    assert_carried(cloud[::2][1:9], reader[::2], slice(1, 9))
    assert_carried(pickle.loads(pickle.dumps(cloud)), reader, slice(None))
    assert_carried(Mount(yaw_deg=90.0).apply(cloud), reader, slice(None))
    data = simulate(SENSOR, 60)
    scans, all_of_it = list(SENSOR.scans(data)), SENSOR.decode(data).points()
    assert len(scans) > 3
    ends = np.cumsum([0, *map(len, scans)])
    for scan, start in zip(scans, ends, strict=False):
        assert_carried(scan.points, all_of_it, slice(start, start + len(scan)))


def test_structured_arrays_have_them_behind_the_layout_of_pcl() -> None:
    cloud = packets().points()
    made = cloud.to_structured()
    assert made.dtype.itemsize == 64
    assert {
        name: made.dtype.fields[name][1]
        for name in ("x", "ring", "time", "velocity", "near_ir", "signal")
    } == dict(  # type: ignore[index]
        x=0, ring=20, time=24, velocity=32, near_ir=36, signal=40
    )
    for name, column in cloud.extra.items():
        np.testing.assert_array_equal(made[name], column)


@pytest.mark.parametrize("name", ["range", "valid", "x", "scan", "Near", "near ir", "2nd", ""])
def test_a_name_that_means_something_else_is_refused(name: str) -> None:
    with pytest.raises(SpecError, match=r"extra: .*name"):
        Cartesian(0, 0, 0, extra={name: 1})


def test_a_type_that_holds_no_numbers_is_refused() -> None:
    with pytest.raises(SpecError, match="numbers"):
        Extra(1, dtype="U4")


def test_types_and_units_can_be_declared_and_low_values_are_spread() -> None:
    def points(f: Fields) -> Polar:
        extra = {
            "velocity": Extra(f.blocks.channels.velocity, unit="", dtype=np.float64),
            "noise": Extra(f.number % 7, dtype="u1"),
            "one": 1,
        }
        return Polar(f.blocks.channels.distance, f.blocks.azimuth, extra=extra)

    read = dataclasses.replace(SENSOR, points=points).decode(
        [SENSOR.example("data", seed=seed) for seed in range(9)]
    )
    found, plain = read.points(), evaluate_plainly(read).cloud
    assert [(column.dtype.str[1:], found.units[name]) for name, column in found.extra.items()] == [
        ("f8", ""),
        ("u1", ""),
        ("f4", ""),
    ]
    np.testing.assert_array_equal(found.extra["noise"], np.repeat(read["number"] % 7, 12))
    assert_same_points(found, plain)
    assert_well_formed(found)


@pytest.mark.slow
def test_points_in_parts_have_them_too() -> None:
    sensor = SHAPES["shape-segments"]
    read = sensor.decode(simulate(sensor, 8))
    cloud = read.points()
    assert cloud.extra["signal"].dtype == np.uint8
    assert dict(cloud.units) == {"signal": "", "step": "deg", "share": ""}
    np.testing.assert_array_equal(cloud.extra["signal"], cloud.extra["share"] * np.float32(255))
    assert (cloud.extra["step"] == np.float32(1.5)).all()


#: 12 bytes an element, three words of four: bits, whole bytes and numbers in them, and one that
#: stands across two.
PIXEL = ByteSwapped(
    BitStruct(
        *(
            "window" / BitsInteger(8),
            "across" / BitsInteger(16),
            "near_ir" / BitsInteger(16),
            "signal" / BitsInteger(16),
        ),
        *(
            "unused" / BitsInteger(8),
            "reflectivity" / BitsInteger(8),
            "rest" / BitsInteger(5),
            "flags" / BitsInteger(3),
        ),
        "distance" / Scaled(BitsInteger(16), 0.002, "m"),
    )
)


def words() -> Sensor:
    """Return a sensor whose pixels share words, with directions from tables.

    Two further fields are not in these words.
    """
    columns = Array(4, Struct("number" / Int16ul, "pixels" / Array(8, PIXEL)))
    struct = Struct(
        "head" / Const(b"\xa5\x5a"),
        "columns" / columns,
        "ends" / Array(8, Struct("whole" / Int32ub, "sign" / Int16sl)),
    )
    table, level = np.linspace(-3, 3, 640).reshape(80, 8), np.linspace(-0.4, 0.4, 8)
    names = ("signal", "near_ir", "across", "window", "flags", "rest")

    def points(f: Fields) -> Polar:
        pixels, number = f.columns.pixels, f.columns.number % 80
        place = (take(table, number), along("pixels", level), 0.1)
        extra = {name: getattr(pixels, name) for name in names}
        return Polar(
            pixels.distance,
            take(table, number),
            along("pixels", level),
            origin=place,
            intensity=pixels.reflectivity,
            extra=extra,
        )

    return dataclasses.replace(
        SENSOR,
        frames={"data": Frame(struct, data=True)},
        points=points,
        clock=None,
        sequence=None,
        simulation=Simulation(),
    )


@BACKENDS
@pytest.mark.parametrize(
    "sensor",
    [words(), SENSOR, SHAPES["shape-segments"], SHAPES["shape-bits"]],
    ids=lambda sensor: sensor.id,
)
def test_columns_read_together_equal_columns_read_singly(sensor: Sensor, backend: str) -> None:
    read = (
        reader(sensor, backend)
        .decode([sensor.example(sensor.data_frame, seed=seed) for seed in range(9)])
        .with_points
    )
    plain = evaluate_plainly(read).cloud
    names = [*plain.columns, "valid"]
    for which in (..., slice(5, len(plain) - 5)):
        cloud = read.points() if which is ... else read.points()[which]
        assert list(cloud.read(*names)) == names
        assert_same_points(cloud, plain if which is ... else plain[which], ulps=6)
    one = read.points()
    assert all(column is one.read(*names)[name] for name, column in one.read(*names).items())


def test_an_unknown_column_is_an_error() -> None:
    cloud = packets().points()
    with pytest.raises(UnknownName, match="unknown name 'velocty'; did you mean 'velocity'"):
        cloud.read("x", "velocty")
    with pytest.raises(UnknownName, match="column"):
        dataclasses.replace(cloud[[0, 1]], intensity=None).read("intensity")


def test_checking_for_a_column_computes_nothing() -> None:
    cloud = packets().points()
    assert isinstance(cloud, LazyCloud)
    assert "velocity" in cloud.extra
    assert "speed" not in cloud.extra
    assert not any(name in cloud.lazy.computed for name in cloud.extra)
