"""Tests of UDP, on real sockets of the loopback interface."""

from __future__ import annotations

import socket
import sys
import time

import pytest

import lidarspec as ls
from lidarspec.errors import SourceError, UsageError
from lidarspec.spec import Chunk
from lidarspec.transports.addresses import parse_origin
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.outlets import UdpLine
from lidarspec.transports.protocol import Origin, format_sender
from lidarspec.transports.udp import (
    REQUESTED_BUFFER_BYTES,
    UdpTransport,
    _order_times,
    _Socket,
    list_buffer_warnings,
)
from tests.lines import free_port, udp, until
from tests.shapes import SHAPES

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")


def open_socket(source: str, sensor: ls.Sensor | None = None) -> UdpTransport:
    made = open_transport(source, sensor)
    assert isinstance(made, UdpTransport)
    return made


def read(one: UdpTransport, number: int) -> list[Chunk]:
    found: list[Chunk] = []
    until(lambda: found.extend(one.read(0.1)) or len(found) >= number)
    return found


def test_datagrams_of_several_ports_with_their_senders_and_times() -> None:
    ports = free_port(), free_port()
    one = open_socket(f"udp://?port={ports[0]},{ports[1]}")
    with udp() as sender:
        for index, port in enumerate(ports):
            sender.sendto(bytes([index]), ("127.0.0.1", port))
        sender.sendto(b"", ("127.0.0.1", ports[0]))
        sender.sendto(bytes(65_507), ("127.0.0.1", ports[0]))
        found = read(one, 4)
        assert sorted(len(chunk.data) for chunk in found) == [0, 1, 1, 65_507]
        assert {chunk.sender for chunk in found} == {sender.getsockname()}
        assert {chunk.receiver[1] for chunk in found if chunk.receiver} == set(ports)
        assert all(abs((chunk.at or 0) - time.time_ns()) < 5e9 for chunk in found)
        assert not one.addressed
        one.accept(sender.getsockname())
        one.write(b"hello")
        assert sender.recv(16) == b"hello"
    assert one.peer() == "127.0.0.1"
    one.close()
    one.close()


def test_the_sensor_says_the_ports() -> None:
    one = open_socket("udp://127.0.0.1", SHAPES["shape-datagrams"])
    assert one.ports == (7001, 7002)
    one.close()


def test_a_host_binds_only_that_interface() -> None:
    port = free_port()
    one = open_socket(f"udp://127.0.0.1:{port}")
    with udp("127.0.0.2") as sender:
        sender.sendto(b"wrong", ("127.0.0.2", port))
        sender.sendto(b"right", ("127.0.0.1", port))
    assert [chunk.data for chunk in read(one, 1)] == [b"right"]
    one.close()


@pytest.mark.parametrize(
    ("text", "origin"),
    [
        ("10.0.0.1", Origin("10.0.0.1")),
        ("10.0.0.1:2368", Origin("10.0.0.1", 2368)),
        ("fe80::1", Origin("fe80::1")),
        ("[fe80::1]", Origin("fe80::1")),
        ("[fe80::1]:2368", Origin("fe80::1", 2368)),
    ],
)
def test_a_sender_is_an_address_or_a_port_of_it(text: str, origin: Origin) -> None:
    assert Origin.parse(text) == origin
    assert (origin.host, 2368) in origin
    assert ((origin.host, 2369) in origin) == (origin.port is None)
    assert Origin.parse(format_sender((origin.host, 7))) == Origin(origin.host, 7)


@pytest.mark.parametrize("name", ["localhost", "0:0:0:0:0:0:0:1", "[::1]:2368"])
def test_a_sender_can_be_named_in_any_notation(name: str) -> None:
    assert parse_origin(name).host in ("127.0.0.1", "::1")


@pytest.mark.parametrize(
    "source",
    [
        "udp://:{port}?src=localhots.invalid",
        "udp://:{port}?src=192.168.1",
        "udp://10.0.0.256:{port}",
        "udp://:{port}?src=%00",
    ],
)
def test_an_unknown_host_is_refused(source: str) -> None:
    with pytest.raises(
        UsageError, match=r"unknown host '(localhots.invalid|192.168.1|10.0.0.256|\\x00)'"
    ):
        open_socket(source.format(port=free_port()))


