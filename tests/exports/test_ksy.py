"""Tests of Kaitai specs: they compile, and the result reads the values that we read."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

import pytest
from construct import (
    Array,
    Bytes,
    BytesInteger,
    Const,
    CString,
    Float16b,
    If,
    IfThenElse,
    Int8ul,
    Int16ul,
    Int24sb,
    RepeatUntil,
    Struct,
    obj_,
    this,
)

import lidarspec
from lidarspec import Sensor
from lidarspec.exports import ExportError, export
from lidarspec.exports.ksy import identifier, yaml
from lidarspec.frames.schema import make_schema
from lidarspec.spec import Every, Frame, Polar, Serial
from tests.exports import kaitai, trees
from tests.exports.trees import (
    distinct_sensors,
    find_recoded,
    list_byte_frames,
    parse_wire_fields,
)

#: the shapes that are exported; of oddities there are own ones below.
SHAPED = {name: sensor for name, sensor in trees.SHAPED.items() if name != "shape-oddities"}
_CONSTANTS = "Kaitai cannot distinguish kinds of parts by their constants"
#: the shapes that Kaitai cannot say, and why.
REFUSED = {
    "shape-text": "Decimal is Python code",
    "shape-tags": _CONSTANTS,
    **find_recoded(SHAPED.values()),
}
#: the installed sensors that Kaitai cannot say, and why.
REFUSED_INSTALLED = {
    **dict.fromkeys(("livox-mid360", "livox-hap", "ti-iwr6843"), _CONSTANTS),
}


@functools.cache
def subjects() -> dict[str, Sensor]:
    """Return every sensor that Kaitai supports, one for each set of frames, by id."""
    sensors = distinct_sensors()
    recoded = find_recoded(sensors.values())
    refused = {*REFUSED, *REFUSED_INSTALLED, *recoded, "shape-oddities"}
    return {name: sensor for name, sensor in sensors.items() if name not in refused}


def make_sensor(*fields: Any, case: str = "odd") -> Sensor:
    """Return a sensor with only this frame."""
    frame = Frame(Struct("sync" / Const(b"\x01\x02"), *fields), data=True, max_length=64)
    return Sensor(
        f"acme-{case.replace('_', '-')}",
        vendor="Acme",
        model="Odd",
        frames={"data": frame},
        points=lambda f: Polar(range=0, azimuth=0),
        scan=Every(1.0),
        links={"data": Serial(9600)},
        range_limits=(0, 1),
        status="manual",
        source="the tests",
    )


ODD = {
    "alternatives": (
        "kind" / Int8ul,
        "value" / IfThenElse(this.kind > 128, Int16ul, Struct("low" / Int8ul, "high" / Int8ul)),
    ),
    "arrays_of_arrays": ("count" / Int8ul, "grid" / Array(2, Array(3, Int16ul))),
    "odd_integers": (
        "wide" / BytesInteger(5, swapped=True),
        "many" / Array(2, Int24sb),
        "plain" / Array(2, BytesInteger(3)),
    ),
    "parts_up_to_a_value": (
        "Key" / Int8ul,
        "parts"
        / RepeatUntil(
            (obj_.Last == this._.Key % 2) | (obj_.Last > 99),
            Struct("Last" / Int8ul, "name" / CString("ascii")),
        ),
        "end" / Int8ul,
    ),
    "parts_of_arrays": (
        "flags" / Array(3, Struct("on_" / Int8ul, "more" / If(this.on_ > 100, Bytes(2)))),
        "end" / Int8ul,
    ),
}


PARTS = bytes([1, 2, 200, 11, 12, 3, 150, 13, 14, 9])
UNUSUAL = {case: make_sensor(*fields, case=case) for case, fields in ODD.items()}


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip(
        "kaitaistruct", reason="Kaitai's runtime is not installed: pip install kaitaistruct"
    )
    folder = tmp_path_factory.mktemp("ksy")
    kaitai.compile_all([*subjects().values(), *UNUSUAL.values()], folder)
    return folder


@pytest.mark.slow
def test_kaitai_reads_the_values_that_lidarspec_reads(compiled: Path) -> None:
    for sensor in subjects().values():
        found = kaitai.module(sensor, compiled)
        for frame in list_byte_frames(sensor):
            for seed in range(2):
                data = sensor.example(frame, seed=seed)
                read = kaitai.reader(found, sensor, frame).from_bytes(data)
                assert kaitai.differences(parse_wire_fields(sensor, frame, data), read) == [], (
                    f"{sensor.id} {frame}"
                )
                assert read._io.is_eof(), f"{sensor.id} {frame}"


@pytest.mark.parametrize("name", [name for name in SHAPED if name not in REFUSED])
def test_a_spec_has_a_type_for_every_frame_and_an_id_for_every_field(name: str) -> None:
    text = export(SHAPED[name], "ksy")
    for frame, value in SHAPED[name].frames.items():
        assert f"  {identifier(frame)}:\n" in text
        for field in make_schema(value.tree).fields.values():
            assert re.search(rf"\b{identifier(field.name)}\b", text), field.path


@pytest.mark.slow
def test_physical_values_are_instances(compiled: Path) -> None:
    sensor = subjects()["ldrobot-stl27l"]
    data = sensor.example("data", seed=1)
    read = kaitai.reader(kaitai.module(sensor, compiled), sensor, "data").from_bytes(data)
    assert read.start_angle_deg == pytest.approx(sensor.decode(data)["start_angle"][0])
    assert read.points[3].distance_m == pytest.approx(sensor.decode(data)["points.distance"][0, 3])


@pytest.mark.slow
def test_wrong_constants_are_noticed(compiled: Path) -> None:
    sensor = subjects()["ldrobot-stl27l"]
    data = sensor.example("data")
    with pytest.raises(Exception, match="not equal"):
        kaitai.reader(kaitai.module(sensor, compiled), sensor, "data").from_bytes(
            b"\x00" + data[1:]
        )


@pytest.mark.slow
@pytest.mark.parametrize("case", list(UNUSUAL))
def test_unusual_structs_parse_equally_in_kaitai(compiled: Path, case: str) -> None:
    sensor = UNUSUAL[case]
    found = kaitai.module(sensor, compiled)
    for seed in range(6):
        data = PARTS if case == "parts_of_arrays" else sensor.example("data", seed=seed)
        assert (
            kaitai.differences(
                sensor.parse(data), kaitai.reader(found, sensor, "data").from_bytes(data)
            )
            == []
        )


@pytest.mark.parametrize("name", list(REFUSED))
def test_structs_that_kaitai_cannot_express_are_refused(name: str) -> None:
    with pytest.raises(ExportError, match=REFUSED[name]):
        export(SHAPED[name], "ksy")


@pytest.mark.slow
def test_sensors_that_kaitai_cannot_express_are_refused() -> None:
    for name, reason in REFUSED_INSTALLED.items():
        with pytest.raises(ExportError, match=reason):
            export(lidarspec.sensor(name), "ksy")


def test_other_refusals_have_reasons_too() -> None:
    with pytest.raises(ExportError, match="this float has 2 bytes"):
        export(make_sensor("half" / Float16b), "ksy")
    with pytest.raises(ExportError, match="two members with the Kaitai name 'speed'"):
        export(make_sensor("speed" / Int8ul, "Speed" / Int8ul), "ksy")
    with pytest.raises(ExportError, match="Python function branches"):
        export(
            make_sensor(
                "count" / Int8ul, "items_" / Array(lambda this: 2 if this.count > 3 else 1, Int8ul)
            ),
            "ksy",
        )


def test_yaml_quotes_ambiguous_words() -> None:
    value = {
        "a": "yes",
        "b": "x: y",
        "c": [1, 2],
        "d": {"e": "", "f": [{"g": True}]},
        "h": "#1",
        "i": "10",
        "j": [],
    }
    assert yaml(value) == (
        'a: "yes"\nb: "x: y"\nc: [1, 2]\nd:\n  e: ""\n  f:\n    - g: true\n'
        'h: "#1"\ni: "10"\nj: []\n'
    )
