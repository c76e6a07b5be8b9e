"""Tests of TCP, on real connections."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from lidarspec.errors import SourceError, UsageError
from lidarspec.spec import Disconnected
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.tcp import TcpTransport
from tests.lines import until


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        yield made


def test_a_stream_is_read_written_and_connected_again(server: socket.socket) -> None:
    port = server.getsockname()[1]
    one = open_transport(f"tcp://127.0.0.1:{port}")
    assert isinstance(one, TcpTransport)
    assert one.peer() == "127.0.0.1"
    peer = server.accept()[0]
    peer.sendall(b"frames")
    assert one.read(5.0)[0].data == b"frames"
    assert one.read(0.01) == []
    one.write(b"order")
    assert peer.recv(5, socket.MSG_WAITALL) == b"order"
    peer.close()
    with pytest.raises(Disconnected, match="closed the connection"):
        until(lambda: one.read(0.1))
    one.reopen()
    peer = server.accept()[0]
    peer.sendall(b"again")
    assert one.read(5.0)[0].data == b"again"
    peer.close()
    one.close()
    one.close()
    assert one.read(0.0) == []


@pytest.mark.parametrize(
    ("source", "error", "text"),
    [
        ("tcp://127.0.0.1:{free}", SourceError, "refuses connections to TCP port"),
        ("tcp://no-such-host.invalid:2111", SourceError, "unknown host 'no-such-host.invalid'"),
        ("tcp://127.0.0.1", UsageError, "expected host and port"),
        ("tcp://:2111", UsageError, "expected host and port"),
        ("tcp://127.0.0.1:99999", UsageError, "from 1 to 65535"),
        ("tcp://127.0.0.1:1?port=3", UsageError, "unknown option 'port'"),
    ],
)
def test_a_failed_connection_gives_a_reason(
    server: socket.socket, source: str, error: type[Exception], text: str
) -> None:
    port = server.getsockname()[1]
    server.close()
    with pytest.raises(error, match=text) as caught:
        open_transport(source.format(free=port))
    assert error is UsageError or caught.value.__notes__[0].startswith(
        "next: lidarspec doctor tcp://"
    )