def test_data_is_sent_to_the_requested_sender_only() -> None:
    port = free_port()
    with udp("127.0.0.2") as wanted, udp("127.0.0.3") as other:
        one = open_socket(f"udp://:{port}?src=127.0.0.2:{wanted.getsockname()[1]}")
        other.sendto(b"here!", ("127.0.0.1", port))
        until(lambda: one.read(0.01) or one.foreign)
        assert one.other_sender == other.getsockname()
        one.accept(other.getsockname())
        one.write(b"hello")
        assert wanted.recv(16) == b"hello"
    one.close()


def test_an_invalid_port_is_refused() -> None:
    with pytest.raises(UsageError, match="expected ADDRESS or ADDRESS:PORT"):
        open_socket("udp://:2368?src=10.0.0.1:0")


def test_other_senders_count_as_foreign() -> None:
    port = free_port()
    one = open_socket(f"udp://:{port}?src=127.0.0.2")
    with udp("127.0.0.2") as wanted, udp("127.0.0.3") as other:
        for sender in (other, wanted, other):
            sender.sendto(sender.getsockname()[0].encode(), ("127.0.0.1", port))
        until(lambda: one.foreign == 2 or one.read(0.01) or True)
        time.sleep(0.05)
        one.read(0.0)
    assert one.foreign == 2
    assert one.peer() == "127.0.0.2"
    one.close()


def test_without_recvmmsg_datagrams_come_one_by_one() -> None:
    with udp() as sender, udp() as receiver:
        receiver.setblocking(False)
        one = _Socket(receiver, None)
        assert list(one.iter_datagrams(7, 0)) == []
        for data in (b"a", b"", bytes(65_507)):
            sender.sendto(data, receiver.getsockname())
        assert list(one.iter_datagrams(7, 0)) == [
            (data, sender.getsockname(), 7) for data in (b"a", b"", bytes(65_507))
        ]


@LINUX
def test_many_datagrams_in_one_call() -> None:
    number = free_port()
    one = open_socket(f"udp://127.0.0.1:{number}")
    with udp() as sender, udp("127.0.0.2") as other:
        sent = [bytes([index % 256]) * (index % 1400) for index in range(700)]
        for index, data in enumerate(sent):
            (sender if index % 3 else other).sendto(data, ("127.0.0.1", number))
        found = read(one, 700)
        assert [chunk.data for chunk in found] == sent
        assert [chunk.sender for chunk in found] == [
            (sender if index % 3 else other).getsockname() for index in range(700)
        ]
    assert [chunk.at for chunk in found] == sorted(chunk.at or 0 for chunk in found)
    one.close()


@LINUX
def test_the_kernel_says_when_a_datagram_came() -> None:
    port = free_port()
    one = open_socket(f"udp://127.0.0.1:{port}")
    with udp() as sender:

        def waited() -> int:
            """Return the ns between the kernel's time of a datagram and its reading."""
            sender.sendto(b"early", ("127.0.0.1", port))
            time.sleep(0.5)
            (chunk,) = one.read(1.0)
            return one.clock.now() - (chunk.at or 0)

        # A busy kernel begins to note times only a while after the first socket has asked for them.
        assert any(waited() >= 400_000_000 for _ in range(20))
    one.close()


def test_the_times_of_both_clocks_are_of_one_moment_though_the_thread_is_held_up() -> None:
    pauses = iter([0.0, 0.05, 0.05, 0.0])

    def read_wall_clock() -> int:
        time.sleep(next(pauses, 0.0))
        return time.time_ns()

    clock = HostClock(read_wall_clock)
    now, wall = clock.now_and_wall()
    later, later_wall = HostClock().now_and_wall()
    assert abs((later_wall - wall) - (later - now)) < 10_000_000


