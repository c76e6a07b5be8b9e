"""Diagnose a source without data, or without usable data.

Each finding has the command that fixes the problem.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from lidarspec.detect.identification import (
    CLEAR,
    Verdict,
    identify_sample,
    identify_senders,
    read_info,
    verb_to_show,
)
from lidarspec.detect.listen import (
    LISTEN,
    list_bauds,
    list_start_required,
    list_udp_ports,
    read_sensor_sample,
)
from lidarspec.errors import LidarSpecError, UsageError, printable, suggestion
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Serial, Udp
from lidarspec.transports import ports
from lidarspec.transports.addresses import SourceAddress, with_option
from lidarspec.transports.base import data_link
from lidarspec.transports.open_url import live_address, resolve
from lidarspec.transports.protocol import no_bytes
from lidarspec.transports.udp import REQUESTED_BUFFER_BYTES, warn_of_small_buffer

LOOPBACK = "lo"


@dataclass(frozen=True)
class Diagnosis:
    """The result of one check.

    Attributes:
        ok: whether there is no problem.
        text: a description.
        fix: the command that fixes it; "" if there is none, or no problem.
    """

    ok: bool
    text: str
    fix: str = ""


def examine(
    source: str | Path, sensor: Sensor | None = None, *, seconds: float = LISTEN
) -> Iterator[Diagnosis]:
    """Check a source, and yield findings in the order of the checks.

    Args:
        sensor: the expected sensor; by default it is detected.
        seconds: time to listen.
    """
    text = resolve(source)
    address = live_address(text)
    if address is None:
        yield from _file(text, sensor)
    elif address.scheme == "serial":
        yield from _serial(text, address, sensor, seconds)
    elif address.scheme == "udp":
        yield from _udp(text, address, sensor, seconds)
    else:
        yield from _examine_bytes(text, sensor, seconds)


def examine_computer() -> Iterator[Diagnosis]:
    """Check the ports of this computer, whatever is connected to them."""
    serial_ports = ports.list_serial_ports()
    if not serial_ports:
        yield Diagnosis(
            True,
            "no serial port found: check the cable and the driver",
            "sudo dmesg | tail",
        )
    for port in serial_ports:
        yield from _permission(port.path)
        yield from _in_use(port.path)
    for number in list_udp_ports():
        yield from _port_in_use(number)
    yield from _buffer()


def _file(path: str, sensor: Sensor | None) -> Iterator[Diagnosis]:
    if os.path.exists(path):
        name = path
    else:
        name = path.rpartition("?")[0]  # the option after it selects a sender
    if not os.path.exists(name):
        yield Diagnosis(False, f"{path}: no such file or port", "lidarspec ports")
    elif not os.access(name, os.R_OK):
        yield Diagnosis(False, f"{path}: no permission to read it", f"sudo chmod a+r {path}")
    elif os.path.getsize(name) == 0:
        yield Diagnosis(False, f"{path} is empty")
    else:
        found_verdicts = identify_senders(path)
        largest = max(found_verdicts, key=lambda verdict: verdict.sample.size)
        if largest.sample.size:
            yield _verdict(path, largest, sensor)
        yield from _several(path, found_verdicts)
        for text in largest.sample.warnings or [no_bytes(path, ())] * (not largest.sample.size):
            yield Diagnosis(False, text)


def _serial(
    source: str, address: SourceAddress, sensor: Sensor | None, seconds: float
) -> Iterator[Diagnosis]:
    port = address.location
    if os.name == "posix" and not os.path.exists(port):
        yield Diagnosis(
            False,
            f"{port}: no such port; check that it is plugged in, and its driver",
            "lidarspec ports",
        )
        return
    problems = [finding for finding in (*_permission(port), *_in_use(port)) if not finding.ok]
    yield from problems or [Diagnosis(True, f"{port} exists and can be opened")]
    if not problems:
        yield from _examine_bytes(source, sensor, seconds)


def _permission(port: str) -> Iterator[Diagnosis]:
    if not ports.is_allowed(port):
        group = ports.find_group(port)
        text = f"{port}: no permission to open it"
        by_group = Diagnosis(
            False,
            f"{text}; members of the group {group} have it, from their next login",
            f"sudo usermod -aG {group} $USER",
        )
        yield by_group if group else Diagnosis(False, f"{text}; only root has it", _rule(port))


def _rule(port: str) -> str:
    """Return a command for a udev rule that lets every user open such ports."""
    kind = os.path.basename(port).rstrip("0123456789")
    rule = f'KERNEL=="{kind}[0-9]*", MODE="0666"'
    return f"echo '{rule}' | sudo tee /etc/udev/rules.d/99-lidarspec.rules && sudo udevadm trigger"


def _in_use(port: str) -> Iterator[Diagnosis]:
    for user in ports.find_users(port):
        yield Diagnosis(False, f"{port} is in use by {user}", f"kill {user.pid}")


def _udp(
    source: str, address: SourceAddress, sensor: Sensor | None, seconds: float
) -> Iterator[Diagnosis]:
    numbers = _udp_numbers(address, sensor)
    host = address.host_and_port()[0]
    busy = [finding for number in numbers for finding in _port_in_use(number)]
    yield from busy
    yield from _buffer()
    if busy:
        return
    before = ports.received_per_interface()
    began = time.monotonic()
    findings = list(_examine_bytes(source, sensor, seconds))
    yield from findings
    if any("no data received" in finding.text for finding in findings):
        rates = {
            name: (count - before.get(name, count)) / (time.monotonic() - began)
            for name, count in ports.received_per_interface().items()
        }
        yield from _interfaces(numbers, host, rates)


def _udp_numbers(address: SourceAddress, sensor: Sensor | None) -> list[int]:
    port = address.host_and_port()[1]
    text = address.options.get("port", "")
    if text:
        return [int(part) for part in text.split(",") if part.isdecimal()]
    link = data_link(sensor, Udp)
    if port:
        return [port]
    if link:
        return list(link.ports)
    return list_udp_ports()


def _port_in_use(number: int) -> Iterator[Diagnosis]:
    users = ports.find_udp_users(number)
    if users is None:
        return
    for user in users:
        yield Diagnosis(False, f"UDP port {number} is in use by {user}", f"kill {user.pid}")
    if not users:
        yield Diagnosis(
            False,
            f"UDP port {number} is in use by a program of another user",
            f"sudo ss -ulpn 'sport = :{number}'",
        )


def _buffer() -> Iterator[Diagnosis]:
    limit = Path("/proc/sys/net/core/rmem_max")
    try:
        granted = int(limit.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return
    for text in warn_of_small_buffer(REQUESTED_BUFFER_BYTES, min(granted, REQUESTED_BUFFER_BYTES)):
        said, _, command = text.partition("; next: ")
        yield Diagnosis(False, said.replace("the system gave", "the system gives at most"), command)


def _interfaces(numbers: list[int], host: str, rates: dict[str, float]) -> Iterator[Diagnosis]:
    """Yield findings about interfaces, if packets arrive but none at the ports."""
    listed = "/".join(map(str, numbers))
    active = {name: rate for name, rate in rates.items() if name != LOOPBACK and rate >= 1}
    if host:
        text = f"this receives only packets to {host}; the sensor may send to another address"
        yield Diagnosis(True, text, f"lidarspec doctor udp://:{numbers[0]}")
    for name, rate in active.items():
        text = (
            f"{name} receives {rate:.0f} packets/s, but no packet on port {listed}: check the"
            " sensor's destination port and address, and the firewall"
        )
        yield Diagnosis(False, text, f"sudo tcpdump -ni {name} udp")
        if ports.filters_senders(name):
            text = (
                f"{name} drops packets of senders in other networks, such as a sensor with its"
                " factory address (rp_filter)"
            )
            yield Diagnosis(
                False,
                text,
                f"sudo sysctl -w net.ipv4.conf.all.rp_filter=2 net.ipv4.conf.{name}.rp_filter=2",
            )
    if rates and not active:
        text = (
            "no network interface receives data: check the cable, the power of the sensor, and"
            " that the interface is up"
        )
        yield Diagnosis(False, text, "ip -br address")


def _examine_bytes(source: str, sensor: Sensor | None, seconds: float) -> Iterator[Diagnosis]:
    """Check whether data arrives, and whether it is valid data of the sensor."""
    try:
        if sensor is not None:
            tried = [
                identify_sample(sample) for sample in read_sensor_sample(source, sensor, seconds)
            ]
        else:
            tried = []
        if not any(one.scores for one in tried):
            tried += identify_senders(source, seconds=seconds)
    except LidarSpecError as error:
        command = suggestion(error)
        yield Diagnosis(
            False,
            str(error),
            "" if "doctor" in command and not isinstance(error, UsageError) else command,
        )
        return
    yield _verdict(source, max(tried, key=lambda one: (bool(one.scores), one.sample.size)), sensor)
    yield from _several(source, tried)


def _several(source: str, verdicts: Sequence[Verdict]) -> Iterator[Diagnosis]:
    """Yield a finding for several senders of one sensor's frames."""
    senders: dict[str, list[str]] = {}
    for one in verdicts:
        if one.scores and one.sample.sender:
            senders.setdefault(one.scores[0].sensor.id, []).append(one.sample.sender)
    for name, several in senders.items():
        if len(several) > 1:
            command = f"lidarspec view {quote(with_option(source, 'src', several[0]))} -s {name}"
            yield Diagnosis(
                False, f"{' and '.join(several)} all send frames of {name}: choose one", command
            )


