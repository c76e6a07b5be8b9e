"""What the sensors declare of themselves beside their frames: fields that exist, relatives that name each other, turns as simulated."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.columns.columns import Fields
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Frame
from lidarspec.wire.schema import schema
from tests.evidence import vectors

SENSORS = ls.sensors()


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_what_frames_say_of_the_device_is_a_field_of_an_incoming_frame(sensor: ls.Sensor) -> None:
    for role, path in sensor.info.items():
        name, _, field = path.partition(".")
        assert name in sensor.incoming, f"{role}: {path}"
        assert field in schema(sensor.frames[name].tree).named, f"{role}: {path}"


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_relatives_are_other_sensors_that_name_this_one_too(sensor: ls.Sensor) -> None:
    for relative, difference in sensor.relatives.items():
        assert relative != sensor.id
        assert relative not in SENSORS or sensor.id in SENSORS[relative].relatives
        assert difference if isinstance(difference, str) else difference.told_by


@pytest.mark.parametrize("sensor", [sensor for sensor in SENSORS.values() if sensor.relatives], ids=lambda sensor: sensor.id)
def test_no_packet_of_a_sensor_is_taken_for_a_relatives(sensor: ls.Sensor) -> None:
    data = simulate(sensor, 5)
    fields = Fields(sensor.decode(data if sensor.datagrams else b"".join(data)).batch())
    for relative in sensor.relatives.values():
        assert isinstance(relative, str) or not np.any(np.asarray(relative.sends(fields)))


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_who_has_the_same_incoming_frames_is_a_relative(sensor: ls.Sensor) -> None:
    alike = {other.id for other in SENSORS.values() if other is not sensor and dict(other.incoming) == dict(sensor.incoming)}
    named = {name for name in sensor.relatives if name in SENSORS}
    assert alike <= named
    for other in {id(_data(SENSORS[name])): SENSORS[name] for name in named - alike}.values():
        assert _takes(sensor, other) or _takes(other, sensor)


def _data(sensor: ls.Sensor) -> Frame:
    return sensor.frames[sensor.data_frame]


def _takes(sensor: ls.Sensor, other: ls.Sensor) -> bool:
    """Whether what one sensor sends is data of the other."""
    found = sensor.split(_example(_data(other)))
    return bool(found) and found[0].frame == sensor.data_frame


@functools.cache
def _example(frame: Frame) -> bytes:
    """Simulated bytes of the first sensor that has this data frame."""
    sensor = next(sensor for sensor in SENSORS.values() if _data(sensor) is frame)
    return b"".join(simulate(sensor, 2))


@pytest.mark.parametrize("name", [name for name, sensor in SENSORS.items() if sensor.turn and sensor.clock])
def test_simulated_it_turns_no_slower_and_no_faster(name: str) -> None:
    sensor, packets = SENSORS[name], 3 * (1260 if name == "robosense-m2" else 630)  # three frames of the M1, which takes the most but one
    frames = simulate(sensor, packets)
    rates = [scan.rate_hz for scan in sensor.scans(frames if sensor.datagrams else b"".join(frames)) if scan.complete]
    slowest, fastest = sensor.turn or (0, 0)
    assert rates
    assert slowest - 0.01 <= min(rates) <= max(rates) <= fastest + 0.01


#: vectors of the collection that no test can use, and why.
LEFT_OUT = {
    "rs_ucwp_bpearl": "settings are not sent: the layout is that of a tool of others, no manual has it",
    "wt53r_read": "a request to a single-point sensor over Modbus, of which there is no plugin",
}


def test_no_vector_is_left_unused() -> None:
    """Tests name a vector, or what its name has behind the family's."""
    files = Path(__file__).parents[2].glob("plugins/*/tests/*.py")
    texts = "".join(file.read_text(encoding="utf-8") for file in files)
    names = [name for file in ("vectors_serial2d.json", "vectors_udp3d.json") for name in vectors(file)]
    unused = {name for name in names if name not in texts and f'"{name.partition("_")[2]}"' not in texts}
    assert unused == LEFT_OUT.keys()
