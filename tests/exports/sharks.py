"""Run tshark on a capture with exported dissectors."""

from __future__ import annotations

import functools
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import pytest

from lidarspec import Sensor
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import USER_LINKS, Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head, make_packet_record
from lidarspec.exports import export
from lidarspec.spec import Udp

TSHARK = shutil.which("tshark")
_needs_tshark = pytest.mark.skipif(TSHARK is None, reason="tshark is not installed")


def needs_tshark(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that runs tshark: left to `make test-all`, and skipped if tshark is not
    installed.
    """
    return pytest.mark.slow(_needs_tshark(test))  # type: ignore[no-any-return]


def tshark(capture: Path, *arguments: str, scripts: Iterable[Path] = ()) -> str:
    """Run tshark; return its output. Warnings other than about root are failures."""
    assert TSHARK is not None
    loaded = [option for script in scripts for option in ("-X", f"lua_script:{script}")]
    done = subprocess.run(
        [TSHARK, *loaded, "-r", capture, *arguments], check=False, capture_output=True, text=True
    )
    complaints = [
        line for line in done.stderr.splitlines() if line.strip() and "Running as user" not in line
    ]
    assert not done.returncode and not complaints, "\n".join(complaints)[:2000]  # noqa: PT018
    return done.stdout


def columns(
    capture: Path, script: Path, names: Sequence[str], *arguments: str
) -> Iterator[list[list[str]]]:
    """Yield the values of the named fields of each packet, in order of appearance."""
    wanted = [option for name in names for option in ("-e", name)]
    printed = tshark(
        capture,
        "-T",
        "fields",
        "-E",
        "separator=/t",
        "-E",
        "aggregator=;",
        *wanted,
        *arguments,
        scripts=[script],
    )
    for line in printed.splitlines():
        yield [column.split(";") if column else [] for column in line.split("\t")]


@functools.cache
def dissector(sensor: Sensor) -> str:
    """Return the dissector of a sensor, from a cache."""
    return export(sensor, "wireshark")


def write_dissector(sensor: Sensor, folder: Path) -> Path:
    """Write the dissector of a sensor to a file; return its path."""
    script = folder / f"{sensor.id}.lua"
    script.write_text(dissector(sensor))
    return script


def write_capture(sensor: Sensor, frames: Iterable[bytes], path: Path) -> Path:
    """Write a capture of these frames, one a packet, for the sensor's data link."""
    link = sensor.links["data"]
    with path.open("wb") as file:
        file.write(make_capture_head(ETHERNET if sensor.datagrams else USER_LINKS[0]))
        for number, frame in enumerate(frames):
            if isinstance(link, Udp) and sensor.datagrams:
                port = link.ports[0] if link.ports else 9
                file.write(
                    make_datagram_record(
                        Datagram(
                            frame, number * 1_000_000, ("192.0.2.1", port), ("192.0.2.2", port)
                        )
                    )
                )
            else:
                file.write(make_packet_record(frame, number * 1_000_000))
    return path
