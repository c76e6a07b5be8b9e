"""Tests of `sensors`, `show`, `plugins`, `demo` and the help."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

import lidarspec as ls
from lidarspec.cli.options import SHARE
from lidarspec.cli.root import VERBS, main
from lidarspec.plugins import Registry
from lidarspec.simulation.faults import parse_faults
from tests.cli.running import EXAMPLE, ran, run_json
from tests.representatives import REPRESENTATIVES


def test_help_imports_neither_numpy_nor_construct() -> None:
    script = (
        "import sys\nfrom lidarspec.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as done:\n    assert done.code == 0\n"
        "print(sorted({'numpy', 'construct', 'rich', 'pluggy', 'serial'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_verb_says_the_same_of_itself_as_the_list_of_verbs() -> None:
    listed = ran("--help").stdout
    for verb, (_, text) in VERBS.items():
        command = main.get_command(main.make_context("lidarspec", [verb]), verb)
        assert command is not None
        assert (command.help or "").splitlines()[0] == text
        assert verb in listed
        assert text in ran(verb, "--help").stdout.replace("\n ", "")


def test_the_version_is_printed() -> None:
    assert ran("--version").stdout == f"lidarspec {ls.__version__}\n"


def test_sensors_lists_installed_sensors() -> None:
    known = {item["id"]: item for item in run_json("sensors")}
    assert list(known) == list(ls.sensors())
    stl = known["ldrobot-stl27l"]
    assert (stl["vendor"], stl["model"], stl["status"], stl["distribution"]) == (
        "LDROBOT",
        "STL-27L",
        "vectors",
        "lidarspec-ldrobot",
    )
    assert stl["links"] == {"data": {"kind": "serial", "bauds": [921600], "dtr": None, "rts": None}}
    assert any(
        line.split()[0] == "robosense-m1" and "udp 6699/7788" in line
        for line in ran("sensors").stdout.splitlines()
    )


def test_show_draws_the_wire_table_of_every_frame() -> None:
    text = ran("show", "ldrobot-stl27l").stdout
    assert "data (points): 47 bytes" in text
    rows = {" ".join(line.split()) for line in text.splitlines()}
    assert "4 2 uint16 le start_angle 0.01 deg" in rows
    assert "8 + 3*i 1 uint8 points[i].intensity" in rows
    assert "46 1 uint8 crc CRC-8 poly 0x4d over all other bytes" in rows


def test_show_prints_commands_and_their_bytes() -> None:
    found = run_json("show", "cspc-m1c1-mini")
    assert found["commands"]["start"] == {
        "frame": "command",
        "arguments": {},
        "hex": "aa 55 f0 0f",
        "reply": "ack",
        "only_stopped": False,
    }
    assert found["frames"]["data"]["size"] == "10 + 3*lsn"
    assert "command start: aa 55 f0 0f, reply ack" in ran("show", "cspc-m1c1-mini").stdout


def test_show_names_a_command_that_lacks_a_value(tmp_path: Path) -> None:
    file = tmp_path / "acme.py"
    file.write_text(
        """
from construct import Int8ub, Struct
from lidarspec.spec import Command, Frame, Sensor, Serial, hookimpl

@hookimpl
def lidarspec_sensors():
    return [
        Sensor(
            "acme-bus",
            vendor="Acme",
            model="Bus",
            frames={"ask": Frame(Struct("id" / Int8ub, "value" / Int8ub), direction="out")},
            commands={"start": Command("ask", {"id": 1})},
            links={"data": Serial(9600)},
            status="manual",
            source="invented",
        )
    ]
