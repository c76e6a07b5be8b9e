"""Tests of verbs with a device without points: they work or suggest another command."""

from __future__ import annotations

import gzip
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.recording.recorders import Recorder
from lidarspec.transports.protocol import Chunk
from tests.cli.running import ran
from tests.libraries import Library, needs
from tests.shapes import SHAPES
from tests.shapes.receiver import SENSOR

parquet = Library("pyarrow.parquet")
mcap = Library("mcap.reader")

RECEIVER = Path(__file__).parents[1] / "shapes" / "receiver.py"
START_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000
FRAMES = simulate(SENSOR, 60)  # five `fix` to one `warmth`
FIX_COUNT = 50


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of five seconds, with one frame per record."""
    path = tmp_path_factory.mktemp("receiver") / "receiver.lsr"
    with Recorder(path, SENSOR, "made") as recorder:
        for number, frame in enumerate(FRAMES):
            recorder.write(Chunk(frame, START_NS + number * STEP_NS))
    return path


def test_decoding_needs_the_name_of_a_frame_type() -> None:
    data = b"".join(FRAMES)
    there_are = r"its frame types \(fix, warmth, rate_reply\), as in frame='fix'"
    for read in (SENSOR.decode, SENSOR.scans):
        with pytest.raises(ls.UsageError, match=there_are):
            read(data)
    packets = SENSOR.decode(data, frame="fix")
    assert packets["latitude"].tolist() == pytest.approx([47 + i * 1e-5 for i in range(FIX_COUNT)])
    assert packets.time_ns.tolist() == [i * STEP_NS for i in range(FIX_COUNT)]
    assert SENSOR.decode(data, frame="warmth")["temperature"][:2].tolist() == [20, 21]


def test_losses_are_counted() -> None:
    packets = SENSOR.decode(b"".join([*FRAMES[:10], *FRAMES[20:]]), frame="fix")
    assert packets.stats.lost == FIX_COUNT - len(packets) > 0


def test_only_sensors_without_points_may_lack_a_scan_and_limits() -> None:
    for name in ("scan", "range_limits", "points"):
        with pytest.raises(ls.SpecError, match=name):
            replace(SHAPES["shape-count"], **{name: None})


def test_a_device_yields_the_packets_of_several_types(recording: Path) -> None:
    counts = {"fix": 0, "warmth": 0}
    with ls.open(recording, SENSOR) as device:
        for batch in device.packets_by_frame(["fix", "warmth"]):
            for name, packets in batch.items():
                counts[name] += len(packets)
    assert counts == {"fix": FIX_COUNT, "warmth": 10}
    with ls.open(recording, SENSOR) as device:
        with pytest.raises(ls.UsageError, match="its frame types \\(fix"):
            next(device.packets())
        with pytest.raises(ls.UsageError, match="its frame types \\(fix"):
            device.latest(0)


@pytest.mark.parametrize("verb", ["view", "plot", "read"])
def test_verbs_that_need_points_suggest_another(verb: str, recording: Path, tmp_path: Path) -> None:
    more = ["-o", tmp_path / "plot.svg"] if verb == "plot" else []
    error = ran(verb, recording, "-s", RECEIVER, *more, code=2).stderr
    assert "measures no points; it sends the frames fix, warmth, rate_reply" in error
    assert f"next: lidarspec read {recording} -s shape-receiver -f fix" in error


def test_demo_suggests_the_statistics() -> None:
    assert "next: lidarspec stats sim:" in ran("demo", "-s", RECEIVER, code=2).stderr


def test_the_suggested_verb_prints_the_fields(recording: Path) -> None:
    lines = ran("read", recording, "-s", RECEIVER, "-f", "fix", "-n", "2", "--json").stdout
    rows = [json.loads(line) for line in lines.splitlines()]
    assert [row["latitude"] for row in rows] == [47, 47.00001]


def test_stats_count_all_frames(recording: Path) -> None:
    lines = ran("stats", recording, "-s", RECEIVER, "--json").stdout.splitlines()
    summary = json.loads(lines[-1])
    assert (summary["packets"], summary["stats"]["frames"]["warmth"]) == (60, 10)
    assert summary["packet_rate_hz"] == pytest.approx(10)
    assert len(lines) > 1
    text = ran("stats", f"sim:{RECEIVER}?rate=20", "-t", "500ms").stdout
    assert re.search(r"frames in [\d.]+ s", text)


def test_check_is_clean() -> None:
    assert "clean" in ran("check", RECEIVER).stdout


def test_a_simulation_follows_its_commands(tmp_path: Path) -> None:
    path = tmp_path / "simulated.lsr"
    assert "next: lidarspec stats" in ran("sim", RECEIVER, "-t", "2s", "--to", path).stderr
    assert "rate   7 Hz" in ran("send", f"sim:{RECEIVER}", "rate", "rate=7").stdout
    target = tmp_path / "recorded.lsr"
    summary = ran("record", f"sim:{RECEIVER}?rate=max", "-n", "20", "-o", target).stderr
    assert "packets" in summary
    assert "decoding failed" not in summary


@pytest.mark.parametrize("form", ["wireshark", "c", "ksy", "md", "svg", "json", "pyi"])
def test_exports(form: str) -> None:
    text = ran("export", form, RECEIVER).stdout
    assert "latitude" in text
    if form == "json":
        assert json.loads(text)["scan"] is None


def test_show_has_no_range() -> None:
    assert "range " not in ran("show", RECEIVER).stdout.partition("fix:")[0]


def convert(recording: Path, target: Path, *words: str) -> None:
    ran("convert", recording, target, "-s", RECEIVER, *words)


def test_fields_become_csv(recording: Path, tmp_path: Path) -> None:
    convert(recording, tmp_path / "fix.csv", "-f", "fix", "-n", "3")
    expected = [
        "time_ns,number,time,latitude,longitude,quality,sum",
        "0,0,0,47,8.5,3,93",
        "100000000,1,0.1,47.00001,8.5,3,195",
        "200000000,2,0.2,47.00002,8.5,3,42",
    ]
    assert (tmp_path / "fix.csv").read_text().splitlines() == expected
    convert(recording, tmp_path / "fix.csv.gz", "-f", "fix", "-n", "3")
    with gzip.open(tmp_path / "fix.csv.gz", "rt") as file:
        assert file.read().splitlines() == expected


def test_a_table_holds_one_type(recording: Path, tmp_path: Path) -> None:
    target = tmp_path / "all.csv"
    error = ran("convert", recording, target, "-s", RECEIVER, code=2).stderr
    assert "choose one of fix, warmth, rate_reply" in error
    assert "next: repeat with -f fix" in error
    assert not target.exists()


@pytest.mark.slow
@needs("pyarrow")
def test_fields_become_parquet(recording: Path, tmp_path: Path) -> None:
    convert(recording, tmp_path / "fix.parquet", "-f", "fix")
    table = parquet.read_table(tmp_path / "fix.parquet")
    packets = SENSOR.decode(b"".join(FRAMES), frame="fix")
    assert table["time_ns"].to_pylist() == packets.time_ns.tolist()
    for name in ("number", "latitude", "quality"):
        np.testing.assert_array_equal(table[name].to_numpy(), packets[name])


LOGGER = """
from construct import Const, CString, If, Int8ub, PaddedString, Struct, VarInt, this
from lidarspec.spec import Frame, Sensor, Serial, Simulation, hookimpl

