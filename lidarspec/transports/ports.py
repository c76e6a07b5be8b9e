"""List the ports of this computer, their permissions, and the programs that use them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

try:
    import grp
except ImportError:  # no POSIX
    grp = None  # type: ignore[assignment]

_PROCESSES = Path("/proc")
#: files of Linux with the tables of open UDP sockets.
_UDP_TABLES = ("/proc/net/udp", "/proc/net/udp6")


@dataclass(frozen=True)
class SerialPort:
    """A serial port.

    Attributes:
        path: the name of the port, such as "/dev/ttyUSB0" or "COM4".
        lasting: a path of the port that stays the same if the device is plugged into another USB
            socket; "" if there is none.
        allowed: whether the person who runs lidarspec may open the port.
        users: the programs that have opened the port, if the system shows them.
    """

    path: str
    description: str
    lasting: str
    allowed: bool
    users: tuple[PortUser, ...]


@dataclass(frozen=True)
class PortUser:
    """A program that has opened a port."""

    pid: int
    name: str

    def __str__(self) -> str:
        return f"{self.name} (process {self.pid})"


def list_serial_ports() -> list[SerialPort]:
    """Return the serial ports of this computer, sorted by name."""
    ports = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        if port.description not in (None, "n/a"):
            description = port.description
        else:
            description = ""
        if port.manufacturer:
            maker = f" by {port.manufacturer}"
        else:
            maker = ""
        path = port.device
        ports.append(
            SerialPort(
                path,
                f"{description}{maker}".strip(),
                find_lasting_path(path),
                can_open(path),
                find_users(path),
            )
        )
    return ports


def list_usb_ids() -> list[tuple[int, int]]:
    """Return the (vendor id, product id) of each USB serial port of this computer."""
    return [(port.vid, port.pid) for port in list_ports.comports() if port.vid is not None]


def find_lasting_path(port: str) -> str:
    """Return the path of a port in /dev/serial/by-id; "" if it has none."""
    links = sorted(Path("/dev/serial/by-id").glob("*"))
    return next(
        (str(link) for link in links if os.path.realpath(link) == os.path.realpath(port)), ""
    )


def can_open(port: str) -> bool:
    """Return whether the user may open a port; True if the port is no file, as on Windows."""
    effective = os.access in os.supports_effective_ids
    return not os.path.exists(port) or os.access(port, os.R_OK | os.W_OK, effective_ids=effective)


def find_group(port: str) -> str:
    """Return the name of the user group that may open a port.

    Returns "" if no group other than root's may open the port, or if the group has no name.
    """
    with contextlib.suppress(OSError, KeyError):
        status = os.stat(port)
        if grp is not None and status.st_mode & 0o060 == 0o060 and status.st_gid:
            return grp.getgrgid(status.st_gid).gr_name
    return ""


def find_users(port: str) -> tuple[PortUser, ...]:
    """Return the other programs that have opened a serial port.

    Without root permissions, only programs of the same user are visible.
    """
    path = os.path.realpath(port)
    if os.path.exists(path):
        return tuple(
            sorted(set(_find_holders(lambda target: target == path)), key=lambda user: user.pid)
        )
    return ()


def find_udp_users(port: int) -> tuple[PortUser, ...] | None:
    """Return the other programs that have opened a UDP port.

    Returns:
        None if the port is free; an empty tuple if a program of another user has opened it.
    """
    inodes = set()
    for table in _UDP_TABLES:
        with contextlib.suppress(OSError, ValueError, IndexError):
            for line in Path(table).read_text(encoding="ascii").splitlines()[1:]:
                columns = line.split()
                if int(columns[1].rpartition(":")[2], 16) == port:
                    inodes.add(f"socket:[{columns[9]}]")
    if inodes:
        return tuple(sorted(set(_find_holders(inodes.__contains__)), key=lambda user: user.pid))
    return None


def _find_holders(wanted: Callable[[str], bool]) -> Iterator[PortUser]:
    """Yield other programs that have opened a file whose path `wanted` accepts."""
    for process in _PROCESSES.glob("[0-9]*") if _PROCESSES.is_dir() else ():
        if int(process.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if any(wanted(target) for target in _read_links(process / "fd")):
                yield PortUser(
                    int(process.name), (process / "comm").read_text(encoding="utf-8").strip()
                )


def _read_links(folder: Path) -> Iterator[str]:
    """Yield the paths of the open files of a process, given its folder in /proc."""
    for name in os.listdir(folder):
        with contextlib.suppress(OSError):
            yield os.readlink(folder / name)


def count_received_packets() -> dict[str, int]:
    """Return the number of packets that each network interface has received.

    Returns:
        Name of the interface -> number; empty if the system does not report it.
    """
    received = {}
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/net/dev").read_text(encoding="ascii").splitlines()[2:]:
            name, _, counts = line.partition(":")
            received[name.strip()] = int(counts.split()[1])
    return received


def filters_senders(interface: str) -> bool:
    """Return whether an interface drops packets from senders in other networks."""
    with contextlib.suppress(OSError):
        values = [
            Path(f"/proc/sys/net/ipv4/conf/{name}/rp_filter").read_text(encoding="ascii").strip()
            for name in ("all", interface)
        ]
        return max(values) == "1"
    return False
