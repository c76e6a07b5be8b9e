"""A source recorded while it is decoded: strangers and a plugin that fails cost no record."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import replace
from pathlib import Path

import pytest

from lidarspec.captures.pcap import CaptureReader
from lidarspec.device.source_recording import SourceRecording
from lidarspec.recording.format import Recording
from lidarspec.spec import Fields
from tests.lines import free_port, turning, udp
from tests.shapes import SHAPES


def fails(f: Fields) -> object:
    raise SystemExit("nothing that a plugin should do")


def test_a_recording_goes_on_whatever_decoding_says_and_whoever_sends(tmp_path: Path) -> None:
    good, number, path = SHAPES["shape-datagrams"], free_port(), tmp_path / "all.lsr"
    frames = {**good.frames, "data": replace(good.frames["data"], plausible=fails)}
    task = SourceRecording(f"udp://:{number}", str(path), replace(good, frames=frames))
    said, sent = "", turning(good, 50)
    with udp("127.0.0.2") as own, udp("127.0.0.3") as other, contextlib.closing(task.run()) as running:
        said += next(running)
        for frame in sent:
            own.sendto(frame, ("127.0.0.1", number))
            other.sendto(frame, ("127.0.0.1", number))
        for remark in running:
            said += remark
            if task.recorder is not None and task.recorder.records >= 100:
                break
        said += next(running)
    assert said.count("decoding fails (SystemExit: nothing that a plugin should do); the recording goes on") == 1
    with Recording(path) as recording:
        kept = [record.data for record in recording if record.sender is not None and record.sender[0] == "127.0.0.2"]
    assert kept == sent


def test_strangers_are_told_of_once_while_a_recording_goes_on(tmp_path: Path) -> None:
    sensor, number, path = SHAPES["shape-datagrams"], free_port(), tmp_path / "all.lsr"
    task, said = SourceRecording(f"udp://:{number}", str(path), sensor, count=60), list[str]()
    with udp("127.0.0.2") as own, udp("127.0.0.3") as other, contextlib.closing(task.run()) as running:
        said.append(next(running))
        for frame in turning(sensor, 60):
            own.sendto(frame, ("127.0.0.1", number))
            said.append(next(running))
            other.sendto(frame, ("127.0.0.1", number))
        said += running
    assert "\n".join(said).count("sends as well, and is left out") == 1


def test_a_sensor_that_sends_over_ipv6_is_recorded_for_wireshark(tmp_path: Path) -> None:
    sensor, path = SHAPES["shape-datagrams"], tmp_path / "six.pcap"
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sender:
        try:
            sender.bind(("::1", 0))
        except OSError:
            pytest.skip("this system has no IPv6")
        number, sent = free_port(), turning(sensor, 20)
        with contextlib.closing(SourceRecording(f"udp://[::1]:{number}", str(path), sensor, count=20).run()) as running:
            next(running)
            for frame in sent:
                sender.sendto(frame, ("::1", number))
            list(running)
        assert [datagram.data for datagram in CaptureReader(path)] == sent
        assert {datagram.source for datagram in CaptureReader(path)} == {sender.getsockname()[:2]}