REPORT = Struct(
    "head" / Const(b"\\xc5\\x02\\x03"),
    "unit" / PaddedString(6, "ascii"),
    "note" / CString("ascii"),
    "number" / VarInt,
    "alarms" / Int8ub,
    "alarm" / If(this.alarms, CString("ascii")),
)


def sweep(i):
    report = {"unit": "A1", "note": "x" * (i % 5), "number": 100 * i}
    return report | {"alarms": int(i == 2), "alarm": "hot" if i == 2 else None}


LOGGER = Sensor(
    "acme-logger",
    vendor="Acme",
    model="Logger",
    frames={"report": Frame(REPORT, max_length=60, simulation=Simulation(sweep, rate=10))},
    links={"data": Serial(9600)},
    status="manual",
    source="invented for the tests",
)


@hookimpl
def lidarspec_sensors():
    return [LOGGER]
"""


def test_texts_are_values_in_every_verb(tmp_path: Path) -> None:
    plugin, data, table = (tmp_path / name for name in ("logger.py", "made.bin", "made.csv"))
    plugin.write_text(LOGGER, encoding="utf-8")
    ran("sim", plugin, "--to", data, "-t", "0.25s")
    ran("convert", data, table, "-s", plugin, "-f", "report")
    assert table.read_text(encoding="utf-8").splitlines() == [
        "time_ns,unit,note,number,alarms,alarm",
        "0,A1,,0,0,",
        "0,A1,x,100,0,",
        "0,A1,xx,200,1,hot",
    ]
    lines = ran("read", data, "-s", plugin, "-f", "report", "--json").stdout.splitlines()
    assert [json.loads(line)["note"] for line in lines] == ["", "x", "xx"]
    assert [json.loads(line)["alarm"] for line in lines] == [None, None, "hot"]
    *_, second, third = ran("read", data, "-s", plugin, "-f", "report").stdout.splitlines()
    assert second.split()[-1] == "-"
    assert " xx " in third
    explained = ran("explain", data.read_bytes()[-19:].hex(), "-s", plugin).stdout
    assert "note    'xx'" in explained
    assert "number  200" in explained
    assert "acme-logger: clean" in ran("check", plugin, "--max-examples", "5").stdout


def test_texts_that_are_not_ascii_become_csv(tmp_path: Path) -> None:
    plugin, data, table = (tmp_path / name for name in ("logger.py", "made.bin", "made.csv"))
    source = LOGGER.replace('CString("ascii")', 'CString("utf8")').replace('"x"', '"\u00eb"')
    plugin.write_text(source, encoding="utf-8")
    ran("sim", plugin, "--to", data, "-t", "0.25s")
    ran("convert", data, table, "-s", plugin, "-f", "report")
    assert "0,A1,\u00eb,100,0," in table.read_text(encoding="utf-8").splitlines()


TAGS = RECEIVER.with_name("tags.py")
TAGS_BYTES = 8  # in each frame of `tags_file`


@pytest.fixture(scope="module")
def tags_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file of two frames with parts of several kinds."""
    path = tmp_path_factory.mktemp("tags") / "tags.bin"
    heat = [dict(type=2, temperature=200 + number) for number in range(3)]
    frames = [heat[:2], [dict(type=9, content=b"ab"), heat[2]]]
    sensor = SHAPES["shape-tags"]
    path.write_bytes(
        b"".join(
            sensor.build("data", number=number, tags=parts, padding=bytes(-(7 + TAGS_BYTES) % 8))
            for number, parts in enumerate(frames)
        )
    )
    return path


