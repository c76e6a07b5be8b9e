"""Tests of the test kit: strategies, shrinking, acknowledgements, vectors, fixtures."""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from construct import (
    Array,
    Bytes,
    Const,
    Float16b,
    Float32l,
    Float64l,
    GreedyBytes,
    Int8ul,
    Int16sl,
    Int16ub,
    Int16ul,
    NullTerminated,
    Struct,
    this,
)
from hypothesis import strategies as st

from lidarspec import Sensor
from lidarspec.framing.example_frames import random_frame
from lidarspec.framing.frame_engine import CompiledCodec
from lidarspec.spec import (
    Checksummed,
    Command,
    Crc,
    Fields,
    Frame,
    Http,
    HttpReply,
    HttpRequest,
    OnChange,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Sum,
    take,
)
from lidarspec.testing import consistency, frames
from lidarspec.testing.check import CheckTarget, iter_reports
from lidarspec.testing.commands import the_simulated_sensor_answers
from lidarspec.testing.declaration import check_declaration
from lidarspec.testing.findings import ViolationError, list_unacknowledged
from lidarspec.testing.frames import (
    values_in_units_build_the_same_bytes,
    values_survive_building_and_parsing,
)
from lidarspec.testing.geometry import angles_are_in_order, the_points_turn_as_the_axes_do
from lidarspec.testing.properties import PROPERTIES, Property
from lidarspec.testing.sensor_under_test import SensorUnderTest
from lidarspec.testing.vectors import points_stand_in_two_quadrants, vectors_hold
from tests.broken import (
    code_for_range,
    degrees,
    intensity_of_distance,
    no_example,
    no_wrap_aligned,
    option_ignored,
    option_unread,
    sound,
    times_in_milliseconds,
    wrap_too_early,
)
from tests.shapes import count

AUTHOR = """
import lidarspec as ls
from lidarspec import errors
import pytest
from lidarspec.testing import SensorConformance

class TestMine(SensorConformance):
    sensor = {sensor!r}
    examples = 4

    def test_a_test_of_my_own(self, sensor):
        assert sensor.id == "acme-x1"

@pytest.mark.lidarspec("ldrobot-stl27l")
def test_a_port(sensor, virtual_port):
    with ls.open(virtual_port().path, sensor) as device:
        assert len(next(device.scans())) > 100

def test_nothing_is_installed(bare_registry):
    assert ls.sensors() == {{}}
    with pytest.raises(errors.UnknownSensor):
        ls.sensor("ldrobot-stl27l")

def test_all_is_installed_again():
    assert ls.sensors()

def test_which_sensor(sensor):
    pass
"""
STRANGER = Path(__file__).resolve().parents[1] / "shapes" / "stranger" / "acme_lidars.py"


def run(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command, env = [sys.executable, *words], {**os.environ, **variables}
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=300, env=env
    )


def codes(sensor: Sensor) -> set[str]:
    return {
        finding.code
        for report in iter_reports(CheckTarget([sensor]), sensor.id, examples=6)
        for finding in report.findings
    }


