"""The verb that lists the ports of this computer."""

from __future__ import annotations

from typing import Any

import click

from lidarspec.cli.output import emit, emit_json, note, output_options, table
from lidarspec.detection.hearing import udp_ports
from lidarspec.links import Udp
from lidarspec.plugins import sensors
from lidarspec.transports.ports import SerialPort, User, serial_ports, udp_users


@click.command()
@output_options
def ports(as_json: bool, output: str | None) -> None:
    """The serial ports of this computer, and the UDP ports that installed sensors send to."""
    serial, udp = serial_ports(), {port: udp_users(port) for port in udp_ports()}
    if as_json:
        emit_json({"serial": [_serial(port) for port in serial], "udp": [_udp(port, users) for port, users in udp.items()]}, output)
        return
    rows = [[port.path, port.description or "serial port", _state(port), port.lasting] for port in serial]
    rows += [[f"udp://:{port}", ", ".join(_senders(port)), _udp_state(users), ""] for port, users in udp.items()]
    emit(table(["port", "what it is", "state", "lasting name"], rows, output), output)
    if not serial:
        note("there is no serial port; one that should be here: is it plugged in?")
    note(f"next: lidarspec detect{f' {serial[0].path}' if len(serial) == 1 else ''}")


def _senders(port: int) -> list[str]:
    """The installed sensors whose data come to a UDP port."""
    found = []
    for sensor in sensors().values():
        link = sensor.links.get("data")
        if isinstance(link, Udp) and port in link.ports:
            found.append(sensor.id)
    return found


def _state(port: SerialPort) -> str:
    if not port.allowed:
        return "no permission: lidarspec doctor"
    return f"in use by {', '.join(map(str, port.users))}" if port.users else "free"


def _udp_state(users: tuple[User, ...] | None) -> str:
    if users is None:
        return "free"
    return f"in use by {', '.join(map(str, users)) or 'another user'}"


def _serial(port: SerialPort) -> dict[str, Any]:
    return {**vars(port), "users": [vars(user) for user in port.users]}


def _udp(port: int, users: tuple[User, ...] | None) -> dict[str, Any]:
    return {"port": port, "sensors": _senders(port), "free": users is None, "users": [vars(user) for user in users or ()]}
