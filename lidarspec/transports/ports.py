"""The serial and UDP ports of this computer: which there are, who may open them, and who has them
open.
"""

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
#: tables of the UDP sockets of this computer, and where in a line port and inode stand.
_UDP_TABLES = ("/proc/net/udp", "/proc/net/udp6")


@dataclass(frozen=True)
class SerialPort:
    """A serial port.

    Attributes:
        path: "/dev/ttyUSB0" or "COM4".
        description: what the system knows of it.
        lasting: a name that stays the same when it is plugged in elsewhere; "" where there is none.
        allowed: whether this user may open it.
        users: the programs that have it open, as far as can be seen.
    """

    path: str
    description: str
    lasting: str
    allowed: bool
    users: tuple[User, ...]


@dataclass(frozen=True)
class User:
    """A program that has a port open."""

    pid: int
    name: str

    def __str__(self) -> str:
        return f"{self.name} (process {self.pid})"


def serial_ports() -> list[SerialPort]:
    """The serial ports of this computer, by name."""
    found = []
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
        found.append(
            SerialPort(
                path, f"{description}{maker}".strip(), lasting(path), is_allowed(path), users(path)
            )
        )
    return found


def lasting(port: str) -> str:
    """The name under /dev/serial/by-id that leads to a port, "" where there is none."""
    links = sorted(Path("/dev/serial/by-id").glob("*"))
    return next(
        (str(link) for link in links if os.path.realpath(link) == os.path.realpath(port)), ""
    )


def is_allowed(port: str) -> bool:
    """Whether this user may open a port; a name that is no file is taken for one that he may."""
    effective = os.access in os.supports_effective_ids
    return not os.path.exists(port) or os.access(port, os.R_OK | os.W_OK, effective_ids=effective)


def group(port: str) -> str:
    """The group that may open a port, "" where only root may, or nobody knows."""
    with contextlib.suppress(OSError, KeyError):
        status = os.stat(port)
        if grp is not None and status.st_mode & 0o060 == 0o060 and status.st_gid:
            return grp.getgrgid(status.st_gid).gr_name
    return ""


def users(port: str) -> tuple[User, ...]:
    """The programs that have a port open, this one left out; without root's rights only one's own
    are seen.
    """
    path = os.path.realpath(port)
    if os.path.exists(path):
        return tuple(
            sorted(set(_holding(lambda target: target == path)), key=lambda user: user.pid)
        )
    return ()


def udp_users(port: int) -> tuple[User, ...] | None:
    """The programs that have a UDP port open, this one left out; None where it is free.

    Empty where it is that of a user whose programs are not to be seen.
    """
    inodes = set()
    for table in _UDP_TABLES:
        with contextlib.suppress(OSError, ValueError, IndexError):
            for line in Path(table).read_text(encoding="ascii").splitlines()[1:]:
                columns = line.split()
                if int(columns[1].rpartition(":")[2], 16) == port:
                    inodes.add(f"socket:[{columns[9]}]")
    if inodes:
        return tuple(sorted(set(_holding(inodes.__contains__)), key=lambda user: user.pid))
    return None


def _holding(wanted: Callable[[str], bool]) -> Iterator[User]:
    """The programs of which an open file leads to what is wanted."""
    for process in _PROCESSES.glob("[0-9]*") if _PROCESSES.is_dir() else ():
        if int(process.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if any(wanted(target) for target in _targets(process / "fd")):
                yield User(
                    int(process.name), (process / "comm").read_text(encoding="utf-8").strip()
                )


def _targets(folder: Path) -> Iterator[str]:
    """What the open files of a process lead to."""
    for name in os.listdir(folder):
        with contextlib.suppress(OSError):
            yield os.readlink(folder / name)


def count_received() -> dict[str, int]:
    """Packets that each network interface has received so far; empty where the system does not
    tell.
    """
    found = {}
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/net/dev").read_text(encoding="ascii").splitlines()[2:]:
            name, _, counts = line.partition(":")
            found[name.strip()] = int(counts.split()[1])
    return found


def filters_senders(interface: str) -> bool:
    """Whether the system throws away packets from addresses that it would not answer over this
    interface (strict rp_filter).
    """
    with contextlib.suppress(OSError):
        values = [
            Path(f"/proc/sys/net/ipv4/conf/{name}/rp_filter").read_text(encoding="ascii").strip()
            for name in ("all", interface)
        ]
        return max(values) == "1"
    return False