def _verdict(source: str, verdict: Verdict, sensor: Sensor | None) -> Diagnosis:
    """Return the finding about the data of one sender."""
    sample = verdict.sample
    ids = [score.sensor.id for score in verdict.scores]
    may_be = {score.sensor.id: score.why for score in verdict.candidates} or dict(verdict.others)
    quoted = quote(source)
    if not sample.size and sample.warnings:
        return Diagnosis(
            False, sample.warnings[0], f"lidarspec detect {quote(source.partition('?')[0])}"
        )
    if not sample.size:
        return _nothing(source, sensor)
    if verdict.fault:
        return Diagnosis(False, verdict.fault, f"lidarspec crc {quoted}")
    if not verdict.scores:
        if sample.baud is not None and len(list_bauds()) > 1:
            at = " at any baud rate"
        else:
            at = ""
        return Diagnosis(
            False,
            f"{sample.size} bytes received, but no frame of an installed sensor{at}",
            f"lidarspec detect {quoted}",
        )
    if sample.baud is not None:
        at = f" at {sample.baud} baud"
    else:
        at = ""
    if sensor is not None and sensor.id not in ids:
        return Diagnosis(
            False,
            f"received frames of {ids[0]}{at}, not of {sensor.id}",
            f"lidarspec {verb_to_show(verdict.scores[0].sensor)} {quoted} -s {ids[0]}",
        )
    name = sensor.id if sensor is not None else ids[0]
    if name not in may_be:
        other, why = next(iter(may_be.items()))
        if verdict.candidates:
            command = f"lidarspec {verb_to_show(verdict.candidates[0].sensor)} {quoted} -s {other}"
        else:
            command = f"lidarspec detect {quoted}"
        return Diagnosis(False, f"received frames of {other} ({why}){at}, not of {name}", command)
    score = next(score for score in verdict.scores if score.sensor.id == name)
    link = data_link(score.sensor, Serial)
    if sample.baud is not None and link and sample.baud not in link.bauds:
        again = quote(with_option(source, "baud", sample.baud))
        return Diagnosis(
            False,
            f"{name} sends{at}, but {link.baud} is declared",
            f"lidarspec {verb_to_show(score.sensor)} {again} -s {name}",
        )
    cut_off = (
        2 * max(frame.max_length for frame in score.sensor.incoming.values()) / sample.size
    )  # the first and the last frame
    if score.share + (0 if sample.datagrams else cut_off) < CLEAR:
        return Diagnosis(
            False,
            f"{name} sends{at}, but {1 - score.share:.0%} of the bytes are outside frames: check"
            " cable, ground and baud rate",
        )
    device = "".join(
        f", {role} {text}" for role, text in read_info(score.sensor, score.found).items()
    )
    return Diagnosis(
        True,
        f"{name} sends{at}: {score.data_frames} data frames, {score.share:.0%} of the bytes in"
        f" frames{printable(device)}",
    )


def _nothing(source: str, sensor: Sensor | None) -> Diagnosis:
    """Return the finding for a source without data."""
    quoted = quote(source)
    if sensor is not None and sensor in list_start_required():
        start = next(name for name in sensor.on_open if sensor.commands[name].starts)
        text = f"no data received; {sensor.id} sends nothing until it is started"
        return Diagnosis(False, text, f"lidarspec send {quoted} {start} -s {sensor.id}")
    address = live_address(source)
    if sensor is None and address is not None and address.scheme == "serial":
        text = (
            "no data received: start the sensor, or check its power, and that its transmit line is"
            " connected to our receive line"
        )
        return Diagnosis(False, text, f"lidarspec detect {quoted} --start")
    return Diagnosis(False, "no data received within the listening time")
