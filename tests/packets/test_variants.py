"""Tests of sensors with several variants of data frames.

Variants differ in length, counter or unit, which the header states. Some use default angles.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from construct import Array, Const, Int8ul, Struct, this

import lidarspec
from lidarspec import Sensor, SpecError, simulate
from lidarspec.spec import Cartesian, Fields, Frame, PacketCounter, Polar, Simulation
from tests.by_construct import reader
from tests.made_captures import frame, pcap
from tests.shapes import headed, lengths

PLAIN, COUNTED = (lengths.SENSOR.configure(answer=name) for name in ("plain", "counted"))


def make_frames(*numbers: int) -> list[bytes]:
    return [
        COUNTED.build(
            "counted", azimuth=100 * number % 36_000, distances=[1000] * 3, counter=number
        )
        for number in numbers
    ]


def block(number: int | None) -> bytes:
    """Return a frame of one block, with or without a counter."""
    channels = [{"distance": 500, "strength": 9}] * 3
    blocks = [{"azimuth": 0, "channels": channels}]
    return headed.SENSOR.build(
        "data", unit=4, counted=int(number is not None), blocks=blocks, counter=number
    )


@pytest.mark.parametrize("form", [PLAIN, COUNTED])
def test_the_form_that_arrives_is_decoded(form: Sensor) -> None:
    packets = lengths.SENSOR.decode(simulate(form, 30))
    assert packets.frame == form.data_frame
    assert len(packets) == 30
    assert packets.points().valid.all()
    assert [scan.complete for scan in lengths.SENSOR.scans(simulate(form, 30))] == [
        False,
        True,
        False,
    ]


def test_the_first_form_decides_and_a_configured_one_or_a_named_one_has_precedence() -> None:
    mixed = [*simulate(PLAIN, 2), *simulate(COUNTED, 3)]
    assert [len(lengths.SENSOR.decode(data)) for data in (mixed, mixed[::-1])] == [2, 3]
    assert len(COUNTED.decode(mixed)) == 3
    assert len(PLAIN.decode(mixed[::-1])) == 2
    assert len(lengths.SENSOR.decode(mixed, "counted")) == 3
    assert lengths.SENSOR.decode([]).frame == "plain"


@pytest.mark.parametrize("form", [PLAIN, COUNTED])
def test_a_file_is_read_by_the_form_in_it(form: Sensor, tmp_path: Path) -> None:
    path = tmp_path / "frames.pcap"
    path.write_bytes(pcap(*map(frame, simulate(form, 30))))
    with lidarspec.open(path, lengths.SENSOR) as device:
        assert {packets.frame for packets in device.packets()} == {form.data_frame}
    with lidarspec.open(path, lengths.SENSOR) as device:
        assert sum(len(scan) for scan in device.scans()) == 90


def test_only_frames_with_the_counter_are_counted() -> None:
    assert lengths.SENSOR.decode(make_frames(3, 4, 9)).stats.lost == 4
    plain = lengths.SENSOR.decode(simulate(PLAIN, 5))
    assert plain.index.tolist() == [0, 1, 2, 3, 4]
    assert (plain.stats.lost, plain.stats.duplicates, plain.stats.plugin_errors) == (0, 0, 0)


def test_a_counter_that_no_data_frame_has_is_an_error_of_the_plugin() -> None:
    wrong = replace(lengths.SENSOR, sequence=PacketCounter("countre"))
    assert wrong.decode(simulate(PLAIN, 2)).stats.plugin_errors == 2  # packets


def test_a_sweep_may_name_fields_of_any_variant() -> None:
    assert [frame[-2:] for frame in simulate(COUNTED, 3)] == [b"\0\0", b"\1\0", b"\2\0"]
    wrong = replace(lengths.SENSOR, simulation=Simulation(lambda i: {"azimuth": 0, "countre": i}))
    with pytest.raises(SpecError, match="countre"):
        simulate(wrong, 1)


@pytest.mark.parametrize(
    ("numbers", "lost", "duplicates", "index"),
    [
        ([None, None, None], 0, 0, [0, 1, 2]),
        ([7, None, 8, 12], 3, 0, [7, 8, 8 + 1, 13]),
        ([None, 7, 8], 0, 0, None),
        ([None, None, None, 0, 1], 0, 0, None),
        ([7, 7, None], 0, 1, [7, 7, 8]),
    ],
)
def test_packets_without_the_optional_counter_are_consecutive(
    numbers: list[int | None], lost: int, duplicates: int, index: list[int] | None
) -> None:
    for backend in ("auto", "construct"):
        packets = reader(headed.SENSOR, backend).decode([block(number) for number in numbers])
        assert (packets.stats.lost, packets.stats.duplicates, packets.stats.plugin_errors) == (
            lost,
            duplicates,
            0,
        )
        assert (
            (np.diff(packets.index) > 0).all() if index is None else packets.index.tolist() == index
        )
        assert sum(
            len(scan) for scan in headed.SENSOR.scans([block(number) for number in numbers])
        ) == 3 * (len(numbers) - duplicates)


def test_distances_are_in_the_unit_of_the_header_also_when_simulated() -> None:
    coarse = replace(headed.SENSOR, simulation=Simulation(lambda i: {**headed.sweep(i), "unit": 8}))
    fine, rough = (sensor.decode(simulate(sensor, 12)) for sensor in (headed.SENSOR, coarse))
    assert set(fine["unit"]) == {4}
    assert set(rough["unit"]) == {8}
    assert (
        abs(fine["blocks.channels.distance"] / rough["blocks.channels.distance"] - 2).max() < 0.02
    )
    assert abs(fine.points().range - rough.points().range).max() <= 0.0061
    assert fine.points().range.min() > 1


def test_other_fields_keep_the_values_of_the_sweep() -> None:
    parsed = headed.SENSOR.parse(simulate(headed.SENSOR, 1)[0])
    assert (parsed.unit, parsed.rows, parsed.counted) == (4, 2, 1)


def test_a_cloud_is_nominal_until_the_sensor_has_its_own_calibration() -> None:
    own = headed.SENSOR.configure(calibration=headed.EXAMPLE)
    assert bool(headed.SENSOR.decode([block(1)]).points().nominal)
    assert not own.decode([block(1)]).points().nominal
    assert own.decode([block(1)]).points().elevation.tolist() == pytest.approx(
        np.deg2rad([-7.5, -2.5, 2.5])
    )
    assert [bool(scan.points.nominal) for scan in headed.SENSOR.scans([block(1)])] == [True]


def test_an_array_without_elements_is_the_same_on_both_paths() -> None:
    empty = headed.SENSOR.build("data", unit=4, counted=0, rows=0, blocks=[], counter=None)
    compiled, interpreted = (
        reader(headed.SENSOR, backend).decode([empty, block(1)])
        for backend in ("auto", "construct")
    )
    assert (
        compiled["blocks.channels.distance"].tolist()
        == interpreted["blocks.channels.distance"].tolist()
    )
    assert interpreted.count("blocks").tolist() == [0, 1]
    assert compiled.count("blocks").tolist() == [0, 1]
    assert (
        compiled.count("blocks.channels").tolist()
        == interpreted.count("blocks.channels").tolist()
        == [0, 3]
    )


def test_an_array_in_one_without_elements_may_have_a_length_of_its_own() -> None:
    row = Struct("cells" / Array(this._.width, Int8ul))
    struct = Struct(
        "magic" / Const(b"RW"),
        "height" / Int8ul,
        "width" / Int8ul,
        "rows" / Array(this.height, row),
    )
    frame_type = Frame(struct, data=True, max_length=40)
    sensor = replace(
        headed.SENSOR,
        frames={"data": frame_type},
        points=lambda f: Polar(f.rows.cells, 0),
        sequence=None,
        simulation=Simulation(),
    )
    data = [bytes.fromhex("5257 00 05"), bytes.fromhex("5257 02 03 010203 040506")]
    for backend in ("auto", "construct"):
        packets = reader(sensor, backend).decode(data)
        assert packets.raw["rows"]["cells"].tolist() == [[[0] * 3] * 2, [[1, 2, 3], [4, 5, 6]]]
        assert packets.count("rows.cells").tolist() == [0, 3]
        assert packets.points().range.tolist() == [1, 2, 3, 4, 5, 6]


def test_cartesian_points_can_be_nominal_too() -> None:
    def points(f: Fields) -> Cartesian:
        return Cartesian(f.distances, 0, 0, nominal=True)

    plain = Frame(lengths.PLAIN, data=True, max_length=10)
    sensor = replace(lengths.SENSOR, frames={"plain": plain}, points=points, sequence=None)
    assert bool(sensor.decode(simulate(PLAIN, 2)).points().nominal)
