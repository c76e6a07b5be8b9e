"""Tests of simulated sensors as a source, on pseudo terminals, sockets and in files."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from construct import Const, Int8ul, Int16ul, Struct

import lidarspec as ls
from lidarspec import SourceError, UsageError
from lidarspec.errors import SpecError, UnknownFormat
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.simulation.scenes import Room, read_scene
from lidarspec.spec import Command, Frame, OnChange, Polar, Scaled, Serial, Simulation, Udp
from lidarspec.testing.fixtures import virtual_port
from lidarspec.transports.destinations import make_simulated_outlet
from lidarspec.transports.serving import FairLock, ServedSensor
from lidarspec.transports.simulated_files import write_file
from lidarspec.view.terminal_screen import Keyboard
from tests.broken import sound
from tests.lines import TIMEOUT_S, free_port, read_until, until
from tests.simulation.test_simulator import distance_outside

posix = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")
A1 = "slamtec-rplidar-a1"


def stl() -> ls.Sensor:
    return ls.sensor("ldrobot-stl27l")


def vlp() -> ls.Sensor:
    return ls.sensor("velodyne-vlp16")


def scans(device: ls.Device, number: int) -> list[ls.Scan]:
    """Read `number` whole scans; fail if they do not arrive."""
    found: list[ls.Scan] = []
    deadline = time.monotonic() + TIMEOUT_S
    for scan in device.scans(wait=0.05):
        found += [scan] if scan is not None and scan.whole else []
        if len(found) >= number:
            return found
        assert time.monotonic() < deadline, f"{device} {device.warnings}"
    raise AssertionError("the device ended")


@pytest.mark.parametrize(
    "name", ["ldrobot-stl27l", "cspc-m1c1-mini", "slamtec-rplidar-a1", "velodyne-vlp16"]
)
def test_a_simulated_sensor_is_a_source(name: str) -> None:
    with ls.open(f"sim:{name}?rate=max") as device:
        assert device.sensor.id == name
        found = scans(device, 3)
        assert device.stats.bad_checksum == device.stats.lost == device.stats.queue_dropped == 0
    assert all(scan.points.valid.mean() > 0.95 for scan in found)


def test_a_sensor_that_is_not_registered_is_simulated_by_its_id() -> None:
    sensor = dataclasses.replace(ls.sensor("ldrobot-stl27l"), id="acme-x1", aliases=())
    with ls.open("sim:acme-x1", sensor) as device:
        assert device.latest(TIMEOUT_S).complete
        assert device.sensor.id == "acme-x1"


def test_an_unstarted_sensor_sends_nothing() -> None:
    with ls.open("sim:slamtec-rplidar-a1", start=False) as device:
        assert next(iter(device.packets(wait=0.3))).stats.bytes_in == 0
        assert device.send("get_info").values.hardware == 7
        assert device.send("scan").confirmed
        assert scans(device, 1)


def test_an_rplidar_is_opened_in_the_scan_mode_that_it_is_configured_for() -> None:
    with ls.open(
        "sim:slamtec-rplidar-a1?rate=max", ls.sensor("slamtec-rplidar-a1").configure(mode=3)
    ) as device:
        assert scans(device, 2)
        assert set(device.stats.frames) == {"ultra", "ultra_descriptor"}


def test_faults_of_a_source_are_seen_and_counted() -> None:
    with ls.open("sim:velodyne-vlp16?rate=max&loss=0.05&seed=3") as device:
        found = scans(device, 3)
    assert sum(map(len, found)) < 0.99 * 3 * 75.35 * 384
    with ls.open("sim:hesai-xt32?rate=max&loss=0.02&reorder=4") as device:
        scans(device, 3)
        assert device.stats.lost > 0
        assert device.stats.late > 0
    with ls.open("sim:ldrobot-stl27l?rate=max&errors=0.005") as device:
        scans(device, 3)
        assert device.stats.bad_checksum > 0


def test_as_fast_as_possible_nothing_is_dropped_and_two_runs_are_the_same() -> None:
    runs = []
    for _ in range(2):
        with ls.open("sim:robosense-m1?rate=max&seed=2") as device:
            runs.append(list(itertools.islice(device.scans(), 2)))
            assert device.stats.queue_dropped == device.stats.lost == 0
    for first, second in zip(*runs, strict=True):
        assert np.array_equal(first.points.xyz, second.points.xyz, equal_nan=True)


def test_an_unplugged_source_comes_back() -> None:
    with ls.open("sim:cspc-m1c1-mini?rate=3&unplug=1s&absent=200ms") as device:
        scans(device, 2)
        read_until(device, lambda: device.stats.disconnects)
        assert scans(device, 1)
        assert device.stats.frames["ack"] >= 2


def test_a_scene_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "box.toml"
    path.write_text("[[box]]\nlow = [2, -1, -1]\nhigh = [3, 1, 1]\n")
    with ls.open(f"sim:ldrobot-stl27l?rate=max&scene={path}") as device:
        points = scans(device, 1)[0].points
    assert points.x[points.valid].min() == pytest.approx(2, abs=0.001)
    assert 0.1 < points.valid.mean() < 0.2


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("sim:ldrobot-stl27", "did you mean 'ldrobot-stl27l'"),
        ("sim:", "expected the id of a sensor"),
        ("sim:ldrobot-stl27l?error=0.1", "did you mean 'errors'"),
        ("sim:ldrobot-stl27l?rate=-1", "rate must be a number above 0"),
        ("sim:ldrobot-stl27l?rate=nan", "rate must be a number above 0"),
        ("sim:ldrobot-stl27l?seed=x", "seed must be an integer"),
        ("sim:ldrobot-stl27l?reorder=3", "keeps its order"),
        ("sim:ldrobot-stl27l?errors=2", "errors = 2.0 is outside"),
    ],
)
def test_an_invalid_source_gives_a_reason(source: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        ls.open(source)


@posix
@pytest.mark.parametrize("name", ["ldrobot-stl27l", "cspc-m1c1-mini", "slamtec-rplidar-c1"])
def test_on_a_serial_port_nothing_is_lost_and_every_command_is_answered(name: str) -> None:
    sensor, room = ls.sensor(name), Room()
    with virtual_port(sensor, scene=room) as port:
        with ls.open(port.path, sensor) as device:
            found = scans(device, 2)
            assert device.stats.bad_checksum == 0
            assert device.stats.bytes_skipped == device.stats.bytes_filler
        wanted = [
            command
            for command in (*sensor.on_open, *sensor.on_close)
            if sensor.commands[command].frame
        ]
        port.wait_for_commands(wanted, timeout=TIMEOUT_S)
    for scan in found:
        assert scan.points.valid.mean() > 0.98
        assert (
            distance_outside(room, scan.points.xyz[scan.points.valid].astype(np.float64)).max()
            < 0.0006
        )


@posix
def test_data_sent_without_a_listener_is_lost() -> None:
    with virtual_port(stl()) as port:
        for _ in range(3):
            with ls.open(port.path, stl()) as device:
                first = next(packets for packets in device.packets() if len(packets))
                sent = port.device.sent["data"]
                assert abs(int(first["timestamp"][0] * 1800) - sent) < 0.5 * 1800
            time.sleep(0.2)
        assert port.outlet.unsent_bytes > 0.3 * 84_600


@posix
def test_the_port_goes_away_with_its_plug_and_the_link_leads_to_the_new_one(tmp_path: Path) -> None:
    link = tmp_path / "ttyLIDAR"
    with virtual_port(stl(), link=link) as port:
        before = os.readlink(link)
        with ls.open(str(link), stl()) as device:
            scans(device, 1)
            port.unplug()
            assert not link.is_symlink()
            port.plug()
            assert link.is_symlink()
            assert os.readlink(link).startswith(os.path.dirname(before))
            scans(device, 2)
            assert device.stats.disconnects == 1
    assert not link.is_symlink()


@posix
def test_a_link_replaces_no_other_file(tmp_path: Path) -> None:
    taken = tmp_path / "notes"
    taken.write_text("mine")
    with pytest.raises(SourceError, match="File exists"):
        make_simulated_outlet(stl(), "pty", taken)
    assert taken.read_text() == "mine"
    stale = tmp_path / "ttyOLD"
    stale.symlink_to("/dev/pts/does-not-exist")
    make_simulated_outlet(stl(), "pty", stale).close()
    assert not stale.is_symlink()


def test_datagrams_go_to_the_declared_ports_by_their_kind_unless_one_is_named() -> None:
    receivers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for receiver in receivers:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(TIMEOUT_S)
    ports = [receiver.getsockname()[1] for receiver in receivers]
    sensor = dataclasses.replace(vlp(), links={"data": Udp(*ports)})
    with virtual_port(sensor, to="udp://") as port:
        assert port.path == f"udp://127.0.0.1?port={ports[0]},{ports[1]}"
        assert [{len(receiver.recv(2000)) for _ in range(20)} for receiver in receivers] == [
            {1206},
            {512},
        ]
    with virtual_port(sensor, to=f"udp://127.0.0.1:{ports[1]}"):
        assert {len(receivers[1].recv(2000)) for _ in range(60)} == {1206, 512}
    for receiver in receivers:
        receiver.close()


def test_over_udp_all_packets_arrive() -> None:
    number = free_port()
    with (
        ls.open(f"udp://127.0.0.1:{number}", "robosense-m1") as device,
        virtual_port("robosense-m1", to=f"udp://127.0.0.1:{number}"),
    ):
        scans(device, 3)
        assert device.stats.lost == 0


def test_a_slow_tcp_client_does_not_delay_others() -> None:
    with virtual_port(stl(), to="tcp://127.0.0.1:0") as port:
        address = port.path.removeprefix("tcp://").split(":")
        with (
            socket.create_connection((address[0], int(address[1]))),
            ls.open(port.path, stl()) as device,
            ls.open(port.path, stl()) as other,
        ):
            assert scans(device, 2)
            assert scans(other, 2)
        with pytest.raises(SourceError, match="in use"):
            make_simulated_outlet(stl(), port.path)
        port.unplug()
        with pytest.raises(SourceError):
            ls.open(port.path, stl())
        port.plug()
        with ls.open(port.path, stl()) as device:
            assert scans(device, 1)


@pytest.mark.parametrize(
    ("name", "suffix", "seconds"),
    [
        ("ldrobot-stl27l", "bin", 0.3),
        ("cspc-m1c1-mini", "lsr", 1.5),
        pytest.param("slamtec-rplidar-a1", "bin", 1.5, marks=pytest.mark.slow),
        ("robosense-m1", "pcap", 0.1),
    ],
)
def test_a_file_contains_the_bytes_of_the_live_sensor(
    name: str, suffix: str, seconds: float, tmp_path: Path
) -> None:
    path, device = tmp_path / f"made.{suffix}", SimulatedDevice(ls.sensor(name), scene=Room())
    written = write_file(device, path, seconds)
    assert written > 3000
    with ls.open(path, name) as opened:
        number = sum(map(len, opened.packets()))
        assert opened.stats.frames == dict(device.sent)
    assert number == device.sent.most_common(1)[0][1]
    again = SimulatedDevice(ls.sensor(name), scene=Room())
    write_file(again, tmp_path / f"again.{suffix}", seconds)
    if suffix == "bin":
        assert path.read_bytes() == (tmp_path / f"again.{suffix}").read_bytes()


@pytest.mark.parametrize("rate", [15, 30, 60])
def test_a_file_has_the_rate_that_the_spec_declares(rate: int, tmp_path: Path) -> None:
    image = ls.Sensor(
        "acme-image",
        vendor="Acme",
        model="Image",
        frames={
            "data": Frame(
                Struct(
                    "head" / Const(b"\xc5\x01"),
                    "number" / Int8ul,
                    "range" / Scaled(Int16ul, 0.001, "m"),
                ),
                data=True,
            )
        },
        points=lambda fields: Polar(fields.range, 0.0),
        scan=OnChange("number"),
        links={"data": Serial(115_200)},
        simulation=Simulation(lambda index: {"number": index % 256}, rate=rate),
        range_limits=(0.05, 30.0),
        status="manual",
        source="invented",
    )
    path = tmp_path / "made.lsr"
    write_file(SimulatedDevice(image, scene=Room()), path, 1.0)
    with ls.open(path, image) as opened:
        rates = [scan.rate_hz for scan in opened.scans() if scan.complete]
    assert len(rates) > rate // 2
    assert rates == pytest.approx([rate] * len(rates), rel=1e-6)


def test_a_start_command_that_no_program_sends_does_not_silence_a_sensor(tmp_path: Path) -> None:
    sensor = sound.sensor()
    assert sensor.commands["start"].starts
    assert not sensor.on_open
    device = SimulatedDevice(sensor, scene=Room())
    assert write_file(device, tmp_path / "made.bin", 0.2)
    assert device.sent["data"] == 41  # every 5 ms, both ends included


def test_an_empty_file_is_an_error_with_the_reason(tmp_path: Path) -> None:
    start = Command("order", {"code": 1}, starts=True)
    stop = Command("order", {"code": 2}, stops=True)
    slow = sound.sensor(
        on_open=("start",), simulation=Simulation(sound.sweep, answers={"start": (0.5,)})
    )
    stopped = sound.sensor(commands={"stop": stop}, on_open=("stop",))
    mistaken = sound.sensor(
        commands={"wake": Command("order", {"code": 1}), "start": start}, on_open=("start",)
    )
    polled = dataclasses.replace(
        sound.sensor(),
        frames={
            "ask": Frame(Struct("head" / Const(b"\xc5\x09\x09")), direction="out"),
            "value": Frame(Struct("head" / Const(b"\xc5\x02\x03"), "value" / Int8ul)),
        },
        commands={"ask": Command("ask", reply="value")},
        **dict.fromkeys(("points", "scan", "clock", "sequence"), None),
    )
    for device, seconds, error, said in (
        (
            SimulatedDevice(slow),
            0.1,
            UsageError,
            "sends no data in the first 0.1 s; the next frame is due after 0.5 s",
        ),
        (
            SimulatedDevice(stl(), faults=Faults(loss=1.0)),
            0.1,
            UsageError,
            "all sent frames",
        ),
        (SimulatedDevice(polled), 0.1, UsageError, "sends only replies to commands"),
        (SimulatedDevice(stopped), 0.1, SpecError, "the sensor received stop, and sends no data"),
        (
            SimulatedDevice(mistaken),
            0.1,
            SpecError,
            "'start' was sent, but the sensor recognized wake",
        ),
    ):
        with pytest.raises(error, match=said):
            write_file(device, tmp_path / "empty.bin", seconds)
        assert not (tmp_path / "empty.bin").exists()


def test_a_destination_that_cannot_carry_the_sensor_is_refused(tmp_path: Path) -> None:
    for sensor, place, said in (
        (stl(), "udp://", "not datagrams"),
        (vlp(), "pty", "datagrams, which a serial port cannot carry"),
        (vlp(), "tcp://", "declares no TCP port"),
        (stl(), "http://localhost", "invalid destination"),
        (vlp(), "udp://?rate=3", "unknown option"),
        (vlp(), "udp://127.0.0.1:99999", "a port must be a number"),
    ):
        with pytest.raises(UsageError, match=said):
            make_simulated_outlet(sensor, place)
    with pytest.raises(UsageError, match="only supported for a pseudo-terminal"):
        make_simulated_outlet(vlp(), "udp://", tmp_path / "link")
    with pytest.raises(UnknownFormat):
        write_file(SimulatedDevice(stl()), tmp_path / "made.csv", 1)
    with pytest.raises(SourceError):
        make_simulated_outlet(vlp(), "udp://no-such-host.invalid")


@posix
def test_an_exception_of_the_serving_thread_is_raised_at_the_end() -> None:
    tried = threading.Event()

    class Broken(SimulatedDevice):
        def outgoing_with_types(self, now: int) -> list[tuple[str, str, bytes]]:
            tried.set()
            raise ZeroDivisionError

    port = ServedSensor(Broken(stl(), faults=Faults()), make_simulated_outlet(stl(), "pty"))
    assert tried.wait(TIMEOUT_S)
    with pytest.raises(ZeroDivisionError):
        port.close()


@pytest.fixture
def above_1023() -> Iterator[None]:
    """Occupy all descriptors below 1024: `select` supports no later ones."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limits[1] < 2048:
        pytest.skip("this user may not open so many files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2048, limits[1]))
    with contextlib.ExitStack() as stack:
        while stack.enter_context(open(os.devnull, "rb")).fileno() < 1024:
            pass
        yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@posix
@pytest.mark.usefixtures("above_1023")
@pytest.mark.parametrize(
    ("name", "to"), [(A1, "pty"), (A1, "tcp://127.0.0.1:0"), ("velodyne-vlp16", "udp")]
)
def test_descriptors_may_have_any_number(name: str, to: str) -> None:
    place = f"udp://127.0.0.1:{free_port()}" if to == "udp" else to
    with virtual_port(name, to=place) as port, ls.open(port.path, name) as device:
        scans(device, 1)
        assert bool(port.device.commands_received) == (name == A1)


@posix
@pytest.mark.usefixtures("above_1023")
def test_keys_come_over_any_descriptor() -> None:
    master, slave = os.openpty()
    with Keyboard(slave) as keyboard:
        os.write(master, b"q")
        assert keyboard.read(TIMEOUT_S) == ["q"]
    os.close(master)
    os.close(slave)


@posix
def test_many_simulators_take_turns_and_end() -> None:
    """One process runs twelve simulators; all of them send, and all of them end."""
    ports = [
        ServedSensor(SimulatedDevice(stl()), make_simulated_outlet(stl(), "pty")) for _ in range(12)
    ]
    until(lambda: all(port.device.sent["data"] for port in ports))

    def end() -> None:
        for port in ports:
            port.close()

    ending = threading.Thread(target=end, daemon=True)
    ending.start()
    until(lambda: not ending.is_alive())


def test_a_fair_lock_grants_turns_in_order_and_can_be_cancelled() -> None:
    turns, came = FairLock(), list[tuple[int, bool]]()
    stops = [threading.Event() for _ in range(4)]

    def work(number: int) -> None:
        with turns.hold(stops[number]) as is_ours:
            came.append((number, is_ours))

    waiting = [threading.Thread(target=work, args=(number,)) for number in (1, 2, 3)]
    with turns.hold(stops[0]) as is_ours:
        assert is_ours
        for number, thread in enumerate(waiting, start=2):
            thread.start()
            until(lambda number=number: len(turns._tickets) == number)  # type: ignore[misc]
        turns.cancel(stops[2])
        waiting[1].join(TIMEOUT_S)
        assert came == [(2, False)]
    for thread in waiting:
        thread.join(TIMEOUT_S)
    assert came == [(2, False), (1, True), (3, True)]


PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "simulate.md").read_text(encoding="utf-8")


@posix
@pytest.mark.slow
@pytest.mark.parametrize("block", re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL))
def test_the_programs_on_the_page_run_as_they_stand(block: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", block],
        capture_output=True,
        text=True,
        check=False,
        timeout=10 * TIMEOUT_S,
    )
    assert done.returncode == 0, done.stderr


def test_the_scene_on_the_page_is_one(tmp_path: Path) -> None:
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)
    (tmp_path / "hall.toml").write_text(text)
    scene = read_scene(tmp_path / "hall.toml")
    assert scene.walls == Room().walls
    assert (len(scene.boxes), len(scene.movers)) == (1, 1)
