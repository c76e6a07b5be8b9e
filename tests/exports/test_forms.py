"""Tests of the exports md, svg, json and pyi, and of the verb."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from construct import Bytes, Const, Int8ub, Int16ub, Struct

import lidarspec as ls
from lidarspec import Sensor
from lidarspec.exports import EXPORTS, ExportError, UnknownExport, export, select_frame
from lidarspec.exports.diagram import BIT_WIDTH_PX, LEFT_MARGIN_PX, ROW_BITS
from lidarspec.exports.json import node_data
from lidarspec.frames.schema import make_schema
from lidarspec.spec import Checksummed, Command, Frame, PacketCounter, WordXor, ZeroPadded
from tests.broken import sound
from tests.cli.running import ran
from tests.exports.json_decoder import Decoder
from tests.exports.trees import distinct_frames, installed_sensors, is_recoded, number
from tests.shapes import SHAPES, mixed, receiver

SHAPED = [name for name, sensor in SHAPES.items() if sensor.frames]
#: the shapes that other languages can read.
SPOKEN = [name for name in SHAPED if name != "shape-text" and not is_recoded(SHAPES[name])]
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "spec-json.md"
#: keys below which names stand that each spec chooses.
NAMED = {"links", "frames", "commands", "values", "args", "matches", "lines", "labels", "names"}


def list_exportable() -> list[Sensor]:
    """Load the installed sensors that other languages can read, one for each set of frames."""
    return [sensor for sensor in installed_sensors().values() if not is_recoded(sensor)]


@pytest.mark.parametrize("name", SPOKEN)
def test_json_is_enough_to_decode_frames(name: str) -> None:
    assert_json_is_enough(SHAPES[name], SHAPES[name].frames)


@pytest.mark.parametrize("kind", ["c", "ksy", "wireshark"])
def test_text_frames_are_left_out_and_named(kind: str) -> None:
    text = export(mixed.SENSOR, kind)
    assert "frames of text or of escaped bytes are omitted: line (Tokens)" in text
    fields = text.replace("line (Tokens)", "")
    assert "latitude" in fields
    assert "satellites" not in fields
    assert "are omitted" not in export(receiver.SENSOR, kind)


def test_json_has_text_frames_with_their_wire_form() -> None:
    frames = json.loads(export(mixed.SENSOR, "json"))["frames"]
    assert frames["fix"]["wire"] is None
    wire = frames["line"]["wire"]
    assert (wire["form"], wire["start"], wire["sep"]) == ("Tokens", b"$".hex(), b",".hex())


def test_json_has_the_algorithm_inside_another_one() -> None:
    body = Struct("count" / Int8ub, "sum" / Int16ub)
    checksummed = Checksummed(body, field="sum", algorithm=ZeroPadded(WordXor(1, (1, 2)), 8))
    layout = node_data(Frame(checksummed).tree)
    algorithm = layout["checksum"]["algorithm"]
    assert (algorithm["kind"], algorithm["to"]) == ("ZeroPadded", 8)
    inner = algorithm["algorithm"]
    assert (inner["kind"], inner["head"], inner["groups"]) == ("WordXor", 1, (1, 2))


@pytest.mark.slow
def test_json_of_installed_sensors_is_enough_to_decode_frames() -> None:
    frames = distinct_frames(list_exportable())
    for sensor in list_exportable():
        assert_json_is_enough(sensor, {name for one, name in frames if one is sensor})


def assert_json_is_enough(sensor: Sensor, frames: Iterable[str]) -> None:
    """Fail unless these frames are decoded from the JSON alone as the sensor parses them."""
    spec = json.loads(export(sensor, "json"))
    for frame in frames:
        layout = spec["frames"][frame]["layout"]
        for seed in range(3):
            data = sensor.example(frame, seed=seed)
            decoder = Decoder(data)
            assert same(decoder.read(layout), sensor.parse(data, frame)), f"{sensor.id} {frame}"
            assert decoder.at == len(data)


def same(one: Any, other: Any) -> bool:
    if isinstance(other, dict):
        return set(one) == set(other) and all(
            same(one[name], value) for name, value in other.items()
        )
    if isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(other, str):
        return one == other.encode()
    other = number(other)
    return one == other or (one != one and other != other)


def keys(value: Any, above: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key, part in value.items():
            if above not in NAMED:
                yield key
            yield from keys(part, key if above not in NAMED else "")
    elif isinstance(value, list):
        for part in value:
            yield from keys(part)


def test_every_key_of_the_json_is_documented() -> None:
    assert_keys_are_documented([SHAPES[name] for name in SPOKEN])


@pytest.mark.slow
def test_every_key_of_the_json_of_installed_sensors_is_documented() -> None:
    assert_keys_are_documented(list_exportable())


def assert_keys_are_documented(sensors: list[Sensor]) -> None:
    """Fail unless the page names every key that the JSON of these sensors has."""
    page = PAGE.read_text(encoding="utf-8")
    used = {key for sensor in sensors for key in keys(json.loads(export(sensor, "json")))}
    assert used - set(re.findall(r"`(\w+)`", page)) == set()


def test_json_has_the_returns_of_a_sensor_and_of_its_counter() -> None:
    pairs = SHAPES["shape-pairs"]
    spec = json.loads(export(pairs, "json"))
    assert spec["returns"] == ["first", "last"]
    assert spec["sequence"] == {"field": "number", "first": 1, "last": 40, "returns": None}
    twos = replace(pairs, sequence=PacketCounter("number", returns=2))
    assert json.loads(export(twos, "json"))["sequence"]["returns"] == 2
    assert json.loads(export(SHAPES["shape-synced"], "json"))["returns"] == []


@pytest.mark.parametrize("name", SPOKEN)
def test_diagrams_name_every_field_and_stay_within_their_rows(name: str) -> None:
    assert_diagram_is_complete(SHAPES[name])


@pytest.mark.slow
def test_diagrams_of_installed_sensors_name_every_field() -> None:
    for sensor in list_exportable():
        assert_diagram_is_complete(sensor)


def assert_diagram_is_complete(sensor: Sensor) -> None:
    """Fail unless a diagram names every field and no box leaves its row."""
    root = ElementTree.fromstring(export(sensor, "svg"))
    says = {title.text or "" for title in root.iter("{http://www.w3.org/2000/svg}title")}
    for frame in sensor.frames.values():
        for path in make_schema(frame.tree).fields:
            assert any(said.split("; ")[0] == path for said in says), path
    boxes = [
        box
        for group in root.iter("{http://www.w3.org/2000/svg}g")
        for box in group.iter("{http://www.w3.org/2000/svg}rect")
    ]
    for box in boxes:
        assert (
            LEFT_MARGIN_PX
            <= float(box.get("x", "0"))
            <= float(box.get("x", "0")) + float(box.get("width", "0"))
            <= LEFT_MARGIN_PX + ROW_BITS * BIT_WIDTH_PX
        )


def test_boxes_do_not_overlap_and_fill_their_bits() -> None:
    root = ElementTree.fromstring(export(select_frame(ls.sensor("cspc-m1c1-mini"), "info"), "svg"))
    seen: set[tuple[float, float]] = set()
    for box in root.iter("{http://www.w3.org/2000/svg}rect"):
        if "x" in box.attrib:
            columns = {
                (float(box.attrib["y"]), float(box.attrib["x"]) + bit * BIT_WIDTH_PX)
                for bit in range(int(float(box.attrib["width"]) / BIT_WIDTH_PX))
            }
            assert not seen & columns
            seen |= columns
    assert len(seen) == 8 * 27


@pytest.mark.parametrize("name", SHAPED)
def test_pages_have_every_frame_command_and_field(name: str) -> None:
    assert_page_is_complete(SHAPES[name])


@pytest.mark.slow
def test_pages_of_installed_sensors_have_every_frame_command_and_field() -> None:
    for sensor in installed_sensors().values():
        assert_page_is_complete(sensor)


def assert_page_is_complete(sensor: Sensor) -> None:
    """Fail unless a page has every frame, field and command, and tables of even width."""
    text = export(sensor, "md")
    for frame, value in sensor.frames.items():
        assert f"## `{frame}`: " in text
        for field in make_schema(value.tree).fields.values():
            assert re.search(rf"`(\w+(\[\w\])*\.)*{field.name}(\[\w\])*`", text), field.path
    assert all(f"| `{command}` |" in text for command in sensor.commands)
    for table in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1


def test_a_reference_page_has_all_facts() -> None:
    text = export(ls.sensor("cspc-m1c1-mini"), "md")
    assert "| link `data` | serial, 150 000 or 115 200 baud, 8N1" in text
    assert (
        "| `start` | `aa 55 f0 0f` | `ack` | starts the data; sent when the device is opened |"
        in text
    )
    assert "| 15 | 15.000 deg |" in export(ls.sensor("velodyne-vlp16"), "md")


SNIPPET = """
from typing import cast
import lidarspec as ls
from cspc_m1c1_mini import CspcM1c1Mini, Data
from ldrobot_stl27l import LdrobotStl27l