""",
        encoding="utf-8",
    )
    done = ran("show", file)
    assert "ask (to the sensor): 2 bytes" in done.stdout
    assert "commands.start: neither `values` nor `args` gives the field 'value'" in done.stderr
    assert f"next: lidarspec check {file}" in done.stderr


@pytest.mark.parametrize("sensor", REPRESENTATIVES)
def test_show_has_every_frame_and_plan(sensor: str) -> None:
    check_shown_sensor(sensor)


@pytest.mark.slow
def test_show_works_for_every_sensor() -> None:
    for sensor in ls.sensors():
        check_shown_sensor(sensor)


def check_shown_sensor(sensor: str) -> None:
    """Compare the output of `show` with the frames of the sensor."""
    assert set(run_json("show", sensor)["frames"]) == set(ls.sensor(sensor).frames)
    plans = run_json("show", sensor, "--plan")
    assert set(plans) == {name for name, frame in ls.sensor(sensor).frames.items() if frame.data}
    assert all("points per packet" in lines[0] for lines in plans.values()), plans


@pytest.mark.slow
def test_plugins_names_distributions() -> None:
    found = {plugin["distribution"]: plugin for plugin in run_json("plugins")}
    assert found["lidarspec-ldrobot"]["sensors"] == [
        name for name in ls.sensors() if name.startswith("ldrobot-")
    ]


def test_output_goes_to_a_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    target = tmp_path / "sensors.json"
    assert ran("sensors", "--json", "-o", target).stdout == ""
    assert "ldrobot-stl27l" in target.read_text(encoding="utf-8")
    ran("sensors", "-o", tmp_path / "none" / "x.json", code=3)


def test_demo_draws_and_sums_up() -> None:
    text = ran("demo", "-s", "cspc-m1c1-mini", "-n", 1).stdout
    assert sum("⠀" < character <= "⣿" for character in text) > 60
    lines = text.splitlines()
    assert any(line.startswith("cspc-m1c1-mini, simulated on ") for line in lines)
    assert "frames sent, 0.13% of the bytes were damaged, " in text
    assert any(line.startswith("Reply(start, ack: ") for line in lines)
    assert any(re.match(r"\d+ complete scans?( at|,) ", line) for line in lines)
    assert "read again: the same points, SHA-256 " in text
    assert lines[-1] == "next: lidarspec view sim:cspc-m1c1-mini"


@pytest.mark.slow
def test_demo_reads_a_stream_without_a_serial_link_over_tcp() -> None:
    found = run_json("demo", "-s", "quanergy-m8", "-n", 1, "--errors", 0)
    assert found["place"].startswith("tcp://127.0.0.1:")
    assert found["stats"]["bytes_skipped"] == 0


@pytest.mark.parametrize("sensor", ["ldrobot-stl27l", "velodyne-vlp16"])
def test_demo_counts_the_faults_of_the_line(sensor: str) -> None:
    found = run_json("demo", "-s", sensor, "-n", 3, "--errors", 0.005)
    assert found["rate_hz"] == pytest.approx(10, rel=0.1)
    under_way = found["intact"] - sum(found["stats"]["frames"].values())
    assert under_way >= 0
    assert found["intact"] < found["sent"]
    assert found["same_when_replayed"]
    clean = run_json("demo", "-s", sensor, "-n", 1, "--errors", 0)
    assert clean["stats"]["bad_checksum"] == clean["stats"]["bytes_skipped"] == 0
    assert clean["sha256"] != found["sha256"]


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("sensors",), 0),
        (("plugins",), 0),
        (("ports",), 0),
        (("demo",), 2),
        *(((verb, "x.bin"), 4) for verb in ("detect", "read", "view", "stats", "parse", "explain")),
        *(((verb, "ld06"), 2) for verb in ("show", "sim", "check")),
        (("doctor", "x.bin"), 1),
        (("send", "x.bin", "start"), 4),
        (("convert", "x.bin", "x.csv"), 4),
        (("plot", "x.bin", "-o", "x.svg"), 4),
        (("build", "ld06", "data"), 2),
        (("export", "c", "ld06"), 2),
        (("record", "x.bin", "-o", "x.lsr", "-s", "ld06"), 2),
        (("replay", "x.bin", "-s", "ld06"), 2),
    ],
)
def test_without_sensors_every_verb_names_an_installation_command(
    words: tuple[str, ...],
    code: int,
    bare_registry: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "x.bin").write_bytes(EXAMPLE * 3)
    monkeypatch.chdir(tmp_path)
    done = ran(*words, code=code)
    assert (done.stdout + done.stderr).count("pip install ") == 1


def test_a_file_needs_no_installed_sensor(bare_registry: Registry) -> None:
    stranger = Path(__file__).parents[1] / "shapes" / "stranger" / "acme_lidars.py"
    done = ran("parse", "00 00", "-s", stranger, code=4)
    assert "pip install" not in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo terminals")
def test_on_a_terminal_of_80_columns_ids_and_fields_stay_whole() -> None:
    from tests.view.terminal import Terminal

    shown = {}
    for words in (("sensors",), ("show", "cspc-m1c1-mini")):
        with Terminal(*words, columns=80, lines=80) as window:
            assert window.wait_until_end() == 0
            shown[words[0]] = window.raw.replace("\r", "").splitlines()
    assert set(ls.sensors()) <= {line.partition(" ")[0] for line in shown["sensors"]}
    assert all(
        len(line) <= 80 for lines in shown.values() for line in lines if not line.startswith("  ")
    )
    place = next(place for place, line in enumerate(shown["show"]) if "samples[i].distance" in line)
    assert shown["show"][place].split("  ")[0] == "10 + 3*i"
    assert "      0: no return" in shown["show"][place + 1 : place + 3]


def test_the_limits_of_a_command_are_printed_with_every_digit() -> None:
    assert "|mode_name|0..4294967295, reply" in ran("show", "slamtec-rplidar-a1").stdout


@pytest.mark.parametrize(
    "words", [("explain", EXAMPLE.hex()), ("view", "x.bin", "--color", "range")]
)
def test_colours_can_be_forced_in_a_pipe(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.bin").write_bytes(b"".join(ls.simulate(ls.sensor("ldrobot-stl27l"), 400)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[" not in ran(*words).stdout
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "\x1b[" in ran(*words).stdout


def test_a_share_is_written_in_per_cent_or_as_a_number_everywhere() -> None:
    for text in ("1%", "0.01"):
        assert (
            SHARE.convert(text, None, None)
            == parse_faults({"errors": text, "loss": text}).errors
            == 0.01
        )
    assert "[default: 1%]" in ran("demo", "--help").stdout
    assert "errors" in ran("stats", "sim:ldrobot-stl27l?errors=200%", code=2).stderr


def test_one_option_has_one_meaning_in_every_verb() -> None:
    options: dict[str, set[str | None]] = {}
    for verb in VERBS:
        command = main.get_command(main.make_context("lidarspec", [verb]), verb)
        assert command is not None
        for option in command.params:
            if isinstance(option, click.Option):
                for name in option.opts:
                    options.setdefault(name, set()).add(max(option.opts, key=len))
    assert {name: names for name, names in options.items() if len(names) > 1} == {}