def test_a_datagram_arrives_no_later_than_the_one_queued_behind_it() -> None:
    times = [5, 9, 9, 7, 8, 6, 10]
    chunks = [Chunk(b"", at) for at in times]
    _order_times(chunks, 1)
    assert [chunk.at for chunk in chunks] == [5, 6, 6, 6, 6, 6, 10]


@LINUX
def test_kernel_drops_are_counted_exactly() -> None:
    port = free_port()
    one = open_socket(f"udp://127.0.0.1:{port}")
    (inner,) = one._sockets
    inner.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    with udp() as sender:
        found = 0
        for _ in range(2):
            for _ in range(100):
                sender.sendto(bytes(1000), ("127.0.0.1", port))
            found += len(read(one, 1))
            sender.sendto(b"last", ("127.0.0.1", port))
            found += len(read(one, 1))
    assert one.kernel_drops > 0
    assert found + one.kernel_drops == 202
    one.close()


def test_a_multicast_group_is_joined() -> None:
    port = free_port()
    one = open_socket(f"udp://127.0.0.1:{port}?group=239.255.77.1")
    second = open_socket(f"udp://127.0.0.1:{port}?group=239.255.77.1")
    with udp() as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        sender.sendto(b"to all", ("239.255.77.1", port))
    assert [read(each, 1)[0].data for each in (one, second)] == [b"to all", b"to all"]
    one.close()
    second.close()


def test_a_small_buffer_is_a_warning_with_a_command() -> None:
    assert list_buffer_warnings(REQUESTED_BUFFER_BYTES, REQUESTED_BUFFER_BYTES) == []
    (text,) = list_buffer_warnings(8 << 20, 212_992)
    assert text.endswith("next: sudo sysctl -w net.core.rmem_max=8388608")
    assert "208 KiB instead of 8192" in text


def test_the_buffer_is_read_back() -> None:
    one = open_socket(f"udp://127.0.0.1:{free_port()}")
    (inner,) = one._sockets
    kernel = inner.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    assert inner.buffer_bytes == kernel // (2 if sys.platform == "linux" else 1)
    assert bool(one.warnings) == (inner.buffer_bytes < REQUESTED_BUFFER_BYTES)
    one.close()


@pytest.mark.parametrize(
    ("source", "error", "text", "following"),
    [
        (
            "udp://:{busy}",
            SourceError,
            "UDP port {busy} is in use by another program",
            "lidarspec doctor udp://:{busy}",
        ),
        (
            "udp://192.0.2.1:{free}",
            SourceError,
            "192.0.2.1 is not an address of this computer",
            "lidarspec doctor udp://:{free}",
        ),
        ("udp://", UsageError, "the port is unknown", ""),
        ("udp://:2368?group=10.0.0.1", UsageError, "not a multicast group", ""),
        ("udp://?port=1,x", UsageError, "port must be one number", ""),
        ("udp://:99999", UsageError, "from 1 to 65535", ""),
        ("udp://:2368?source=10.0.0.1", UsageError, "unknown option 'source'", ""),
    ],
)
def test_a_port_that_cannot_be_opened_gives_a_reason(
    source: str, error: type[Exception], text: str, following: str
) -> None:
    with udp() as busy:
        names = {"busy": busy.getsockname()[1], "free": free_port()}
        with pytest.raises(error, match=text.format(**names)) as caught:
            open_transport(source.format(**names))
    assert not following or caught.value.__notes__ == [f"next: {following.format(**names)}"]


def test_a_datagram_that_is_too_long_for_udp_is_dropped_and_counted() -> None:
    """A patient sender waits for space, but drops what UDP can never send."""
    line = UdpLine.make_reply_line("127.0.0.1", 0)
    try:
        with udp() as reader:
            reader.sendto(b"command", ("127.0.0.1", line.port))
            until(line.receive)
            line.send([Chunk(bytes(70_000)), Chunk(b"short")], patient=True)
            assert reader.recv(100) == b"short"
        assert line.unsent_bytes == 70_000
    finally:
        line.close()