mini = cast(CspcM1c1Mini, ls.sensor("cspc-m1c1-mini"))
frame: Data = mini.parse(b"", "data")
reveal_type(frame.samples[0].distance)
reveal_type(mini.parse(b"", "info").model)
reveal_type(mini.command("start"))
reveal_type(cast(LdrobotStl27l, ls.sensor("ldrobot-stl27l")).build("data", speed=3600))
frame.smaples
mini.command("strat").nothing
"""


@pytest.mark.parametrize("name", SPOKEN)
def test_stubs_are_python_that_names_every_field(name: str) -> None:
    tree = ast.parse(export(SHAPES[name], "pyi"))
    names = {
        node.target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    fields = {
        field.name
        for frame in SHAPES[name].frames.values()
        for field in make_schema(frame.tree).fields.values()
    }
    assert fields <= names


@pytest.mark.slow
def test_a_type_checker_takes_the_stubs_and_finds_misspelt_fields(tmp_path: Path) -> None:
    sensors = [*(SHAPES[name] for name in SPOKEN), *list_exportable()]
    for sensor in sensors:
        (tmp_path / f"{sensor.id.replace('-', '_')}.pyi").write_text(
            export(sensor, "pyi"), encoding="utf-8"
        )
    (tmp_path / "snippet.py").write_text(SNIPPET, encoding="utf-8")
    stubs = [f"{sensor.id.replace('-', '_')}.pyi" for sensor in sensors]
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--follow-imports=silent",
        "snippet.py",
        *stubs,
    ]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
    )
    shown = [line.partition(": ")[2] for line in done.stdout.splitlines()]
    assert [
        line.partition('"')[2].strip('"') for line in shown if line.startswith("note: Revealed")
    ] == ["int", "bytes", "bytes", "bytes"]
    errors = [line for line in shown if line.startswith("error")]
    assert any('"Data" has no attribute "smaples"' in line for line in errors)
    assert any('"bytes" has no attribute "nothing"' in line for line in errors)
    assert len(errors) == 2, done.stdout


@pytest.mark.parametrize("kind", ["ksy", "svg", "json", "pyi"])
def test_python_code_is_refused_with_the_reason(kind: str) -> None:
    with pytest.raises(ExportError, match="angle: Decimal"):
        export(SHAPES["shape-text"], kind)


def test_an_unknown_kind_is_an_error() -> None:
    with pytest.raises(UnknownExport, match="did you mean 'json'"):
        export(ls.sensor("ldrobot-stl27l"), "jsn")


@pytest.mark.parametrize("kind", ["ksy", "md", "svg", "json", "pyi"])
def test_the_verb_prints_and_writes_every_kind(kind: str, tmp_path: Path) -> None:
    assert kind in EXPORTS
    printed = ran("export", kind, "robosense-m1").stdout
    assert printed == export(ls.sensor("robosense-m1"), kind)
    ran("export", kind, "robosense-m1", "-o", tmp_path / "out", "--frame", "difop")
    alone = (tmp_path / "out").read_text(encoding="utf-8")
    assert alone == export(select_frame(ls.sensor("robosense-m1"), "difop"), kind)
    assert "return_seq" not in alone


def test_errors_of_the_verb() -> None:
    result = ran(
        "export",
        "json",
        Path(__file__).parents[1] / "shapes" / "stranger" / "acme_lidars.py",
        code=0,
    )
    assert json.loads(result.stdout)["vendor"]
    assert (
        "unknown frame 'dta'; did you mean 'data'?"
        in ran("export", "svg", "ldrobot-ld06", "--frame", "dta", code=2).stderr
    )
    assert "did you mean 'ldrobot-ld06'" in ran("export", "svg", "ldrobot-ld006", code=2).stderr


def test_bytes_in_a_command_are_hex_in_the_json() -> None:
    order = Frame(Struct("header" / Const(b"\x16"), "key" / Bytes(2)), direction="out")
    command = Command("order", {"key": b"\xab\xcd"}, reply="ack", matches={"code": b"\x01"})
    sensor = sound.sensor(
        frames={"data": sound.frame(), "ack": Frame(sound.ACK), "order": order},
        commands={"start": command},
    )
    said = json.loads(export(sensor, "json"))["commands"]["start"]
    assert (said["values"], said["matches"]) == ({"key": "abcd"}, {"code": "01"})