def test_parts_of_one_kind_become_csv(tags_file: Path, tmp_path: Path) -> None:
    target = tmp_path / "heat.csv"
    ran("convert", tags_file, target, "-s", TAGS, "-f", "data.tags.temperature")
    header, *rows = target.read_text().splitlines()
    assert header.split(",")[-1] == "temperature"
    assert [row.split(",")[-1] for row in rows] == ["20", "20.1", "20.2"]
    result = ran("convert", tags_file, tmp_path / "frames.csv", "-s", TAGS, "-f", "data")
    assert "no columns for the parts of data" in result.stderr
    assert "-f data.tags.temperature" in result.stderr
    for name in ("data.tags.heat", "data."):
        unknown = ran("convert", tags_file, tmp_path / "no.csv", "-s", TAGS, "-f", name, code=2)
        assert f"unknown field '{name}'" in unknown.stderr


def test_missing_frames_and_parts_are_named(
    recording: Path, tags_file: Path, tmp_path: Path
) -> None:
    target = tmp_path / "no.csv"
    words = ("convert", recording, target, "-s", RECEIVER, "-f", "rate_reply")
    missing_frame = ran(*words, code=4).stderr
    assert "has no rate_reply; it has fix, warmth" in missing_frame
    frames = tmp_path / "tags.bin"
    frames.write_bytes(SHAPES["shape-tags"].build("data", number=0, tags=[], padding=b"\0"))
    words = ("convert", frames, target, "-s", TAGS, "-f", "data.tags.temperature")
    assert "has no data.tags.temperature; it has data" in ran(*words, code=4).stderr
    packets = tmp_path / "packets.lsr"
    sensor = ls.sensor("livox-mid360")
    with ls.Recorder(packets, sensor) as recorder:
        recorder.write(Chunk(sensor.example("data"), 1))
    words = ("convert", packets, target, "-s", sensor.id, "--imu")
    assert "has no IMU samples; it has data" in ran(*words, code=4).stderr


def test_a_remark_lists_only_some_of_the_parts(
    tags_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lidarspec.cli.convert.MAX_LISTED_PARTS", 1)
    result = ran("convert", tags_file, tmp_path / "frames.csv", "-s", TAGS, "-f", "data")
    (remark,) = [line for line in result.stderr.splitlines() if "has no columns" in line]
    assert remark.count("-f data.") == 1
    assert "lidarspec show shape-tags lists 3 kinds of parts" in remark


@pytest.mark.slow
@needs("mcap")
def test_fields_of_all_types_become_mcap(recording: Path, tmp_path: Path) -> None:
    convert(recording, tmp_path / "all.mcap")
    with (tmp_path / "all.mcap").open("rb") as file:
        messages = list(mcap.make_reader(file).iter_messages())
    assert [message.log_time for _, _, message in messages] == [
        START_NS + number * STEP_NS for number in range(60)
    ]
    assert {channel.topic for _, channel, _ in messages} == {"/fix", "/warmth"}
    schema, channel, message = messages[1]
    assert (schema.name, channel.message_encoding) == ("shape-receiver.warmth", "json")
    assert json.loads(message.data)["temperature"] == 20


def test_a_part_is_converted(recording: Path, tmp_path: Path) -> None:
    convert(recording, tmp_path / "part.csv", "-f", "fix", "--slice", "1s:2s")
    rows = (tmp_path / "part.csv").read_text().splitlines()[1:]
    assert [row.split(",")[1] for row in rows] == [str(i) for i in range(10, 20)]


def test_fields_of_a_sensor_with_points_are_converted(tmp_path: Path) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    path = tmp_path / "lidar.bin"
    path.write_bytes(b"".join(simulate(sensor, 3)))
    ran("convert", path, tmp_path / "lidar.csv", "-s", sensor.id, "-f", "data")
    header, *rows = (tmp_path / "lidar.csv").read_text().splitlines()
    assert header.startswith("time_ns,speed,start_angle,points.distance[0],points.distance[1]")
    assert len(rows) == 3