@pytest.mark.slow
def test_an_authors_tests_run_with_the_kits_fixtures(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(AUTHOR.format(sensor=str(STRANGER)), encoding="utf-8")
    done = run(
        tmp_path, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "--strict-markers", "."
    )
    assert "sensor missing: mark the test with" in done.stdout
    # On a busy machine, a warning that a plugin loads slowly comes between them.
    assert re.search("5 passed,( [0-9]+ warnings?,)? 1 error", done.stdout), done.stdout
    assert "failed" not in done.stdout, done.stdout


def test_the_plugin_loads_nothing_of_the_engine(tmp_path: Path) -> None:
    (tmp_path / "test_other.py").write_text(
        "import sys\n\ndef test_light():\n"
        "    assert 'lidarspec.testing.pytest_plugin' in sys.modules\n"
        "    heavy = {'numpy', 'construct', 'hypothesis', 'lidarspec.spec.description',"
        " 'lidarspec.plugins'}\n"
        "    assert not heavy & sys.modules.keys()\n",
        encoding="utf-8",
    )
    words = [
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "lidarspec",
        ".",
    ]  # by its name as an entry point
    # Plugins of other libraries could import anything.
    done = run(tmp_path, *words, PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    assert done.returncode == 0, done.stdout


#: bytes of a frame that is too long to try everything with it, and of its copies with flipped bits
#: that are tried.
LONG = 100_000
FLIPPED_BYTES = 1 << 22
LONG_FRAME = Checksummed(
    Struct(
        "header" / Const(b"\xaa\x55\xc3"),
        "count" / Int8ul,
        "picture" / Bytes(LONG - 6),
        "sum" / Int16ul,
    ),
    field="sum",
    algorithm=Sum(16),
)


@pytest.mark.parametrize(
    "check",
    [one for one in PROPERTIES if one.function.__module__.endswith("testing.frames")],
    ids=lambda one: one.name,
)
def test_work_with_a_long_frame_is_limited_in_bytes(
    check: Property, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = sound.sensor(
        frames={**sound.sensor().frames, "picture": Frame(LONG_FRAME, max_length=LONG)}
    )
    parsed = surveyed = 0
    parse, survey = Sensor.parse, CompiledCodec.survey

    def counting_parse(self: Sensor, data: bytes, **options: Any) -> Any:
        nonlocal parsed
        parsed += len(data)
        assert parsed <= 16 * LONG
        return parse(self, data, **options)

    def counting_survey(self: CompiledCodec, data: Any, *rest: Any) -> Any:
        nonlocal surveyed
        surveyed += len(data)
        assert surveyed <= 3 * FLIPPED_BYTES + 8 * LONG
        return survey(self, data, *rest)

    monkeypatch.setattr(frames, "MAX_FLIPPED_BYTES", FLIPPED_BYTES, raising=False)
    monkeypatch.setattr(Sensor, "parse", counting_parse)
    monkeypatch.setattr(CompiledCodec, "survey", counting_survey)
    check.function(SensorUnderTest(sensor), "picture")


def test_progress_names_each_case_before_it_begins() -> None:
    seen: list[tuple[str, int, int]] = []
    (sensor,) = no_example.lidarspec_sensors()
    list(iter_reports(CheckTarget([sensor]), sensor.id, watch=lambda *told: seen.append(told)))
    assert seen[0] == ("broken-one: declaration", 0, len(PROPERTIES))
    assert seen[1] == ("broken-one: examples_are_valid_and_repeat data", 0, len(PROPERTIES))


def test_a_long_length_that_a_count_in_the_header_can_reach_is_no_finding() -> None:
    def plausible(f: Fields) -> Any:
        return (f.count >= 1) & (f.first < 360) & (f.last < 360) & (f.time < sound.WRAP)

    struct = sound.make_frame(count=Int16ul)
    assert (
        find_broken_rules(
            sound.sensor(Frame(struct, data=True, max_length=16 + 3 * 65_535, plausible=plausible))
        )
        == set()
    )
    page = Frame(HttpReply, max_length=65_536)
    ask = Frame(HttpRequest, direction="out", max_length=4096)
    assert (
        find_broken_rules(
            sound.sensor(
                frames={**sound.sensor().frames, "page": page, "ask": ask},
                links={**sound.sensor().links, "web": Http(80)},
            )
        )
        == set()
    )


@pytest.mark.parametrize(
    ("plugin", "code"),
    [
        (wrap_too_early, "LS512"),
        (times_in_milliseconds, "LS513"),
        (no_wrap_aligned, "LS504"),
        (option_unread, "LS217"),
        (option_ignored, "LS217"),
        (intensity_of_distance, "LS218"),
        (code_for_range, "LS219"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__.rpartition(".")[2],
)
def test_contradictions_are_named(plugin: Any, code: str) -> None:
    def found(sensor: Sensor) -> set[str]:
        subject = SensorUnderTest(sensor)
        consistent = [
            one for one in PROPERTIES if one.function.__module__.endswith("testing.consistency")
        ]
        findings = [
            *check_declaration(subject),
            *(finding for one in consistent for finding in one.findings(subject)),
        ]
        return {finding.code for finding in findings}

    (sensor,) = plugin.lidarspec_sensors()
    assert found(sensor) == {code}
    assert found(sound.sensor()) == set()


ROWS = Array(6, Struct("distances" / Array(16, Scaled(Int16ul, 0.001, "m"))))


def make_solid_state_sensor(packets_per_scan: int = 1) -> Sensor:
    """Return a sensor with rows of pixels from -56 to 56 degrees, without a ring."""
    azimuths = np.deg2rad((np.arange(16) - 7.5) * 7.5)
    elevations = np.deg2rad((2.5 - np.arange(6)) * 10)[:, None]
    frame = Struct("magic" / Const(b"\x5a\x77\xff\x43"), "number" / Int8ul, "rows" / ROWS)
    return Sensor(
        "acme-solid",
        vendor="Acme",
        model="Solid",
        frames={"data": Frame(frame, data=True)},
        points=lambda f: Polar(f.rows.distances, azimuths, elevations),
        scan=OnChange("number"),
        links={"data": Serial(115200)},
        range_limits=(0.1, 10.0),
        status="manual",
        source="invented",
        simulation=Simulation(lambda i: {"number": i // packets_per_scan % 256}, rate=15),
    )


def make_fan_sensor(packets_per_scan: int = 1) -> Sensor:
    """Return a sensor with one row of beams from -60 to 60 degrees."""
    azimuths = np.deg2rad(np.arange(161) * 0.75 - 60)
    distances = Array(161, Scaled(Int16ul, 0.001, "m"))
    frame = Struct("magic" / Const(b"\x5a\x77\xff\x43"), "number" / Int8ul, "distances" / distances)
    return replace(
        make_solid_state_sensor(packets_per_scan),
        frames={"data": Frame(frame, data=True)},
        points=lambda f: Polar(f.distances, azimuths),
    )


@pytest.mark.parametrize("make_sensor", [make_solid_state_sensor, make_fan_sensor])
def test_the_azimuth_may_step_back_only_where_a_scan_ends(
    make_sensor: Callable[..., Sensor],
) -> None:
    assert codes(make_sensor()) == set()
    with pytest.raises(ViolationError, match=r"steps back .* in packet 1 of the sweep") as caught:
        angles_are_in_order(SensorUnderTest(make_sensor(packets_per_scan=2)), "data")
    assert caught.value.code == "LS506"


def rare(f: object) -> object:
    return f.key == 0xBEEF  # type: ignore[attr-defined]


INFO = Checksummed(
    Struct("header" / Const(b"\x18\x81\x55"), "key" / Int16ul, "check" / Int8ul),
    field="check",
    algorithm=Sum(8),
)


@pytest.mark.parametrize(
    "how", [st.just(0xBEEF), lambda source: 0xBEEF], ids=["strategy", "function"]
)
def test_underivable_facts_are_requested_by_name(how: object) -> None:
    plain = sound.sensor()
    sensor = replace(
        plain, frames={**plain.frames, "info": Frame(INFO, max_length=6, plausible=rare)}
    )
    assert codes(sensor) == {"LS301"}
    subject = SensorUnderTest(sensor, 6, strategies={"info.key": how})
    assert {sensor.parse(subject.example("info", seed=seed)).key for seed in range(5)} == {0xBEEF}
    values_survive_building_and_parsing(subject, "info")


class Lossy(Sensor):
    """A sensor that loses the sign of the tilt when it builds a frame."""

    def build(self, frame, value=None, /, *, units=False, **values):  # type: ignore[no-untyped-def]
        if frame == "data" and value is not None and value.get("tilt", 0) < -100:
            value = {**value, "tilt": -value["tilt"]}
        return super().build(frame, value, units=units, **values)


@pytest.mark.slow
def test_a_failing_edit_shrinks_to_the_field_at_fault() -> None:
    with pytest.raises(ViolationError) as found:
        values_survive_building_and_parsing(SensorUnderTest(sound.sensor(kind=Lossy), 80), "data")
    assert (found.value.code, found.value.path) == ("LS305", "data.tilt")
    assert found.value.what == "-101 was written, but 101 was read"


@pytest.mark.slow
def test_an_edit_is_read_back_beside_integers_that_cannot_be_edited() -> None:
    frame = sound.frame(sound.make_frame(revision=Const(3, Int8ul)), max_length=sound.SIZE + 1)
    with pytest.raises(ViolationError, match="-101 was written, but 101 was read"):
        values_survive_building_and_parsing(
            SensorUnderTest(sound.sensor(frame, Lossy), 200), "data"
        )


def find_broken_rules(sensor: Sensor) -> set[str]:
    """Return the unacknowledged findings of a declaration."""
    return {
        finding.code
        for finding in list_unacknowledged(
            check_declaration(SensorUnderTest(sensor)), sensor, whole=True
        )
    }


def test_intended_findings_are_acknowledged_with_a_reason() -> None:
    far = sound.sensor(range_limits=(0.05, 100.0))
    assert find_broken_rules(far) == {"LS210"}
    assert (
        find_broken_rules(replace(far, acknowledged={"LS210": "the next model reaches so far"}))
        == set()
    )
    assert (
        find_broken_rules(
            replace(
                far, acknowledged={"LS210 data.samples.distance": "the next model reaches so far"}
            )
        )
        == set()
    )
    assert find_broken_rules(replace(far, acknowledged={"LS210": " "})) == {"LS209", "LS210"}
    assert find_broken_rules(replace(far, acknowledged={"LS210 data.tilt": "no"})) == {
        "LS209",
        "LS210",
    }


def test_an_acknowledged_rule_that_was_not_checked_may_occur() -> None:
    (sensor,) = degrees.lidarspec_sensors()
    assert codes(replace(sensor, acknowledged={"LS506": "a mirror"})) == {"LS502"}


@pytest.mark.slow
def test_acknowledged_findings_do_not_skip_checks() -> None:
    coded = sound.make_frame(
        samples=Array(this.count, Struct("distance" / Int16ul, "quality" / Int8ul))
    )
    bare = sound.sensor(sound.frame(coded), acknowledged={"LS201": "a code"})
    (report,) = iter_reports(CheckTarget([bare]), "bare", examples=1)
    assert "LS201" not in {finding.code for finding in report.findings}
    assert "the_simulated_sensor_answers" not in report.skipped


def test_table_indices_need_no_unit() -> None:
    def points(f: Fields) -> Polar:
        return Polar(f.samples.distance, take(np.linspace(0, 1, 256), f.number))

    assert find_broken_rules(sound.sensor(points=points)) == set()
    assert find_broken_rules(
        sound.sensor(points=lambda f: Polar(f.samples.distance, f.number / 256))
    ) == {"LS201"}


BY_VECTORS = Path(sound.__file__).parent / "by_vectors" / "vectors.json"


def list_lacking(sensor: Sensor, vectors: list[dict[str, Any]] | None, *family: str) -> list[str]:
    """Return the findings about missing golden vectors of a sensor."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "vectors.json"
        file.write_text(json.dumps(vectors), encoding="utf-8")
        subject = SensorUnderTest(sensor, vectors=None if vectors is None else file, family=family)
        about = [
            one
            for one in PROPERTIES
            if one.function.__module__ == vectors_hold.__module__ and not one.lacks(subject)
        ]
        return [
            f"{finding.code} {finding.path}: {finding.what}"
            for one in about
            for finding in one.findings(subject)
        ]


def test_a_status_is_proven_by_vectors_of_its_own() -> None:
    proven, known = (
        sound.sensor(status="vectors"),
        json.loads(BY_VECTORS.read_text(encoding="utf-8")),
    )
    assert list_lacking(proven, None) == [
        "LS710 : status is 'vectors', but there is no file with golden vectors"
    ]
    assert list_lacking(proven, [{**entry, "sensor": "broken-two"} for entry in known]) == [
        "LS710 : status is 'vectors', but vectors.json contains no vectors of broken-one"
    ]
    assert (
        list_lacking(
            proven,
            [{**entry, "sensor": ["broken-one", "broken-two"]} for entry in known],
            "broken-one",
            "broken-two",
        )
        == []
    )
    assert list_lacking(sound.sensor(), None) == []
    assert list_lacking(sound.sensor(status="capture"), None) == []


def test_vectors_of_several_sensors_name_their_sensor() -> None:
    known = json.loads(BY_VECTORS.read_text(encoding="utf-8"))
    asked = list_lacking(sound.sensor(), known, "broken-one", "broken-two")
    assert 'so the vector must name its sensor: "sensor": "broken-one"' in asked[0]
    asked = list_lacking(
        sound.sensor(), [{**entry, "sensor": "borken-one"} for entry in known], "broken-one"
    )
    assert "the vector names 'borken-one', but these sensors share the file: broken-one" in asked[0]


def test_a_field_of_the_data_that_no_vector_pins_down_is_named() -> None:
    first, second = json.loads(BY_VECTORS.read_text(encoding="utf-8"))
    del (
        first["values"]["last"],
        first["values"]["samples[1].distance"],
        second["values"]["samples[1].distance"],
    )
    first["values"]["samples[2].distance"] = 0
    assert list_lacking(sound.sensor(), [first, second]) == [
        "LS711 data: no vector states a value of last; all vectors have 0 for samples.distance"
    ]
    ack = {"frame": "ack", "hex": sound.sensor().example("ack").hex(), "source": "made up"}
    assert list_lacking(sound.sensor(), [ack]) == []
    (finding,) = list_lacking(sound.sensor(), [{**ack, "hex": ack["hex"] + "00"}])
    assert finding.startswith("LS707 vectors[0] ack: ")


def test_a_file_without_vectors_of_the_data_says_nothing_of_returns(tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    ack = {"frame": "ack", "hex": sound.sensor().example("ack").hex(), "source": "made up"}
    file.write_text(json.dumps([ack]), encoding="utf-8")
    subject = SensorUnderTest(sound.sensor(), vectors=file)
    points_stand_in_two_quadrants(subject, "data")
    assert subject.picture == {"data: vectors": "the file has no vectors of this frame type"}


def test_vectors_place_points_in_two_quadrants_within_reach() -> None:
    first, second = json.loads(BY_VECTORS.read_text(encoding="utf-8"))
    assert list_lacking(sound.sensor(range_limits=(0.05, 4.0)), [first, second]) == [
        "LS713 data: range_limits end at 4 m, but a vector has a point at 4.66 m"
    ]
    del second["points"]
    assert list_lacking(sound.sensor(), [first, second]) == [
        "LS712 data.points: all points of the vectors are in 1 quadrant"
    ]


@pytest.mark.parametrize(
    ("axes", "sense"),
    [(("right", "forward", "up"), "clockwise"), (("forward", "left", "up"), "counter-clockwise")],
)
def test_the_sense_of_the_points_is_measured_and_held_against_the_axes(
    axes: tuple[str, str, str], sense: str
) -> None:
    sign = 1 if sense == "counter-clockwise" else -1

    def turning(sign: int, f: Fields) -> Polar:
        return Polar(f.samples.distance, sign * sound.points(f).azimuth)

    right, wrong = (
        SensorUnderTest(sound.sensor(points=partial(turning, way), vendor_axes=axes))
        for way in (sign, -sign)
    )
    the_points_turn_as_the_axes_do(right, "data")
    assert right.picture["data: sense"] == f"{sense} as first grows, seen from above"
    with pytest.raises(ViolationError, match=f"turn {sense}") as found:
        the_points_turn_as_the_axes_do(wrong, "data")
    assert found.value.code == "LS511"


def test_a_checksum_in_the_wrong_byte_order_is_reported() -> None:
    swapped = sound.frame(Checksummed(sound.struct(sum=Int16ub), field="sum", algorithm=Sum(16)))
    known = json.loads(BY_VECTORS.read_text(encoding="utf-8"))
    assert (
        "Sum(16) over all other bytes, stored little-endian,"
        in list_lacking(sound.sensor(swapped), known)[0]
    )


def test_the_checksum_that_is_offered_is_as_wide_as_its_field() -> None:
    def data(algorithm: Any) -> Sensor:
        struct = sound.struct(spare=Int16ul, sum=Int16ub)
        return sound.sensor(
            sound.frame(
                Checksummed(struct, field="sum", algorithm=algorithm), max_length=sound.SIZE + 2
            )
        )

    right = data(Sum(16))
    parsed = [right.parse(right.example("data", seed=seed)) for seed in range(6)]
    # The sum is right in four bytes as well.
    frames = [right.build("data", {**one, "spare": 0}) for one in parsed]
    vectors = [{"frame": "data", "hex": frame.hex(), "source": "made up"} for frame in frames]
    (said,) = {
        text.partition("; ")[2]
        for text in list_lacking(data(Crc(16, 0x1021)), vectors)
        if text.startswith("LS703 vectors[0]")
    }
    assert said == "Sum(16) over all other bytes, stored big-endian, fits"


@pytest.mark.parametrize("samples", [3, 200], ids=["short", "long"])
def test_a_checksum_of_another_name_is_found_in_the_vectors(samples: int) -> None:
    struct = Struct(
        "header" / Const(b"\xaa\x55\xc3"), "samples" / Array(samples, Int16ul), "end" / Int16ul
    )
    plain = Frame(struct, data=True, max_length=5 + 2 * samples)
    checksummed = replace(plain, struct=Checksummed(struct, field="end", algorithm=Crc(16, 0x8005)))
    examples = [sound.sensor(checksummed).example("data", seed=seed) for seed in range(3)]
    vectors = [{"frame": "data", "hex": data.hex(), "source": "made up"} for data in examples]
    said = (
        "LS212 data.end: Crc(width=16, poly=0x8005) over all other bytes,"
        " stored little-endian, matches every vector"
    )
    assert list_lacking(sound.sensor(plain), vectors)[0].startswith(said)
    assert not any(
        text.startswith("LS212") for text in list_lacking(sound.sensor(checksummed), vectors)
    )


def test_an_invalid_vector_does_not_hide_others() -> None:
    known = json.loads(BY_VECTORS.read_text(encoding="utf-8"))
    wrong = {**known[0], "values": {"number": 19}}
    vectors = [
        {"frame": "none", "hex": "", "source": "x"},
        wrong,
        {"frame": "data", "hex": "zz", "source": "x"},
        {**known[1], "source": ""},
    ]
    said = [text.partition(":")[0] for text in list_lacking(sound.sensor(), vectors)]
    assert said[:4] == [
        "LS702 vectors[0]",
        "LS706 vectors[1] data.number",
        "LS702 vectors[2]",
        "LS701 vectors[3]",
    ]


def test_a_reply_that_cannot_be_simulated_requires_answers() -> None:
    def configure(sensor: Sensor, *, serial: int) -> Sensor:
        return sensor

    def finding(command: Command, frame: Frame) -> list[str]:
        plain = sound.sensor()
        frames = {**plain.frames, "page": frame}
        sensor = sound.sensor(frames=frames, commands={"ask": command}, configure=configure)
        (answering,) = [one for one in PROPERTIES if one.function is the_simulated_sensor_answers]
        return [
            f"{found.code} {found.path}: {found.what}"
            for found in answering.findings(SensorUnderTest(sensor))
        ]

    page = Frame(
        Struct("mark" / Const(b"RPLY"), "size" / Int8ul, "text" / Bytes(this.size)), max_length=64
    )
    ended = Frame(
        Struct("mark" / Const(b"RPLY"), "text" / Array(1, NullTerminated(GreedyBytes))),
        max_length=64,
    )
    learning = Command(
        "order", {"code": 9}, reply="page", learns=lambda reply: {"serial": int(reply.text)}
    )
    (empty,) = finding(learning, page)
    assert empty.startswith(
        "LS604 commands.ask: the options cannot be read from the simulated reply:"
    )
    (unmade,) = finding(Command("order", {"code": 9}, reply="page"), ended)
    assert unmade.startswith(
        "LS604 commands.ask: the reply cannot be simulated without answers= in the Simulation:"
        " page: cannot be simulated"
    )


def test_vectors_that_prove_nothing_are_findings(tmp_path: Path) -> None:
    file = tmp_path / "vectors.json"
    for text, code in {
        "{": "LS702",
        "{}": "LS702",
        '[{"frame": "none", "hex": "", "source": "x"}]': "LS702",
        '[{"frame": "data", "hex": "zz", "source": "x"}]': "LS702",
        '[{"frame": "data", "hex": "", "value": {}, "source": "x"}]': "LS702",
        '[{"frame": "data", "hex": "", "units": 1, "source": "x"}]': "LS702",
        '[{"frame": "data", "hex": "", "points": {"first": {"x": 1}}, "source": "x"}]': "LS702",
        '[{"frame": "data", "hex": "", "points": {"0": {"x": [1]}}, "source": "x"}]': "LS702",
        (
            f'[{{"frame": "data", "hex": "{sound.sensor().example("data").hex()}", "source": " "}}]'
        ): "LS701",
    }.items():
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ViolationError) as found:
            vectors_hold(SensorUnderTest(sound.sensor(), vectors=file))
        assert found.value.code == code, text


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"hex": "16 61 02 75"}, "sends 16 61 01 76, expected 16 61 02 75"),
        ({"reply": "17 71 44 02 20"}, "unexpected reply: ack with code 2 instead of 1"),
        ({"command": "stop"}, "no command 'stop' sends this frame"),
        ({"args": {"speed": 3}}, "unknown"),
    ],
)
def test_vectors_contain_commands_and_replies(
    changes: dict[str, Any], said: str, tmp_path: Path
) -> None:
    vector = {
        "command": "start",
        "hex": "16 61 01 76",
        "reply": "17 71 44 01 23",
        "source": "by hand",
    }
    (file := tmp_path / "vectors.json").write_text(json.dumps([vector | changes]), encoding="utf-8")
    if not said:
        vectors_hold(SensorUnderTest(sound.sensor(), vectors=file))
        return
    with pytest.raises(ViolationError, match=said):
        vectors_hold(SensorUnderTest(sound.sensor(), vectors=file))


def test_scaled_floats_are_read_and_built_in_their_unit() -> None:
    for kind, offset in ((Float16b, 0.0), (Float32l, 0.0), (Float32l, 3.0), (Float64l, 0.0)):
        fields = sound.make_frame(warmth=Scaled(kind, 0.1, "degC", offset=offset))
        subject = SensorUnderTest(
            sound.sensor(sound.frame(fields, max_length=sound.SIZE + kind.sizeof()))
        )
        values_in_units_build_the_same_bytes(subject, "data")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "not JSON: the brackets are nested too deeply"),
        ("[" + "9" * 5000 + "]", "not JSON: "),
        (b"\xff", "not JSON: "),
        (" " * (1 << 22) + "[]", "not JSON: the file is longer than 4096 kB"),
        ('[{"hex": 1}]', "hex: expected a string, got 1"),
        ('[{"frame": ["data"]}]', r"frame: expected a string, got \['data'\]"),
        ('[{"command": {}}]', "command: expected a string, got {}"),
        ('[{"sensor": 3}]', "sensor: expected an id or a list of ids, got 3"),
        ('[{"sensor": [[]]}]', "sensor: expected an id or a list of ids"),
        ('[{"values": [1]}]', "values: expected an object of numbers and strings"),
        ('[{"values": {"a": {}}}]', "values: expected an object of numbers and strings"),
        ('[{"values": {"a": 1e400}}]', "values: expected an object of numbers and strings"),
        (
            '[{"values": {"a": ' + "9" * 400 + "}}]",
            "values: expected an object of numbers and strings",
        ),
        ('[{"units": {"a": "1"}}]', "units: expected an object of numbers"),
        ('[{"units": {"a": NaN}}]', "units: expected an object of numbers"),
        ('[{"points": {"a": {}}}]', "points: expected an object of points"),
        ('[{"points": {"0": [1]}}]', "points: expected an object of points"),
        ('[{"args": 1}]', "args: expected an object of numbers and strings"),
    ],
)
def test_vectors_of_any_shape_are_a_fault_of_their_file(
    text: str | bytes, said: str, tmp_path: Path
) -> None:
    file = tmp_path / "strange.txt"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    (holding,) = [one for one in PROPERTIES if one.function is vectors_hold]
    (found,) = holding.findings(SensorUnderTest(sound.sensor(), vectors=file))
    assert (found.code, found.file) == ("LS702", str(file))
    assert re.search(said, found.what)


def is_certain(f: Fields) -> Any:
    return (f.samples.quality == 7) & (f.samples.distance == 1.0)


def certain_sweep(i: int) -> dict[str, Any]:
    return {
        **count.sweep(i),
        "samples.quality": np.full(count.LONGEST, 7),
        "samples.distance": np.full(count.LONGEST, 1.0),
    }


@pytest.mark.parametrize("number", [1, count.LONGEST])
def test_a_frame_around_a_sweep_has_as_many_elements_as_are_drawn(number: int) -> None:
    data = replace(count.SENSOR.frames["data"], plausible=is_certain)
    sensor = replace(count.SENSOR, frames={"data": data}, simulation=Simulation(certain_sweep))
    frame = sensor.parse(
        random_frame(sensor, "data", random.Random(1), {"count": lambda _: number})
    )
    assert [sample.quality for sample in frame.samples] == [7] * number


def test_angles_of_a_signed_field_are_turned_within_its_limits() -> None:
    # Hundredths of a degree up to 327.67: an angle of 350 degrees is sent as -10 degrees.
    signed = Scaled(Int16sl, 0.01, "deg")

    def signed_sweep(number: int) -> dict[str, float]:
        values = sound.sweep(number)
        return {**values, **{name: (values[name] + 180) % 360 - 180 for name in ("first", "last")}}

    def is_plausible(f: Fields) -> Any:
        return (f.count >= 1) & (f.count <= sound.LONGEST) & (f.time < sound.WRAP)

    sensor = sound.sensor(
        sound.frame(sound.make_frame(first=signed, last=signed), plausible=is_plausible),
        simulation=Simulation(signed_sweep),
    )
    consistency.turned_angles_turn_the_points(SensorUnderTest(sensor), "data")


@pytest.mark.parametrize("field", [Int16ul, Int16sl])
def test_an_angle_of_exactly_one_turn_may_wrap(field: Any) -> None:
    binary = Scaled(field, 360 / 65536, "deg")

    def simulate(first: float) -> SensorUnderTest:
        return SensorUnderTest(
            sound.sensor(
                sound.frame(sound.make_frame(first=binary, last=binary)),
                simulation=Simulation(lambda number: {**sound.sweep(number), "first": first}),
            )
        )

    consistency.sweep_values_fit_their_fields(simulate(359.999), "data")
    with pytest.raises(ViolationError, match="returns 36000 deg, but the field can represent"):
        consistency.sweep_values_fit_their_fields(simulate(36000.0), "data")


def test_an_unknown_field_of_the_scan_rule_is_reported_once() -> None:
    sensor = sound.sensor(scan=OnChange("nope"))
    (report,) = iter_reports(CheckTarget([sensor]), sensor.id, examples=3)
    assert [(finding.code, finding.path) for finding in report.findings] == [("LS216", "scan")]
