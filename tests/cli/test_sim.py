"""Tests of `sim`: its address, the suggested commands, and its exit."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.cli.options import DURATION
from lidarspec.simulation.clock_faults import parse_clock_faults
from lidarspec.simulation.faults import parse_faults
from lidarspec.spec.fields import parse_duration
from lidarspec.transports.addresses import SourceAddress
from lidarspec.transports.simulated import connect
from tests.cli.running import process, ran
from tests.lines import TIMEOUT_S

posix = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")
STL = "ldrobot-stl27l"


def start_simulator(*words: object) -> tuple[subprocess.Popen[str], str]:
    """Start ``lidarspec sim`` in a process; return it and its first line of output."""
    command = [sys.executable, "-m", "lidarspec", "sim", *map(str, words)]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert running.stdout is not None
    return running, running.stdout.readline().strip()


@posix
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_it_is_read_by_another_program_and_ends_cleanly(
    number: signal.Signals, tmp_path: Path
) -> None:
    link = tmp_path / "ttyLIDAR"
    running, where = start_simulator("cspc-m1c1-mini", "--link", link, "--rate", "3")
    assert running.stderr is not None
    try:
        assert where == str(link)
        with ls.open(where, "cspc-m1c1-mini") as device:
            assert device.latest(TIMEOUT_S).complete
        begin = "".join(itertools.islice(running.stderr, 4))  # until the command `stop`
    finally:
        running.send_signal(number)
        _, rest = running.communicate(timeout=TIMEOUT_S)
    said = begin + rest
    assert running.returncode == 130
    assert not link.is_symlink()
    assert "Traceback" not in said
    lines = said.splitlines()
    assert lines[0] == "cspc-m1c1-mini, simulated"
    assert lines[1] == f"  next: lidarspec view {link} -s cspc-m1c1-mini"
    assert [line.split()[-1] for line in lines[2:4]] == ["start", "stop"]
    assert "1 info, 1 scan_start" in lines[4]
    assert lines[-1] == "interrupted"


@posix
def test_a_port_is_the_default_of_a_serial_sensor_and_datagrams_of_the_others() -> None:
    assert ran("sim", STL, "-t", "100ms").stdout.startswith("/dev/")
    result = ran("sim", "velodyne-vlp16", "-t", "100ms")
    assert result.stdout == "udp://127.0.0.1?port=2368,8308\n"
    assert (
        "next: lidarspec view 'udp://127.0.0.1?port=2368,8308' -s velodyne-vlp16" in result.stderr
    )
    assert " data" in result.stderr


def test_a_sensor_is_simulated_as_it_is_configured(tmp_path: Path) -> None:
    path = tmp_path / "two echoes.bin"
    said = ran(
        "sim", "hokuyo-utm30lxew", "-O", "content=echoes", "--to", path, "-t", "200ms"
    ).stderr
    assert f"next: lidarspec view '{path}' -s hokuyo-utm30lxew -O content=echoes" in said
    read = ran("read", path, "-s", "hokuyo-utm30lxew", "-O", "content=echoes", "-n", 3).stdout
    assert "return_index" in read


def test_the_place_as_json() -> None:
    made = json.loads(
        ran("sim", "velodyne-vlp16", "-t", "50ms", "--to", "udp://127.0.0.1:2999", "--json").stdout
    )
    assert made == {
        "sensor": "velodyne-vlp16",
        "place": "udp://127.0.0.1:2999",
        "source": "udp://127.0.0.1:2999",
        "next": "lidarspec view udp://127.0.0.1:2999 -s velodyne-vlp16",
    }


def test_datagrams_for_another_computer_are_read_there_at_every_interface() -> None:
    result = ran("sim", "velodyne-vlp16", "-t", "20ms", "--to", "udp://127.0.0.2:2999")
    assert result.stdout == "udp://127.0.0.2:2999\n"
    assert "lidarspec view udp://:2999 -s velodyne-vlp16" in result.stderr


def test_a_file_is_written_at_once_and_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "made.lsr"
    # In real time, it would last longer than `ran` waits.
    result = ran("sim", STL, "--to", path, "-t", "125s", "--errors", "0.1%", "--seed", "3")
    assert result.stdout == f"{path}\n"
    assert re.search("22500[01] data frames sent", result.stderr)
    with ls.open(path) as device:
        assert len([scan for scan in device.scans() if scan.whole]) in range(1150, 1251)
        assert device.stats.bad_checksum > 0
    assert "exists" in ran("sim", STL, "--to", path, code=2).stderr
    ran("sim", STL, "--to", path, "-t", "1s", "--force")


def test_the_clock_has_faults(tmp_path: Path) -> None:
    path = tmp_path / "made.lsr"
    ran("sim", "robosense-m1", "--to", path, "-t", "1s", "--clock", "step=5s@500ms,unlock@0.2s")
    with ls.open(path, "robosense-m1") as device:
        times = np.concatenate([packets.time_ns for packets in device.packets()])
    steps = np.diff(times) * 1e-9
    assert steps.max() == pytest.approx(5.0, abs=0.01)
    assert times[0] < 1e9 <= times[-1] - 4.9e9
    refused = ran("sim", "cspc-m1c1-mini", "--to", path, "--force", "--clock", "drift=1ppm", code=2)
    assert "has no clock" in refused.stderr
    ran("sim", STL, "--to", path, "--force", "--clock", "unlock@1s", code=2)
    simulated = connect(SourceAddress.parse("sim:ldrobot-stl27l?clock=drift=50ppm,step=1s@2s"))
    assert simulated.device.faults.clock == parse_clock_faults("drift=50ppm,step=1s@2s")
    simulated.close()


def test_an_unplugged_simulation_is_reported(tmp_path: Path) -> None:
    result = ran(
        "sim",
        "velodyne-vlp16",
        "-t",
        "1s",
        "--unplug",
        "300ms",
        "--absent",
        "200ms",
        "--to",
        "udp://127.0.0.1:2998",
    )
    assert [line.partition(" s: ")[2] for line in result.stderr.splitlines() if " s: " in line][
        :2
    ] == [
        "disconnected",
        "connected again at udp://127.0.0.1:2998",
    ]


@pytest.mark.slow
@posix
def test_an_existing_link_is_a_source_error(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    done = process("sim", STL, "--link", taken)
    assert done.returncode == 3
    assert b"File exists" in done.stderr


@pytest.mark.parametrize("text", ["2m", "2min", "1.5h", "300ms", "20us", "3s", "7"])
def test_a_duration_reads_the_same_as_an_option_and_in_a_source(text: str) -> None:
    assert (
        DURATION.convert(text, None, None)
        == parse_duration(text)
        == parse_faults({"unplug": text}).unplug
    )
    assert connect(
        SourceAddress.parse(f"sim:ldrobot-stl27l?unplug={text}")
    ).device.faults.unplug == parse_duration(text)


def test_a_blocked_rotor_is_simulated_and_reported(tmp_path: Path) -> None:
    path = tmp_path / "blocked.bin"
    ran("sim", "ldrobot-ld06", "--rotor", "blocked", "--to", path, "-t", "1.5s")
    done = ran("convert", path, tmp_path / "points.csv", "-s", "ldrobot-ld06")
    assert (
        "the angle 'azimuth' did not pass 0 within 0.4 s, so no scan was completed: is the rotor"
        " blocked?" in " ".join(done.stderr.split())
    )
