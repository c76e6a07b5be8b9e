"""Tests of `parse`, `explain` and `build`."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.cli.frames import to_json_values
from tests.cli.running import COIN_D4, EXAMPLE, LD06, ran, run_json
from tests.engine.streams import MEGABYTE, peak
from tests.evidence import capture
from tests.shapes import SHAPES

SENSOR = ("-s", "ldrobot-stl27l")
FIELDS = ("speed=2152", "start_angle=324.27deg", "end_angle=334.7deg", "timestamp=6714ms")
POINTS = [
    (224, 228),
    (220, 226),
    (217, 229),
    (213, 227),
    (211, 228),
    (208, 233),
    (205, 228),
    (202, 226),
    (199, 233),
    (197, 229),
    (194, 229),
    (192, 229),
]


def test_a_frame_is_parsed_from_text_in_any_spelling() -> None:
    plain = ran("parse", EXAMPLE.hex(), *SENSOR).stdout
    assert [line.split() for line in plain.splitlines()[:6]] == [
        ["ldrobot-stl27l", "data,", "47", "bytes"],
        ["field", "raw", "value"],
        ["header", "54", "2c"],
        ["speed", "2152", "2152", "deg/s", "=", "6.0", "Hz"],
        ["start_angle", "32427", "324.27", "deg"],
        ["points[0].distance", "224", "0.224", "m"],
    ]
    words = EXAMPLE.hex(" ").split()
    assert ran("parse", *words, *SENSOR).stdout == plain
    assert ran("parse", ", ".join(f"0x{word}" for word in words), *SENSOR).stdout == plain


def test_a_frame_is_parsed_from_a_file_and_from_standard_input(tmp_path: Path) -> None:
    raw, text = tmp_path / "f.bin", tmp_path / "f.hex"
    raw.write_bytes(EXAMPLE)
    text.write_text(EXAMPLE.hex(" "), encoding="ascii")
    plain = ran("parse", EXAMPLE.hex(), *SENSOR).stdout
    assert ran("parse", raw, *SENSOR).stdout == ran("parse", text, *SENSOR).stdout == plain
    assert ran("parse", "-", *SENSOR, given=EXAMPLE).stdout == plain
    assert ran("parse", "-", *SENSOR, given=text.read_bytes()).stdout == plain


def test_json_holds_the_integers_of_the_wire() -> None:
    found = run_json("parse", EXAMPLE.hex(), *SENSOR)
    (frame,) = found["frames"]
    assert (found["sensor"], frame["frame"], frame["offset"], frame["size"]) == (
        "ldrobot-stl27l",
        "data",
        0,
        47,
    )
    assert frame["fields"]["start_angle"] == 32427
    assert [
        (point["distance"], point["intensity"]) for point in frame["fields"]["points"]
    ] == POINTS
    assert frame["fields"]["header"] == "54 2c"


def test_the_sensors_that_fit_are_found_and_listed() -> None:
    result = ran("parse", EXAMPLE.hex())
    assert "ldrobot-ld06" in result.stderr
    assert "ldrobot-stl27l" in result.stderr
    assert run_json("parse", EXAMPLE.hex())["fits"] == [
        *(name for name in ls.sensors() if name.startswith("ldrobot-")),
        "oradar-ms200",
    ]
    assert (
        run_json("parse", ls.sensor("robosense-m1").example("data").hex())["sensor"]
        == "robosense-m1"
    )


def test_a_stream_is_parsed_and_gaps_are_counted() -> None:
    data = b"\x00\x54" + EXAMPLE + b"\x54\x2c" + EXAMPLE
    result = ran("parse", data.hex(), *SENSOR)
    assert "4 bytes are outside frames" in result.stderr
    assert [frame["offset"] for frame in run_json("parse", data.hex(), *SENSOR)["frames"]] == [
        2,
        51,
    ]
    assert len(run_json("parse", data.hex(), "-n", 1, *SENSOR)["frames"]) == 1


def test_explain_names_every_byte_of_a_stream() -> None:
    data = b"\x00\x54" + EXAMPLE + b"\x54\x2c" + EXAMPLE + b"\xff"
    frames = run_json("explain", data.hex(), *SENSOR)["frames"]
    named = b"".join(bytes.fromhex(row["hex"]) for frame in frames for row in frame["rows"])
    assert named == data
    assert [(frame["frame"], frame["offset"]) for frame in frames] == [
        ("", 0),
        ("data", 2),
        ("", 49),
        ("data", 51),
        ("", 98),
    ]


def test_explain_prints_as_the_conventions_say() -> None:
    text = ran("explain", EXAMPLE.hex(), *SENSOR).stdout
    assert text.splitlines()[:5] == [
        "ldrobot-stl27l data, 47 bytes",
        "0000  54 2c     header       start byte 0x54; type 1 and 12 points",
        "0002  68 08     speed        2152 deg/s = 6.0 Hz",
        "0004  ab 7e     start_angle  324.27 deg",
        "0006  e0 00 e4  points[0]    0.224 m, intensity 228, at 35.73 deg -> x 0.182 y 0.131",
    ]
    assert (
        text.splitlines()[-1]
        == "002e  50        crc          0x50 ok (CRC-8 poly 0x4d over 46 bytes)"
    )


def test_explain_takes_the_frame_type_where_bytes_do_not_tell() -> None:
    damaged = b"\x00" + EXAMPLE[1:]
    ran("explain", damaged.hex(), *SENSOR, code=4)
    result = ran("explain", damaged.hex(), "--frame", "data", *SENSOR, code=4)
    assert "wrong: 00 2c, expected 54 2c" in result.stdout
    ran("explain", damaged.hex(), "--frame", "dat", *SENSOR, code=2)


def test_explain_can_show_damaged_frames_only(tmp_path: Path) -> None:
    frames = ls.simulate(ls.sensor("ldrobot-stl27l"), 30)
    frames[20] = frames[20][:30] + frames[20][31:]
    (tmp_path / "drive.bin").write_bytes(b"".join(frames))
    result = ran("explain", tmp_path / "drive.bin", "--bad", *SENSOR, code=1)
    assert [line for line in result.stdout.splitlines() if not line.startswith("00")] == [
        (
            "ldrobot-stl27l data at byte 940, 46 bytes: the frame ends at byte 46 of 47: crc"
            " requires 1 byte, but has 0"
        ),
        *(
            line
            for line in result.stdout.splitlines()
            if line.startswith(
                ("note: one lost byte explains", "note: a single lost byte explains")
            )
        ),
    ]
    assert result.stderr == "29 frames, 1 damaged, 0 bytes outside frames\n"
    filled = b"\xff\xfe".join(ls.simulate(ls.sensor("cspc-m1c1-mini"), 9))  # fillers are no damage
    assert (
        "9 frames, 0 damaged, 0 bytes outside frames"
        in ran("explain", filled.hex(), "--bad", "-s", "cspc-m1c1-mini").stderr
    )
    alone = ran("explain", frames[20].hex(), "--bad", *SENSOR, code=1)
    assert alone.stderr == "0 frames, 1 damaged, 0 bytes outside frames\n"
    clean = ran("explain", frames[0].hex(), "--bad", *SENSOR)
    assert (clean.stdout, clean.stderr) == ("", "1 frame, 0 damaged, 0 bytes outside frames\n")


def test_explain_can_show_some_bytes_only(tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    path.write_bytes(b"".join(ls.simulate(ls.sensor("ldrobot-stl27l"), 300)))
    assert ran("explain", path, "--at", "0x3b2", *SENSOR).stdout.startswith(
        "ldrobot-stl27l data at byte 940, 47 bytes; byte 946 is in points[0].distance\n"
    )
    assert [
        frame["offset"]
        for frame in run_json("explain", path, "--bytes", "46:95", *SENSOR)["frames"]
    ] == [0, 47, 94]
    assert len(run_json("explain", path, "--bytes", "14000:", *SENSOR)["frames"]) == 3
    assert (
        "14100 bytes; byte 14100 does not exist"
        in ran("explain", path, "--at", 14100, *SENSOR, code=2).stderr
    )
    for words in (
        ("--bytes", "9"),
        ("--bytes", "9:8"),
        ("--bytes", "a:"),
        ("--at", "-1"),
        ("--at", 1, "--bytes", "1:2"),
    ):
        ran("explain", path, *words, *SENSOR, code=2)


def test_explain_takes_one_frame_type_out_of_a_stream() -> None:
    sensor = ls.sensor("cspc-coin-d4")
    data = b"".join(
        sensor.example(name, seed=seed) for seed in range(6) for name in ("info", "data")
    )
    result = ran("explain", data.hex(), "-f", "info", "-s", sensor.id)
    assert result.stdout.count("cspc-coin-d4 info") == 6
    assert "cspc-coin-d4 data" not in result.stdout
    assert (
        result.stderr
        == "6 frames, 0 damaged, 0 bytes outside frames, 6 frames of other types omitted\n"
    )
    said = ran("explain", (EXAMPLE * 20).hex(), "-f", "scan_start", "-s", sensor.id, code=4).stderr
    assert "no scan_start frame in" in said


@pytest.mark.slow
def test_explain_prints_while_input_arrives_and_stops_with_its_reader() -> None:
    command = [sys.executable, "-m", "lidarspec", "explain", "-", *SENSOR]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as running:
        assert running.stdin is not None
        assert running.stdout is not None
        running.stdin.write(EXAMPLE * 3000)
        running.stdin.flush()
        patience = threading.Timer(60, running.kill)
        patience.start()
        assert running.stdout.readline() == b"ldrobot-stl27l data, 47 bytes\n"
        running.stdout.close()
        assert running.wait() == 0
        patience.cancel()


def test_captures_are_explained() -> None:
    frames = run_json("explain", capture(COIN_D4), "-s", "cspc-coin-d4")["frames"]
    assert (
        b"".join(bytes.fromhex(row["hex"]) for frame in frames for row in frame["rows"])
        == capture(COIN_D4).read_bytes()
    )
    assert [frame["frame"] for frame in frames] == [
        "",
        "info",
        "scan_start",
        "data",
        "data",
        "data",
        "data",
        "data",
    ]
    assert [frame["fault"] is None for frame in frames[1:]] == [True] * 6 + [False]
    assert "3 data" not in ran("parse", capture(LD06), *SENSOR).stderr


def test_build_makes_the_frame_of_the_manual() -> None:
    points = [
        f"points[{index}].{name}={value}"
        for index, pair in enumerate(POINTS)
        for name, value in zip(("distance", "intensity"), pair, strict=True)
    ]
    assert ran("build", "ldrobot-stl27l", "data", *FIELDS, *points).stdout.strip() == EXAMPLE.hex(
        " "
    )


def test_build_fills_arrays_and_later_values_win() -> None:
    words = (
        "points[3].intensity=7",
        "points[*].distance=1m",
        "points[*].intensity=0x05",
        "points[11].distance=12.5cm",
    )
    frame = ls.sensor("ldrobot-stl27l").parse(
        bytes.fromhex(ran("build", "ldrobot-stl27l", "data", *FIELDS, *words).stdout)
    )
    assert [point.distance for point in frame.points] == [1000] * 11 + [125]
    assert {point.intensity for point in frame.points} == {5}
    words = (*words, "points[3].intensity=7")
    frame = ls.sensor("ldrobot-stl27l").parse(
        bytes.fromhex(ran("build", "ldrobot-stl27l", "data", *FIELDS, *words).stdout)
    )
    assert frame.points[3].intensity == 7


def test_build_takes_the_unit_of_every_field() -> None:
    words = ("distance=3m", "strength=500", "temperature=25.5degC")
    built = ran("build", "benewake-tfmini", "data", *words).stdout
    frame = ls.sensor("benewake-tfmini").parse(bytes.fromhex(built))
    assert frame.temperature == (25.5 + 256) * 8
    refused = ran("build", "benewake-tfmini", "data", "temperature=25.5", code=2).stderr
    assert "give it a unit: 25.5degC" in refused


def test_build_takes_the_length_of_an_array_from_its_count_or_its_elements() -> None:
    common = ("mt.m=55", "mt.start=0", "fsa.angle=10deg", "lsa.angle=12deg")
    every = ("samples[*].distance=1m", "samples[*].intensity=3", "samples[*].exposure=1")
    sensor = ls.sensor("cspc-coin-d4")
    frame = sensor.parse(
        bytes.fromhex(ran("build", sensor.id, "data", *common, *every, "lsn=3").stdout)
    )
    assert (frame.lsn, [sample.distance for sample in frame.samples]) == (3, [1000] * 3)
    ones = [
        f"samples[{index}].{field}"
        for index in range(2)
        for field in ("distance=5", "intensity=6", "exposure=1")
    ]
    frame = sensor.parse(bytes.fromhex(ran("build", sensor.id, "data", *common, *ones).stdout))
    assert (frame.lsn, [sample.intensity for sample in frame.samples]) == (2, [6, 6])
    assert "is unknown" in ran("build", sensor.id, "data", *common, *every, code=2).stderr


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("speed=10m", "speed: the unit 'm' cannot be converted; expected deg/s"),
        ("start_angle=700deg", "start_angle = 700.0 is outside 0.0 .. 655.35 deg"),
        ("speed=70000", "speed = 70000 is outside 0 .. 65535"),
        ("speed=1.5", "give it a unit: 1.5deg/s"),
        ("speed=fast", "expected a number, got 'fast'"),
        ("points.distance=1m", "points.distance is inside 1 array"),
        ("points[*].range=1m", "unknown field 'points[*].range'"),
        ("header=5g", "expected bytes in hexadecimal"),
    ],
)
def test_a_value_outside_the_range_of_a_field(word: str, told: str) -> None:
    words = ("points[*].distance=1m", "points[*].intensity=5")
    assert told in ran("build", "ldrobot-stl27l", "data", *FIELDS, *words, word, code=2).stderr


def test_built_frames_go_to_files_and_back(tmp_path: Path) -> None:
    raw, text = tmp_path / "start.bin", tmp_path / "start.hex"
    for target in (raw, text):
        ran("build", "cspc-m1c1-mini", "command", "mode=0xf0", "-o", target)
    assert (
        raw.read_bytes() == bytes.fromhex(text.read_text(encoding="ascii")) == b"\xaa\x55\xf0\x0f"
    )
    assert (
        ran("build", "cspc-m1c1-mini", "command", "mode=0xf0", "-o", "-").stdout_bytes
        == raw.read_bytes()
    )
    assert run_json("build", "cspc-m1c1-mini", "command", "mode=240")["hex"] == "aa 55 f0 0f"
    assert "0x0f ok (XOR-8 over 3 bytes)" in ran("explain", raw, "-s", "cspc-m1c1-mini").stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("parse", "zeros.bin", *SENSOR), 4),
        (("parse", "zeros.hex", *SENSOR), 4),
        (("parse", "-", *SENSOR), 4),
        (("explain", "few.bin", *SENSOR, "-o", "text"), 4),
        (("detect", "zeros.bin"), 4),
        (("doctor", "zeros.bin", *SENSOR), 1),
        (("convert", "zeros.hex", "points.csv", *SENSOR), 4),
        (("crc", "zeros.hex"), 2),
    ],
)
def test_an_input_is_held_in_pieces(
    words: tuple[str, ...], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only one piece of a file, of a long line of text, or of a pipe is in memory."""
    monkeypatch.chdir(tmp_path)
    for data in (bytes(2000), bytes(MEGABYTE)):  # first what is imported and remembered
        text = data.hex().encode()
        for name, given in (
            ("zeros.bin", data),
            ("zeros.hex", text),
            ("few.bin", data[: MEGABYTE // 4]),
        ):
            Path(name).write_bytes(given)
        most = peak(lambda given=text if "-" in words else b"": ran(*words, code=code, given=given))
    # the whole at once would be 75 MB: a piece is looked through for every kind of frame of a
    # sensor, and some have a dozen
    assert most - len(text) * ("-" in words) < 32 * MEGABYTE, f"{most} bytes"


def test_parts_are_built_shown_and_explained(tmp_path: Path) -> None:
    file, fields = (
        tmp_path / "tags.py",
        ["tags[0].type=1", "tags[0].points[0].distance=1m", "tags[0].points[0].angle=90deg"],
    )
    file.write_text(
        "from lidarspec.spec import hookimpl\nfrom tests.shapes.tags import SENSOR\n\n\n"
        "@hookimpl\ndef lidarspec_sensors():\n    return [SENSOR]\n",
        encoding="utf-8",
    )
    data = ran("build", file, "data", "number=3", *fields, "padding=000000").stdout.strip()
    assert data == "02 01 04 03 03 01 01 04 64 00 28 23 00 00 00 c2"
    explained = ran("explain", data, "-s", file).stdout
    assert "points[0]  1.00 m, 90.00 deg, at 90.00 deg -> x 0.000 y 1.000" in explained
    assert "tags[i].points[j].angle" in ran("show", file).stdout
    assert (
        "unknown field 'tags[0].tipe'"
        in ran("build", file, "data", "tags[0].tipe=1", code=2).stderr
    )


def test_json_has_the_fields_of_a_frame_and_not_how_they_were_spelled() -> None:
    sensor = SHAPES["shape-tokens"]
    spelled = sensor.parse(sensor.example("data").replace(b"scandata ", b"scandata 0"))
    assert list(to_json_values(spelled)) == [name for name in spelled if name != "_wire"]
    assert len(spelled) == len(to_json_values(spelled)) + 1
