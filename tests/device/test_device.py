"""Tests of a live device: scans, silence, a slow consumer, unplugging.

They use real pseudo terminals and sockets.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
import lidarspec.device.device_input
import lidarspec.transports.files
from lidarspec.device.device_input import decode_chunks
from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.format import Recording
from lidarspec.spec import Chunk, Udp
from lidarspec.testing.fixtures import virtual_port
from lidarspec.transports.serial import SerialTransport
from lidarspec.transports.udp import UdpTransport
from tests.lines import (
    TIMEOUT_S,
    Port,
    free_port,
    port,
    read_until,
    send_paced,
    turning,
    udp,
    until,
    working,
)
from tests.shapes import SHAPES

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")

TURNING = SHAPES["shape-clock"]
WHOLE = SHAPES["shape-datagrams"]


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Port]:
    with port(tmp_path) as made:
        yield made


def packets(device: ls.Device, number: int) -> list[ls.Packets]:
    """Read batches until there are `number` packets; fail if they do not arrive."""
    found: list[ls.Packets] = []
    deadline = time.monotonic() + TIMEOUT_S
    for batch in device.packets(wait=0.05):
        found += [batch] if len(batch) else []
        if sum(map(len, found)) >= number:
            return found
        assert time.monotonic() < deadline, f"{device}"
    raise AssertionError("the device ended")


def wait_for_bytes(device: ls.Device, size: int) -> None:
    """Wait until the queue of a device holds as many bytes."""
    until(lambda: device._input.queue._size == size)  # type: ignore[union-attr]


def wait_for_chunks(device: ls.Device, number: int) -> None:
    """Wait until as many chunks were queued since a device was opened."""
    until(lambda: device._input.queue.produced >= number)  # type: ignore[union-attr]


def test_live_scans_equal_decoded_bytes(line: Port) -> None:
    frames = turning(TURNING, 40)
    with ls.open(f"serial://{line.name}", TURNING) as device:
        assert device.state == "waiting"
        for frame in frames:
            line.send(b"\x00" + frame)
        found = packets(device, 40)
        assert device.state == "streaming"
        assert device.warnings == []
    expected = TURNING.decode(b"".join(b"\x00" + frame for frame in frames))
    assert sum(map(len, found)) == len(expected)
    assert np.array_equal(np.concatenate([batch.raw for batch in found]), expected.raw)
    hosts = np.concatenate([batch.host_ns for batch in found])
    assert (np.diff(hosts) >= 0).all()
    assert abs(int(hosts[-1]) - time.time_ns()) < TIMEOUT_S * 1e9
    assert device.state == "closed"
    assert device.stats.bytes_in == sum(len(frame) + 1 for frame in frames)


def test_frames_have_the_time_of_the_chunk_that_completes_them() -> None:
    stream = b"".join(turning(TURNING, 4))
    size = len(stream) // 4
    chunks = [
        Chunk(stream[: size + 3], 10),
        Chunk(stream[size + 3 : 2 * size], 20),
        Chunk(stream[2 * size : -1], 30),
        Chunk(stream[-1:], 40),
    ]
    decoder = TURNING.decoder()
    decoder.feed(b"\x00" * 7)
    assert np.concatenate([spans.at for spans in decode_chunks(decoder, chunks)]).tolist() == [
        10,
        20,
        30,
        40,
    ]
    whole = [Chunk(stream[:size], 50), Chunk(stream[size:], 60)]
    assert np.concatenate([spans.at for spans in decode_chunks(decoder, whole)]).tolist() == [
        50,
        60,
        60,
        60,
    ]


def test_datagrams_and_their_gaps(line: Port) -> None:
    number = free_port()
    frames = turning(WHOLE, 20)
    with ls.open(f"udp://127.0.0.1:{number}", WHOLE) as device, udp() as sender:
        for frame in frames:
            sender.sendto(frame, ("127.0.0.1", number))
            sender.sendto(b"noise", ("127.0.0.1", number))
        found = packets(device, 20)
        read_until(device, lambda: device.stats.bytes_in == sum(len(frame) + 5 for frame in frames))
    assert np.array_equal(np.concatenate([batch.raw for batch in found]), WHOLE.decode(frames).raw)
    assert device.stats.bytes_skipped == 5 * len(frames)


def test_a_frame_is_out_when_the_line_falls_silent(line: Port) -> None:
    """A false header claims more bytes than arrive, so only silence releases the frame."""
    sensor = SHAPES["shape-count"]
    frame = sensor.example("data", seed=3)
    prefix = b"\xaa\x55\x20"
    with ls.open(f"serial://{line.name}", sensor) as device:
        decoder = sensor.decoder()
        assert not decoder.feed(prefix + frame)
        line.send(prefix + frame)
        assert len(packets(device, 1)[0]) == 1
        assert device.stats.pending == 0


def test_a_pause_inside_a_frame_costs_it_on_a_line_and_not_over_tcp(
    line: Port, tmp_path: Path
) -> None:
    """TCP delivers every byte, if only after a retransmission of 0.2 s or more.

    Bytes lost by a serial port never arrive.
    """
    first, second = turning(TURNING, 2)
    recorded = tmp_path / "turn.lsr"
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        ls.open(
            f"tcp://127.0.0.1:{server.getsockname()[1]}", TURNING, start=False, record=recorded
        ) as device,
        server.accept()[0] as peer,
    ):
        _send_with_pause(peer.sendall, first, second)
        assert sum(map(len, packets(device, 2))) == 2
    with ls.open(recorded, TURNING) as again:
        assert sum(map(len, again.packets())) == 2
    with ls.open(f"serial://{line.name}", TURNING, start=False) as device:
        _send_with_pause(line.send, first, second)
        assert sum(map(len, packets(device, 1))) == 1
        assert device.stats.bytes_skipped == len(first)


def _send_with_pause(send: Callable[[bytes], object], first: bytes, second: bytes) -> None:
    """Send two frames, with a pause in the first."""
    send(first[:5])
    time.sleep(0.4)
    send(first[5:] + second)


@pytest.mark.usefixtures("impatient")
def test_silence_is_a_state_and_a_warning_until_data_come(line: Port) -> None:
    with ls.open(f"serial://{line.name}", TURNING) as device:
        until(lambda: device.state == "silent")
        (warning,) = device.warnings
        assert warning.endswith(f"next: lidarspec doctor serial://{line.name} -s {TURNING.id}")
        with working(lambda stop: send_paced(line.send, turning(TURNING, 40), 100, stop) and None):
            read_until(device, lambda: device.state == "streaming")


@pytest.mark.usefixtures("impatient")
def test_bytes_without_frames_name_the_baud_rate(line: Port) -> None:
    noise = np.random.default_rng(1).integers(0, 256, 2000, np.uint8).tobytes()
    with (
        ls.open(f"serial://{line.name}?baud=9600", TURNING) as device,
        working(lambda stop: send_paced(line.offer, [noise[:20]], 50, stop) and None),
    ):
        read_until(device, lambda: device.state == "no frames")
        (warning,) = device.warnings
        assert "9600" in warning
        assert warning.endswith(f"next: lidarspec detect serial://{line.name}")


def test_latest_passes_over_all_scans_but_the_newest(line: Port) -> None:
    frames = turning(TURNING, 430)
    whole = [scan.stamp_ns for scan in TURNING.scans(b"".join(frames)) if scan.whole]
    sent, found = 0, []
    with ls.open(f"serial://{line.name}", TURNING) as device:
        for last in (170, 430):
            part = b"".join(frames[sent:last])
            line.send(part)
            sent = last
            wait_for_bytes(device, len(part))
            found.append(device.latest(TIMEOUT_S).stamp_ns)
    assert found == [whole[2], whole[-1]]


def test_a_slow_consumer_loses_the_oldest_and_knows_it(line: Port) -> None:
    frames = turning(WHOLE, 50)
    number = free_port()
    with ls.open(f"udp://127.0.0.1:{number}", WHOLE) as device, udp() as sender:
        device._input.queue._max_chunks = 30  # type: ignore[union-attr]
        for frame in frames:
            sender.sendto(frame, ("127.0.0.1", number))
        queue = device._input.queue  # type: ignore[union-attr]
        wait_for_chunks(device, 50)
        batch = packets(device, 30)
        found = np.concatenate([one.raw for one in batch])
        assert np.array_equal(found, WHOLE.decode(frames[20:]).raw)
        assert batch[0].breaks[0]
        assert device.stats.queue_dropped == 20
        assert queue.produced == queue.consumed + queue.dropped + len(queue)


def test_a_blocking_queue_loses_nothing(line: Port) -> None:
    frames = turning(TURNING, 60)
    with ls.open(f"serial://{line.name}", TURNING, overflow="block") as device:
        device._input.queue._max_bytes = 64  # type: ignore[union-attr]
        for frame in frames:
            line.send(frame)
        assert sum(map(len, packets(device, 60))) == 60
        assert device.stats.queue_dropped == 0


def test_an_exception_of_the_capture_thread_ends_the_source(line: Port) -> None:
    class Forgetful:
        error = None

        def write(self, chunk: Chunk, direction: str = "in") -> None:
            raise UsageError("no room for that")

        def event(self, name: str, at: int | None = None, **details: object) -> None: ...

        def close(self) -> None: ...

    with ls.open(f"serial://{line.name}", TURNING, record=lambda opened: Forgetful()) as device:
        line.send(b"1")
        for _ in range(2):
            with pytest.raises(SourceError, match="no room for that"):
                packets(device, 1)


def test_an_unknown_policy_is_refused(line: Port) -> None:
    with pytest.raises(UsageError, match="drop_oldest or block"):
        ls.open(f"serial://{line.name}", TURNING, overflow="forget")
    ls.open(f"serial://{line.name}", TURNING).close()


def points(batches: list[ls.Packets]) -> np.ndarray:
    return np.concatenate([batch.points().xyz for batch in batches])


#: a calibration that no sensor of these tests has.
TILTED = WHOLE.build("info", elevation=[20.0, 21.0, 22.0])


def test_other_senders_change_no_cloud(tmp_path: Path) -> None:
    number, frames, recording = free_port(), turning(WHOLE, 60), tmp_path / "all.lsr"
    calibration = WHOLE.build("info", elevation=[1.0, 2.0, 3.0])
    with (
        udp("127.0.0.2") as own,
        udp("127.0.0.3") as other,
        ls.open(f"udp://:{number}", WHOLE, record=recording) as device,
    ):
        other.sendto(TILTED, ("127.0.0.1", number))  # before anybody knows who the sensor is
        read_until(device, lambda: device.stats.frames)
        for frame in [frames[0], calibration, *frames[1:30]]:
            own.sendto(frame, ("127.0.0.1", number))
        found = packets(device, 30)
        for index in range(30, 60):
            for stranger in (TILTED, frames[index], frames[5], b"rubbish"):
                other.sendto(stranger, ("127.0.0.1", number))
            own.sendto(frames[index], ("127.0.0.1", number))
        found += packets(device, 30)
        # The nominal calibration is used, not that of another sensor.
        first = WHOLE.decode(frames[:1]).points().xyz
        assert np.array_equal(
            points(found),
            np.concatenate([first, WHOLE.decode([calibration, *frames[1:]]).points().xyz]),
        )
        assert device.stats.lost == device.stats.duplicates == 0
        read_until(device, lambda: device.stats.foreign == 120)
        (said,) = (warning for warning in device.warnings if "and ignoring data from" in warning)
        senders = [":".join(map(str, each.getsockname())) for each in (own, other)]
        assert (
            f"udp://:{number}: reading data from {senders[0]}, and ignoring data from {senders[1]}"
            in said
        )
        assert f"'udp://:{number}?src={senders[1]}'" in said
    with Recording(recording) as read:
        assert sum(record.direction == "in" for record in read) == 61 + 121


@pytest.mark.usefixtures("impatient")
def test_only_the_named_sender_is_read() -> None:
    number, frames = free_port(), turning(WHOLE, 4)
    with (
        udp("127.0.0.2") as other,
        udp("127.0.0.3") as own,
        ls.open(f"udp://:{number}?src=127.0.0.3", WHOLE) as device,
    ):
        for frame in frames:
            other.sendto(frame, ("127.0.0.1", number))
        read_until(device, lambda: device.stats.foreign == 4)
        read_until(device, lambda: device.state == "silent")
        said, stranger = device.warnings[-1], other.getsockname()[1]
        assert "no data received from the sensor for " in said
        assert (
            f" s, but 4 datagrams from other senders, such as 127.0.0.2:{stranger}; next: " in said
        )
        for frame in frames:
            own.sendto(frame, ("127.0.0.1", number))
        packets(device, 4)
        assert device.warnings == []


@pytest.mark.usefixtures("impatient")
def test_a_silent_sensor_is_not_replaced_by_another_sender() -> None:
    number, frames = free_port(), turning(WHOLE, 4)
    with (
        udp("127.0.0.2") as own,
        udp("127.0.0.3") as other,
        ls.open(f"udp://:{number}", WHOLE) as device,
    ):
        own.sendto(frames[0], ("127.0.0.1", number))
        packets(device, 1)

        def is_silent() -> bool:
            other.sendto(frames[1], ("127.0.0.1", number))
            return device.newest(0.01) is not None or device.state == "silent"

        until(is_silent)
        assert "datagrams from other senders, such as 127.0.0.3:" in device.warnings[-1]
        assert device.stats.frames == {"data": 1}
        for frame in frames[1:]:
            own.sendto(frame, ("127.0.0.1", number))
        packets(device, 3)
        assert device.state == "streaming"


def test_two_senders_of_one_address_are_separated_by_port() -> None:
    number, frames = free_port(), turning(WHOLE, 30)
    with (
        udp("127.0.0.2") as own,
        udp("127.0.0.2") as other,
        ls.open(f"udp://:{number}", WHOLE) as device,
    ):
        own.sendto(frames[0], ("127.0.0.1", number))
        packets(device, 1)
        for frame in frames[1:]:
            other.sendto(frames[5], ("127.0.0.1", number))
            own.sendto(frame, ("127.0.0.1", number))
        found = packets(device, 29)
        # The first foreign packet may count as that of a restarted sensor.
        read_until(device, lambda: device.stats.foreign >= 28)
        assert sum(map(len, found)) <= 30
        assert f"ignoring data from 127.0.0.2:{other.getsockname()[1]};" in device.warnings[-1]


def test_a_sensor_that_returns_with_another_port_is_read() -> None:
    number, frames = free_port(), turning(WHOLE, 4)
    with ls.open(f"udp://:{number}", WHOLE) as device:
        for _ in range(3):
            with udp("127.0.0.2") as one:
                for frame in frames:
                    one.sendto(frame, ("127.0.0.1", number))
                packets(device, 4)


def test_a_stream_in_datagrams_of_two_ports_is_not_joined() -> None:
    sensor = dataclasses.replace(TURNING, links={"data": Udp(7009, stream=True)})
    number, frames = free_port(), turning(sensor, 12)
    with (
        ls.open(f"udp://:{number}", sensor) as device,
        udp("127.0.0.2") as one,
        udp("127.0.0.2") as two,
    ):
        for frame in frames:
            for each in (one, two):
                each.sendto(frame, ("127.0.0.1", number))
        assert sum(map(len, packets(device, 12))) <= 13
        read_until(device, lambda: device.stats.foreign >= 11)


def test_a_stream_in_datagrams_is_joined_by_sender(monkeypatch: pytest.MonkeyPatch) -> None:
    # The sender may be held up between two pieces of a frame.
    monkeypatch.setattr(UdpTransport, "silence", TIMEOUT_S)
    sensor = dataclasses.replace(TURNING, links={"data": Udp(7009, stream=True)})
    number, frames = free_port(), turning(sensor, 12)
    stream = b"".join(frames)
    with (
        ls.open(f"udp://:{number}", sensor) as device,
        udp("127.0.0.2") as one,
        udp("127.0.0.3") as two,
    ):
        for start in range(0, len(stream), 7):
            one.sendto(stream[start : start + 7], ("127.0.0.1", number))
            two.sendto(b"\xaa\xbb", ("127.0.0.1", number))
        found = packets(device, 12)
        assert np.array_equal(
            np.concatenate([batch.raw for batch in found]), sensor.decode(stream).raw
        )
        assert device.stats.foreign == -(-len(stream) // 7)
        for frame in frames:
            two.sendto(frame, ("127.0.0.1", number))
        read_until(device, lambda: device.stats.foreign == -(-len(stream) // 7) + 12)
        assert device.stats.frames == {"data": 12}


@pytest.mark.parametrize("cycles", [3, pytest.param(100, marks=pytest.mark.soak)])
def test_unplugged_and_plugged_in_again(line: Port, cycles: int) -> None:
    frames = turning(TURNING, 10)
    half = len(frames[0]) // 2
    threads = threading.active_count()
    with ls.open(f"serial://{line.name}", TURNING) as device:
        for frame in frames:
            line.send(frame)
        packets(device, 10)
        descriptors = len(os.listdir("/dev/fd"))
        for cycle in range(cycles):
            line.send(frames[0][:half])
            read_until(device, lambda: device.stats.pending == half)
            line.unplug()
            read_until(device, lambda: device.state == "disconnected")
            assert any("waiting for it to return" in warning for warning in device.warnings)
            line.plug()
            read_until(device, lambda: device.state != "disconnected")
            line.send(frames[0][half:] + b"".join(frames[1:]))
            batch = packets(device, 9)
            assert sum(map(len, batch)) == 9, "no frame is spliced over the gap"
            assert batch[0].breaks[0]
            assert device.stats.disconnects == cycle + 1
        assert device.stats.frames == {"data": 10 + 9 * cycles}
        assert threading.active_count() == threads + 1
        assert len(os.listdir("/dev/fd")) == descriptors
    assert threading.active_count() == threads


def test_an_absent_device_is_looked_for_less_and_less_often(
    line: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = list[float]()
    reopen = SerialTransport.reopen

    def counted(transport: SerialTransport) -> None:
        tries.append(time.monotonic())
        reopen(transport)

    monkeypatch.setattr(SerialTransport, "reopen", counted)
    with ls.open(f"serial://{line.name}", TURNING) as device:
        line.unplug()
        until(lambda: len(tries) == 6)
        assert device.state == "disconnected"
        line.plug()
    assert tries[5] - tries[0] > 0.75  # after pauses of 0.04, 0.08, 0.16, 0.25 and 0.25 s


def test_a_scan_does_not_go_on_over_an_interruption(line: Port) -> None:
    frames = turning(TURNING, 180)
    with ls.open(f"serial://{line.name}", TURNING) as device:
        line.send(b"".join(frames[:90]))
        scans = device.scans(wait=0.2)
        before = list(iter(lambda: next(scans), None))
        line.unplug()
        line.plug()
        until(lambda: device.stats.disconnects == 1 and device.state != "disconnected")
        line.send(b"".join(frames[90:]))
        after = list(iter(lambda: next(scans), None))
    assert len(before) >= 2
    assert not after[0].complete, "the piece before the gap"
    assert not after[1].complete, "the piece after the gap"


def test_everything_is_recorded_before_the_queue(line: Port, tmp_path: Path) -> None:
    frames = turning(TURNING, 30)
    path = tmp_path / "all.lsr"
    with ls.open(f"serial://{line.name}", TURNING, record=path) as device:
        device._input.queue._max_chunks = 1  # type: ignore[union-attr]
        for number, frame in enumerate(frames):
            line.send(frame)
            wait_for_chunks(device, number + 1)
        until(
            lambda: (
                device._own_recorders and device._own_recorders[0].bytes == sum(map(len, frames))
            )
        )
        assert device.stats.queue_dropped == device._input.queue.produced - 1 > 0  # type: ignore[union-attr]
    with Recording(path) as recording:
        assert b"".join(
            record.data for record in recording if record.direction == "in"
        ) == b"".join(frames)
        assert recording.header.sensor == TURNING.id
        assert recording.header.baud == 115_200


def test_a_recording_knows_where_the_line_was_interrupted(line: Port, tmp_path: Path) -> None:
    frames, path = turning(TURNING, 20), tmp_path / "all.lsr"
    with ls.open(f"serial://{line.name}", TURNING, record=path) as device:
        line.send(b"".join(frames[:10]) + frames[10][:6])
        live = packets(device, 10)
        line.unplug()
        read_until(device, lambda: device.state == "disconnected")
        line.plug()
        read_until(device, lambda: device.state != "disconnected")
        line.send(frames[10][6:] + b"".join(frames[11:]))
        live += packets(device, 9)
    with Recording(path) as recording:
        found = list(recording)
    assert [record.gap for record in found if record.direction == "in"].count(True) == 1
    assert [b"disconnect" in record.data for record in found if record.direction == "event"] == [
        True,
        False,
    ]
    with ls.open(path, TURNING) as again:
        replayed = list(again.packets())
        assert again.stats.disconnects == 1
    for name in ("raw", "host_ns", "breaks"):
        assert np.array_equal(
            *(
                np.concatenate([getattr(batch, name) for batch in batches])
                for batches in (live, replayed)
            )
        ), name


def test_a_file_is_not_recorded(tmp_path: Path) -> None:
    path = tmp_path / "raw.bin"
    path.write_bytes(b"".join(turning(TURNING, 3)))
    with pytest.raises(UsageError, match="cannot be recorded"):
        ls.open(path, TURNING, record=tmp_path / "more.lsr")
    assert not (tmp_path / "more.lsr").exists()


@pytest.mark.parametrize("number", [5, 300])
def test_frames_of_another_sensor_are_a_warning(tmp_path: Path, number: int) -> None:
    path = tmp_path / "vlp16.bin"
    path.write_bytes(b"".join(ls.simulate(ls.sensor("velodyne-vlp16"), number)))
    with ls.open(path, "velodyne-hdl32e") as device:
        assert list(device.scans())
        (warning,) = (warning for warning in device.warnings if "decoded as" in warning)
        assert (
            f"{path}: decoded as velodyne-hdl32e, but the frames are those of velodyne-vlp16 ("
            in warning
        )
        assert f"next: lidarspec detect {path}" in warning
    with ls.open(path, "velodyne-vlp16") as device:
        assert list(device.scans())
        assert not any("decoded as" in warning for warning in device.warnings)


def test_live_frames_of_another_sensor_are_a_warning() -> None:
    with virtual_port("ldrobot-stl27l") as made, ls.open(made.path, "ldrobot-ld06") as device:
        for _ in zip(range(3), device.scans(), strict=False):
            pass
        assert any("those of ldrobot-stl27l" in warning for warning in device.warnings)


def test_a_nominal_calibration_is_one_warning_with_a_command(
    tmp_path: Path,
) -> None:
    path, angles = tmp_path / "xt32.bin", tmp_path / "angles.csv"
    path.write_bytes(b"".join(ls.simulate(ls.sensor("hesai-xt32"), 300)))
    rows = (f"{channel + 1},{15 - channel},0.1" for channel in range(32))
    angles.write_text("\n".join(["Channel,Elevation,Azimuth", *rows]), encoding="utf-8")
    with ls.open(path, "hesai-xt32") as device:
        assert all("nominal calibration" in repr(scan) for scan in device.scans())
        (warning,) = device.warnings
        expected = "with -s hesai-xt32 -O calibration=FILE, or in Python sensor.configure(cal"
        assert expected in warning
    with ls.open(path, ls.sensor("hesai-xt32").configure(calibration=angles)) as device:
        assert not any("nominal" in repr(scan) for scan in device.scans())
        assert device.warnings == []
    path.write_bytes(b"".join(ls.simulate(ls.sensor("robosense-helios16p"), 300)))
    with ls.open(path, "robosense-helios16p") as device:
        assert list(device.scans())
        assert "difop" in device.warnings[0]


def test_a_file_without_a_frame_of_the_sensor_says_so(tmp_path: Path) -> None:
    path = tmp_path / "vlp16.bin"
    path.write_bytes(b"".join(ls.simulate(ls.sensor("velodyne-vlp16"), 5)))
    with ls.open(path, "robosense-m1") as device:
        assert list(device.scans()) == []
        assert device.warnings == [
            f"{path}: no data frame of robosense-m1 in 6030 bytes; next: lidarspec detect {path}"
        ]


def test_a_file_gives_one_scan_after_another(tmp_path: Path) -> None:
    path = tmp_path / "raw.bin"
    path.write_bytes(b"".join(turning(TURNING, 100)))
    with ls.open(path, TURNING) as device:
        whole = [scan for scan in device.scans() if scan.complete]
    with ls.open(path, TURNING) as device:
        assert [device.latest().stamp_ns for _ in whole] == [scan.stamp_ns for scan in whole]
        with pytest.raises(SourceError, match="no more scans, because the input is ended"):
            device.latest()


def test_iterators_continue_after_latest(tmp_path: Path) -> None:
    path = tmp_path / "raw.bin"
    frames = turning(TURNING, 200)
    path.write_bytes(b"".join(frames))
    with ls.open(path, TURNING) as device:
        times = [scan.stamp_ns for scan in device.scans()]
    with ls.open(path, TURNING) as device:
        first, second = device.latest(), device.latest()
        assert times[1:3] == [first.stamp_ns, second.stamp_ns]
        (packets,) = device.packets()
        assert len(packets) == len(frames)
        assert device.stats.frames["data"] == len(frames)
        assert (device.stats.duplicates, device.stats.lost) == (0, 0)
        for read_again in (device.packets, device.scans):
            with pytest.raises(SourceError, match="has been read to its end: open it again"):
                next(read_again())
    with ls.open(path, TURNING) as device:
        device.latest()
        assert [scan.stamp_ns for scan in device.scans()] == times
    with ls.open(path, TURNING) as device:
        device.latest()
        assert sum(len(packets) for packets in device.packets("data")) == len(frames)


def test_a_second_iterator_continues_in_a_long_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lidarspec.transports.files, "BLOCK_BYTES", 1 << 13)
    monkeypatch.setattr(lidarspec.device.device_input, "BATCH_BYTES", 1 << 13)
    path = tmp_path / "raw.bin"
    frames = turning(TURNING, 400) * 8
    path.write_bytes(b"".join(frames))
    with ls.open(path, TURNING) as device:
        whole = [len(packets) for packets in device.packets()]
    assert len(whole) > 2
    with ls.open(path, TURNING) as device:
        device.latest()
        assert [len(packets) for packets in device.packets()] == whole
    with ls.open(path, TURNING) as device:
        iterator = device.packets()
        assert len(next(iterator)) == whole[0]
        device.latest()
        assert [len(packets) for packets in device.packets()] == whole[1:]


def test_closing_from_another_thread_ends_the_iteration(line: Port) -> None:
    with ls.open(f"serial://{line.name}", TURNING) as device:
        timer = threading.Timer(0.2, device.close)
        timer.start()
        assert list(device.scans()) == []
        timer.join()


def test_an_unreferenced_device_releases_its_port(line: Port) -> None:
    threads = threading.active_count()
    device: ls.Device | None = ls.open(f"serial://{line.name}", TURNING)
    assert threading.active_count() == threads + 1
    assert device is not None
    device = None
    assert threading.active_count() == threads
    ls.open(f"serial://{line.name}", TURNING).close()


@pytest.mark.skipif(sys.platform != "linux", reason="counts descriptors as Linux does")
def test_a_failed_open_releases_everything(tmp_path: Path, line: Port) -> None:
    before, threads = len(os.listdir("/dev/fd")), threading.active_count()
    (tmp_path / "there.lsr").touch()
    with pytest.raises(UsageError):
        ls.open(f"serial://{line.name}", TURNING, record=tmp_path / "there.lsr")
    with pytest.raises(UsageError):
        ls.open(f"serial://{line.name}", TURNING, backend="magic")
    assert (len(os.listdir("/dev/fd")), threading.active_count()) == (before, threads)


@pytest.mark.parametrize("given", ["scans", "packets"])
def test_the_caller_has_its_turn_though_something_else_comes_all_the_time(given: str) -> None:
    """No scan ends while the rotor is blocked, and other frame types are not packets."""
    with ls.open("sim:slamtec-rplidar-a1?rotor=blocked") as device:
        came = (
            device.scans if given == "scans" else lambda wait: device.packets("health", wait=wait)
        )(wait=0.05)
        assert all(
            item is None or not len(item)
            for item in itertools.takewhile(
                lambda _: device.stats.frames.get("node", 0) < 500, came
            )
        )
        assert not next(came)
        with pytest.raises(TimeoutError, match="no scan within the timeout"):
            device.latest(0.05)


def test_a_blocked_rotor_is_reported() -> None:
    with ls.open("sim:ldrobot-ld06?rotor=blocked&rate=max") as device:
        scans = list(itertools.islice(device.scans(wait=1.0), 3))
        assert [scan is not None and scan.complete for scan in scans] == [False] * 3
        said = (
            "the angle 'azimuth' did not pass 0 within 0.4 s, so no scan was completed: is the"
            " rotor blocked?"
        )
        assert device.warnings == [f"sim:ldrobot-ld06?rotor=blocked&rate=max: {said}"]
