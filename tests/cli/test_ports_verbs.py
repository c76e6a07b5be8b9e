"""Tests of `ports`, `detect`, `doctor` and `send` at pseudo terminals and sockets."""

from __future__ import annotations

import json
import os
import random
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.detect.identification import Verdict
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Crc
from lidarspec.testing.fixtures import virtual_port
from lidarspec.transports.ports import SerialPort
from tests.cli.running import process, ran, run_json
from tests.lines import TIMEOUT_S, port, send_paced, udp, working


class TestSend:
    def test_a_reply_is_printed_with_its_fields(self) -> None:
        with virtual_port("cspc-m1c1-mini") as made:
            text = ran("send", made.path, "start", "-s", "cspc-m1c1-mini").stdout
            assert text.splitlines()[0] == "cspc-m1c1-mini start: replied with ack"
            assert "firmware  3 " in text
            assert "reserved  00 00 00 00 00 00" in text
            time.sleep(0.2)
            assert made.device.commands_received == ["start"]  # and not stopped again
            told = run_json("send", made.path, "stop", "-s", "cspc-m1c1-mini")
        assert (told["confirmed"], told["frame"], told["fields"]["mode"]) == (True, "ack", 0x55)
        assert told["hex"] == "a5 5a 55 07 00 00 00 00 00 00 00 ad"

    def test_undocumented_replies_are_reported(self) -> None:
        with virtual_port("cspc-m1c1-mini") as made:
            assert (
                "no reply is documented"
                in ran("send", made.path, "low_exposure", "-s", "cspc-m1c1-mini").stdout
            )
            assert (
                run_json("send", made.path, "high_exposure", "-s", "cspc-m1c1-mini")["confirmed"]
                is False
            )

    def test_arguments_bring_their_units(self) -> None:
        with virtual_port("slamtec-rplidar-s2") as made:
            ran("send", made.path, "motor_speed", "speed=10Hz", "-s", "slamtec-rplidar-s2")
            told = run_json(
                "send", made.path, "get_max_distance", "mode=0x1", "-s", "slamtec-rplidar-s2"
            )
            assert {value["path"]: value.get("unit") for value in told["values"]}[
                "value.max_distance"
            ] == "m"
            for words in (
                ["motor_speed", "speed=3m"],
                ["motor_speed", "speed"],
                ["motor_speed", "speed=fast"],
                ["motor_speed", "pace=1"],
            ):
                ran("send", made.path, *words, "-s", "slamtec-rplidar-s2", code=2)
            assert (
                "did you mean 'motor_speed'"
                in ran("send", made.path, "motor_sped", "-s", "slamtec-rplidar-s2", code=2).stderr
            )
            assert (
                "outside"
                in ran(
                    "send",
                    made.path,
                    "motor_speed",
                    "speed=70000",
                    "-s",
                    "slamtec-rplidar-s2",
                    code=2,
                ).stderr
            )

    def test_a_dead_device_is_its_own_fault(self, tmp_path: Path) -> None:
        with port(tmp_path) as made:
            found = ran(
                "send", made.name, "start", "-s", "cspc-m1c1-mini", "--timeout", "200ms", code=5
            )
        assert "no ack frame received within 0.2 s" in found.stderr
        assert f"next: lidarspec doctor {made.name} -s cspc-m1c1-mini" in found.stderr

    @pytest.mark.slow
    def test_sources_that_accept_no_commands(self, tmp_path: Path) -> None:
        ran("send", "/dev/ttyNONE7", "start", "-s", "cspc-m1c1-mini", code=3)
        (tmp_path / "raw.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 9)))
        ran("send", tmp_path / "raw.bin", "start", "-s", "cspc-m1c1-mini", code=2)
        with virtual_port("ldrobot-stl27l") as made:
            assert "the sensor has no commands" in ran("send", made.path, "start", code=2).stderr

    def test_a_port_in_use(self) -> None:
        with virtual_port("ldrobot-stl27l") as made, ls.open(made.path, "ldrobot-stl27l"):
            assert (
                "in use" in ran("send", made.path, "start", "-s", "cspc-m1c1-mini", code=3).stderr
            )


class TestDetect:
    @pytest.mark.slow
    def test_a_port(self) -> None:
        with virtual_port("ldrobot-stl27l") as made:
            found = ran("detect", made.path)
            told = run_json("detect", made.path)
        assert f"next: lidarspec view {made.path} -s ldrobot-stl27l" in found.stderr
        row = next(line.split() for line in found.stdout.splitlines() if "stl27l" in line)
        assert row[1:3] == ["ldrobot-stl27l", "yes"]
        assert told["sources"][0]["sensor"] == "ldrobot-stl27l"
        alike = {
            f"ldrobot-{name}" for name in ("stl27l", "ld06", "ld14", "ld14p", "ld20", "stl06p")
        } | {"oradar-ms200"}
        assert {fit["sensor"] for fit in told["sources"][0]["fits"]} == alike

    @pytest.mark.slow
    def test_a_silent_port_and_starting_it(self) -> None:
        with virtual_port("cspc-m1c1-mini") as made:
            found = ran("detect", made.path, "-t", "300ms", code=5)
            assert "no data received" in found.stderr
            assert f"next: lidarspec detect {made.path} --start" in found.stderr
            assert (
                "info.model is M1C1_Mini"
                in ran("detect", made.path, "-t", "300ms", "--start").stdout
            )

    @pytest.mark.slow
    def test_unknown_bytes_are_taken_apart(self, tmp_path: Path) -> None:
        source = random.Random(3)
        bodies = [b"\x99\x88\x77" + bytes([index]) + source.randbytes(20) for index in range(60)]
        path = tmp_path / "unknown.bin"
        path.write_bytes(
            b"".join(
                body + Crc(16, 0x8005, 0xFFFF, True, True)(body).to_bytes(2, "little")
                for body in bodies
            )
        )
        found = ran("detect", path, code=4)
        assert "sync      99 88 77" in found.stdout
        assert "26 bytes each: 60 frames" in found.stdout
        assert (
            "checksum  Crc(width=16, poly=0x8005, init=0xFFFF, refin=True, refout=True) in the last"
            " 2 bytes: correct in 60 of 60" in found.stdout
        )
        told = json.loads(ran("detect", path, "--json", code=4).stdout)
        assert (told["sources"][0]["sensor"], told["structure"]["period"]) == (None, 26)
        assert told["structure"]["checksums"][0]["name"] == "CRC-16/MODBUS"

    def test_noise_is_noise(self, tmp_path: Path) -> None:
        (tmp_path / "noise.bin").write_bytes(random.Random(9).randbytes(9000))
        assert "have no repeated structure" in ran("detect", tmp_path / "noise.bin", code=4).stderr
        (tmp_path / "empty.bin").write_bytes(b"")
        ran("detect", tmp_path / "empty.bin", code=4)
        ran("detect", tmp_path / "none.bin", code=3)
        ran("detect", "-", code=2)

    def test_sources_with_the_same_frames_are_a_question(self, tmp_path: Path) -> None:
        sensor = ls.sensor("slamtec-rplidar-s2")
        (tmp_path / "nodes.bin").write_bytes(
            sensor.build("scan_descriptor") + b"".join(simulate(sensor, 300))
        )
        found = ran("detect", tmp_path / "nodes.bin")
        assert "slamtec-rplidar-a1, slamtec-rplidar-a2, " in found.stderr
        assert "these models send the same frames" in found.stderr
        assert found.stdout.count("perhaps") == 9

    def test_all_ports_are_listened_to_at_the_same_time(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        both = threading.Barrier(2)

        def listened(source: str, duration: float, *, start: bool) -> list[Verdict]:
            both.wait(TIMEOUT_S)
            return [Verdict(SampleBytes(source))]

        monkeypatch.setattr("lidarspec.cli.finding._detect_source", listened)
        monkeypatch.setattr(
            "lidarspec.cli.finding.list_serial_ports",
            lambda: [SerialPort("/dev/ttyUSB0", "", "", True, ())],
        )
        monkeypatch.setattr("lidarspec.cli.finding.list_udp_ports", lambda: [2368])
        told = json.loads(ran("detect", "--json", code=5).stdout)
        assert [one["source"] for one in told["sources"]] == ["/dev/ttyUSB0", "udp://:2368"]

    @pytest.mark.slow
    def test_all_udp_ports_without_a_source(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            frames = simulate(ls.sensor("robosense-m1"), 40)
            with working(
                lambda stop: send_paced(
                    lambda data: sender.sendto(data, ("127.0.0.1", 6699)), frames, 200, stop
                )
            ):
                found = ran("detect", "-t", "400ms")
        assert "next: lidarspec view udp://:6699 -s robosense-m1" in found.stderr


class TestPorts:
    def test_udp_ports_of_sensors_and_their_users(self) -> None:
        told = run_json("ports")
        known = {one["port"]: one for one in told["udp"]}
        assert "robosense-m1" in known[6699]["sensors"]
        script = (
            "import socket; s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); "
            "s.bind(('127.0.0.1', 7788)); print(1, flush=True); input()"
        )
        with subprocess.Popen(
            [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other:
            assert other.stdout is not None
            other.stdout.readline()
            busy = {one["port"]: one for one in run_json("ports")["udp"]}[7788]
            text = ran("ports").stdout
            assert f"kill {other.pid}" in ran("doctor", "udp://:7788", code=1).stdout
            assert other.stdin is not None
            other.stdin.close()
        assert (busy["free"], [user["pid"] for user in busy["users"]]) == (False, [other.pid])
        assert f"(process {other.pid})" in text

    def test_it_leads_on(self) -> None:
        assert "next: lidarspec detect" in ran("ports").stderr


class TestDoctor:
    def _run_doctor(self, *words: object) -> list[dict[str, Any]]:
        result = process("doctor", *words, "--json")
        found: list[dict[str, Any]] = json.loads(result.stdout)
        assert result.returncode == int(not all(finding["ok"] for finding in found))
        return found

    @pytest.mark.slow
    def test_a_sensor_without_problems(self) -> None:
        with virtual_port("ldrobot-stl27l") as made:
            found = ran("doctor", made.path, "-s", "ldrobot-stl27l", "-t", "500ms")
        assert "wrong" not in found.stdout
        assert "ldrobot-stl27l sends: " in found.stdout

    @pytest.mark.slow
    def test_another_sensor_than_thought(self) -> None:
        with virtual_port("ldrobot-stl27l") as made:
            found = ran("doctor", made.path, "-s", "cspc-coin-d4", "-t", "300ms", code=1).stdout
        assert "received frames of ldrobot-stl27l, not of cspc-coin-d4" in found
        assert f"next: lidarspec view {made.path} -s ldrobot-stl27l" in found

    def test_a_file_is_compared_with_the_named_sensor(self, tmp_path: Path) -> None:
        path = tmp_path / "vlp16.bin"
        path.write_bytes(b"".join(simulate(ls.sensor("velodyne-vlp16"), 60)))
        assert (
            "ok     velodyne-vlp16 sends: 60 data frames"
            in ran("doctor", path, "-s", "velodyne-vlp16").stdout
        )
        for name in ("velodyne-hdl32e", "robosense-m1"):
            assert f", not of {name}" in ran("doctor", path, "-s", name, code=1).stdout

    @pytest.mark.parametrize(("damaged", "code"), [(0.03, 0), (0.3, 1), (0.6, 1)])
    def test_a_line_is_bad_if_a_tenth_of_its_bytes_is_invalid(
        self, tmp_path: Path, damaged: float, code: int
    ) -> None:
        frames = simulate(ls.sensor("ldrobot-stl27l"), 60)
        for size in (60, 300):
            data = [
                bytes(47) if (i * damaged) % 1 < damaged else frame
                for i, frame in enumerate((frames * 5)[:size])
            ]
            (tmp_path / "line.bin").write_bytes(b"".join(data))
            said = ran("doctor", tmp_path / "line.bin", "-s", "ldrobot-stl27l", code=code).stdout
            assert said.startswith("wrong" if code else "ok")

    def test_a_sensor_that_waits_for_a_start_command(self) -> None:
        with virtual_port("cspc-m1c1-mini") as made:
            found = ran("doctor", made.path, "-s", "cspc-m1c1-mini", "-t", "300ms", code=1).stdout
            assert f"next: lidarspec send {made.path} start -s cspc-m1c1-mini" in found
            assert "--start" in ran("doctor", made.path, "-t", "300ms", code=1).stdout

    @pytest.mark.slow
    def test_a_missing_port_and_one_in_use(self) -> None:
        assert self._run_doctor("/dev/ttyNONE7") == [
            {
                "ok": False,
                "text": (
                    "/dev/ttyNONE7: no such port; check that the device is connected and its driver"
                    " is loaded"
                ),
                "fix": "lidarspec ports",
            }
        ]
        with virtual_port("ldrobot-stl27l") as made:
            script = (
                f"import lidarspec as ls; d = ls.open({made.path!r}, 'ldrobot-stl27l'); print(1,"
                " flush=True); input()"
            )
            with subprocess.Popen(
                [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE
            ) as other:
                assert other.stdout is not None
                assert other.stdin is not None
                other.stdout.readline()
                texts = {finding["fix"]: finding["text"] for finding in self._run_doctor(made.path)}
                other.stdin.close()
        assert f"(process {other.pid})" in texts[f"kill {other.pid}"]

    @pytest.mark.slow
    def test_bytes_of_no_sensor(self, tmp_path: Path) -> None:
        source = random.Random(8)
        with (
            port(tmp_path) as made,
            working(
                lambda stop: send_paced(
                    made.offer, [source.randbytes(90) for _ in range(40)], 200, stop
                )
            ),
        ):
            found = ran("doctor", made.name, "-t", "300ms", code=1).stdout
        assert "no frame of an installed sensor" in found
        assert f"next: lidarspec detect {made.name}" in found

    def test_a_port_without_permission(self, tmp_path: Path) -> None:
        if os.geteuid() == 0:
            pytest.skip("root may open everything")
        with port(tmp_path) as made:
            os.chmod(os.path.realpath(made.name), 0)
            assert any(
                "may not open it" in finding["text"] for finding in self._run_doctor(made.name)
            )

    @pytest.mark.slow
    def test_udp_with_and_without_packets(self) -> None:
        with udp() as free:
            number = free.getsockname()[1]
        silent = self._run_doctor(f"udp://127.0.0.1:{number}", "-t", "300ms")
        assert any("no data received" in finding["text"] for finding in silent)
        assert any(
            "the source receives only packets to 127.0.0.1" in finding["text"] for finding in silent
        )
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            frames = simulate(ls.sensor("robosense-m1"), 40)
            with working(
                lambda stop: send_paced(
                    lambda data: sender.sendto(data, ("127.0.0.1", number)), frames, 200, stop
                )
            ):
                well = self._run_doctor(f"udp://127.0.0.1:{number}", "-t", "500ms")
                other = f"udp://127.0.0.1:{number}?src=127.0.0.9"
                instead, detected = (
                    self._run_doctor(other, "-t", "500ms"),
                    ran("detect", other, "-t", "500ms", code=5).stderr,
                )
        assert any(finding["ok"] and "robosense-m1 sends" in finding["text"] for finding in well)
        for said in (detected, "".join(finding["text"] for finding in instead)):
            assert re.search(
                r"no data from the requested sender; \d+ datagrams came from other senders, such as"
                r" 127.0.0.1:",
                said,
            )

    @pytest.mark.slow
    def test_files(self, tmp_path: Path) -> None:
        (tmp_path / "empty.bin").write_bytes(b"")
        assert not self._run_doctor(tmp_path / "empty.bin")[0]["ok"]
        assert not self._run_doctor(tmp_path / "none.bin")[0]["ok"]
        (tmp_path / "good.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 30)))
        assert self._run_doctor(tmp_path / "good.bin")[0]["ok"]

    @pytest.mark.slow
    def test_the_whole_computer(self) -> None:
        assert process("doctor").returncode in (0, 1)


def test_bytes_sent_by_hand_are_answered_and_the_answer_is_explained() -> None:
    sensor = ("-s", "slamtec-rplidar-a1")
    said = ran("send", "sim:slamtec-rplidar-a1", "--hex", "0xA5, 0x50  # get_info", *sensor)
    assert said.stdout.startswith("slamtec-rplidar-a1 info, 27 bytes\n0000  a5 5a ")
    assert said.stderr == "sent 2 bytes: a5 50\n"
    told = run_json("send", "sim:cspc-m1c1-mini", "--hex", "aa55f00f", "-s", "cspc-m1c1-mini")
    assert (told["sent"], told["frames"][0]["frame"]) == (
        "aa 55 f0 0f",
        "ack",
    )  # what follows it comes sooner or later
    streaming = ran("send", "sim:ldrobot-stl27l", "--hex", "00", "--timeout", "300ms")
    assert streaming.stdout == ""
    assert "data frames were received besides the reply\nno reply received\n" in streaming.stderr
    for words in (("--hex", "5z"), ("--hex", "a5 50", "start"), ()):
        ran("send", "sim:slamtec-rplidar-a1", *words, *sensor, code=2)


@pytest.mark.parametrize("source", [(), ("udp://:45999",)])
def test_detect_exits_with_5_if_live_sources_are_silent(
    source: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lidarspec.cli.finding._detect_all_ports", lambda duration, start: iter([]))
    monkeypatch.setattr(
        "lidarspec.cli.finding._detect_source",
        lambda source, duration, start, on_progress: [Verdict(SampleBytes(source))],
    )
    assert ran("detect", *source, code=5).stderr.startswith("no data received\n")
