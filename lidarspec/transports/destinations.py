"""Make outlets from destinations: "pty", "udp://HOST:PORT" and "tcp://HOST:PORT"."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

from lidarspec.errors import SourceError, UsageError
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Http, Link, Tcp, Udp
from lidarspec.transports.addresses import SourceAddress
from lidarspec.transports.outlets import LOCALHOST, Outlet, OutletLine, PtyLine, TcpLine, UdpLine


def make_simulated_outlet(
    sensor: Sensor, destination: str, link: str | Path | None = None
) -> Outlet:
    """Return the outlet of a simulated sensor.

    The outlet has a line for each link over which the sensor sends data or receives commands.

    Args:
        destination: "pty", "udp://HOST:PORT" or "tcp://HOST:PORT". TCP port 0 selects any free
            port. Without a UDP port, data frames are sent to the first port that the sensor
            declares, and all other frames to the second.
        link: path of a symbolic link to the pseudo-terminal; None for no link.

    Raises:
        UsageError: if the destination is invalid, or cannot transmit the sensor's frames.
        SourceError: if the destination is not available.
    """
    data = _make_data_line(sensor, destination, link)
    return Outlet(data, _make_control_lines(sensor))


def make_replay_outlet(destination: str, *, datagrams: bool, port: int = 0) -> Outlet:
    """Return the outlet of a replay.

    Args:
        destination: "pty", "udp://HOST:PORT" or "tcp://HOST:PORT". TCP port 0 selects any free
            port. Without a UDP port, each datagram is sent to the recorded port.
        port: the port for datagrams that were recorded without a port.

    Raises:
        UsageError: if the destination is invalid, or cannot transmit the recorded data.
        SourceError: if the destination is not available.
    """
    if destination.startswith("udp:"):
        return Outlet(_make_udp_replay_line(destination, datagrams=datagrams, port=port))
    if destination != "pty" and not destination.startswith("tcp:"):
        raise UsageError(
            f"invalid destination {destination!r}: expected pty, udp://host:port, tcp://host:port"
            " or a new file"
        )
    if datagrams:
        raise UsageError(
            f"the recording contains datagrams, but {destination} is a byte stream: replay to"
            f" udp://{LOCALHOST}"
        )
    if destination == "pty":
        return Outlet(PtyLine())
    host, named_port = _parse_host_and_port(destination)
    if named_port is None:
        raise UsageError(
            f"{destination}: specify the port to listen on, as in tcp://{LOCALHOST}:2111"
        )
    return Outlet(TcpLine(host, named_port, sole=True))


def _make_udp_replay_line(destination: str, *, datagrams: bool, port: int) -> UdpLine:
    if not datagrams:
        raise UsageError(
            f"the recording contains a byte stream, but {destination} requires datagrams:"
            f" replay to pty or tcp://{LOCALHOST}:PORT"
        )
    host, named_port = _parse_host_and_port(destination)
    ports = (named_port,) if named_port else ()
    return UdpLine.to(host, ports, default_port=port)


def _make_data_line(sensor: Sensor, destination: str, link: str | Path | None) -> OutletLine:
    if destination == "pty":
        if sensor.datagrams:
            raise UsageError(
                f"{sensor.id} sends datagrams, which a serial port cannot carry: simulate to"
                f" udp://{LOCALHOST}"
            )
        return PtyLine(link)
    if not destination.startswith(("udp://", "tcp://")):
        raise UsageError(
            f"invalid destination {destination!r}: expected pty, udp://HOST:PORT,"
            " tcp://HOST:PORT, or a file (.lsr, .pcap, .pcapng, .bin)"
        )
    if link is not None:
        raise UsageError("a link is only supported for a pseudo-terminal: use --to pty")
    if destination.startswith("tcp://"):
        return _make_tcp_data_line(sensor, destination)
    return _make_udp_data_line(sensor, destination)


def _make_tcp_data_line(sensor: Sensor, destination: str) -> TcpLine:
    host, port = _parse_host_and_port(destination)
    declared = sensor.links.get("data")
    is_reported = isinstance(declared, Tcp) and bool(declared.reported)
    if port is None and isinstance(declared, Tcp):
        port = declared.port
    if port is None:
        raise UsageError(f"{sensor.id} declares no TCP port: specify one, as in tcp://{host}:2111")
    return TcpLine(host, port, is_reported=is_reported)


def _make_udp_data_line(sensor: Sensor, destination: str) -> UdpLine:
    host, port = _parse_host_and_port(destination)
    declared = sensor.links.get("data")
    if not isinstance(declared, Udp) or not sensor.datagrams:
        raise UsageError(
            f"{sensor.id} sends a byte stream, not datagrams: simulate to pty or tcp://"
        )
    ports = (port,) if port else declared.ports[:2]
    if not ports and not sensor.announces_port and not sensor.commands_over_data:
        raise UsageError(f"{sensor.id} declares no UDP port: specify one, as in udp://{host}:2368")
    line = UdpLine.to(host, ports, takes_commands=sensor.commands_over_data)
    line.waits_for_address = not ports
    return line


def _make_control_lines(sensor: Sensor) -> dict[str, OutletLine]:
    """Return a line for each link with commands, except the data link."""
    lines = {}
    for name in {command.link for command in sensor.commands.values()} - {"data"}:
        line = _make_control_line(sensor.links[name])
        if line is not None:
            lines[name] = line
    return lines


def _make_control_line(link: Link) -> OutletLine | None:
    """Return a line at the declared port or, if it is in use, at a free port."""
    for port in (_find_declared_port(link), 0):
        with contextlib.suppress(OSError, SourceError):
            if isinstance(link, Tcp):
                return TcpLine(LOCALHOST, port)
            if isinstance(link, Udp):
                return UdpLine.make_reply_line(LOCALHOST, port)
            if isinstance(link, Http):
                from lidarspec.transports.http_server import HttpLine

                return HttpLine(LOCALHOST, port)
    return None


def _find_declared_port(link: Link) -> int:
    """Return the port at which a sensor receives commands; 0 if it declares none."""
    if isinstance(link, Tcp | Http):
        return link.port
    if isinstance(link, Udp):
        if link.ports:
            return link.ports[0]
        return link.broadcast
    return 0


def _parse_host_and_port(destination: str) -> tuple[str, int | None]:
    """Return host and port of a destination.

    The default host is this computer. The port is None if it is omitted.
    """
    address = SourceAddress.parse(destination)
    address.check(())
    if address.scheme == "tcp" and address.location.endswith(":0"):
        host, _ = replace(address, location=address.location.removesuffix(":0")).host_and_port()
        return host or LOCALHOST, 0
    host, port = address.host_and_port()
    return host or LOCALHOST, port
