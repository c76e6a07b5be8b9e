"""Diagnose a source without data, or without valid data.

Most findings suggest a command that fixes the problem.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

from lidarspec.detect.identification import (
    CLEAR_SHARE,
    Verdict,
    identify_sample,
    identify_senders,
    read_info,
    verb_to_show,
)
from lidarspec.detect.listen import (
    LISTEN_S,
    list_bauds,
    list_start_required,
    list_udp_ports,
    read_sensor_sample,
)
from lidarspec.errors import LidarSpecError, UsageError, escape_controls, suggestion
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Serial, Udp
from lidarspec.transports import ports
from lidarspec.transports.addresses import SourceAddress, with_option
from lidarspec.transports.base import find_data_link
from lidarspec.transports.open_url import live_address, resolve_device_name
from lidarspec.transports.protocol import no_bytes_message
from lidarspec.transports.udp import (
    REQUESTED_BUFFER_BYTES,
    describe_small_buffer,
    make_sysctl_command,
)
from lidarspec.transports.usb_adapters import list_missing_drivers

LOOPBACK = "lo"
#: The reported facts that identify a device.
IDENTITY = ("serial", "firmware", "model", "temperature")


@dataclass(frozen=True)
class Diagnosis:
    """The result of one check.

    Attributes:
        fix: the command that fixes the problem; "" if there is no command for it.
    """

    ok: bool
    text: str
    fix: str = ""
    is_silence: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON object."""
        return {"ok": self.ok, "text": self.text, "fix": self.fix}


def examine(
    source: str | Path, sensor: Sensor | None = None, *, seconds: float = LISTEN_S
) -> Iterator[Diagnosis]:
    """Check a source, and yield findings in the order of the checks.

    Args:
        sensor: the expected sensor; None to detect it.
        seconds: the time to listen at each baud rate.
    """
    text = resolve_device_name(source)
    address = live_address(text)
    if address is None:
        yield from _examine_file(text, sensor)
    elif address.scheme == "serial":
        yield from _examine_serial(text, address, sensor, seconds)
    elif address.scheme == "udp":
        yield from _examine_udp(text, address, sensor, seconds)
    else:
        yield from _examine_bytes(text, sensor, seconds)


def examine_computer() -> Iterator[Diagnosis]:
    """Check the ports and the receive buffer of this computer, without a source."""
    serial_ports = ports.list_serial_ports()
    if not serial_ports:
        yield Diagnosis(
            True,
            "no serial port found: check the cable and the driver",
            "sudo dmesg | tail",
        )
    yield from _check_usb_drivers()
    for port in serial_ports:
        yield from _check_permission(port.path)
        yield from _check_serial_users(port.path)
    for number in list_udp_ports():
        yield from _check_udp_users(number)
    yield from _check_buffer()


def _examine_file(path: str, sensor: Sensor | None) -> Iterator[Diagnosis]:
    if os.path.exists(path):
        name = path
    else:
        name = path.rpartition("?")[0]  # without the option that selects a sender
    if not os.path.exists(name):
        yield Diagnosis(False, f"{path}: no such file or port", "lidarspec ports")
    elif not os.access(name, os.R_OK):
        yield Diagnosis(False, f"no permission to read {path}", f"sudo chmod a+r {path}")
    elif os.path.getsize(name) == 0:
        yield Diagnosis(False, f"{path} is empty")
    else:
        verdicts = identify_senders(path)
        largest = max(verdicts, key=lambda verdict: verdict.sample.size)
        if largest.sample.size:
            yield _diagnose_data(path, largest, sensor)
        yield from _check_single_sender(path, verdicts)
        texts = list(largest.sample.warnings)
        if not texts and not largest.sample.size:
            texts = [no_bytes_message(path, ())]
        for text in texts:
            yield Diagnosis(False, text)


def _examine_serial(
    source: str, address: SourceAddress, sensor: Sensor | None, seconds: float
) -> Iterator[Diagnosis]:
    port = address.location
    if os.name == "posix" and not os.path.exists(port):
        yield Diagnosis(
            False,
            f"{port}: no such port; check that the device is connected and its driver is loaded",
            "lidarspec ports",
        )
        yield from _check_usb_drivers()
        return
    problems = [*_check_permission(port), *_check_serial_users(port)]
    if problems:
        yield from problems
        return
    yield Diagnosis(True, f"{port} exists and can be opened")
    yield from _examine_bytes(source, sensor, seconds)


def _check_usb_drivers() -> Iterator[Diagnosis]:
    """Yield a finding for each known USB serial adapter without a driver."""
    for driver in list_missing_drivers():
        yield Diagnosis(False, driver.text, driver.fix)


def _check_permission(port: str) -> Iterator[Diagnosis]:
    """Yield a finding if the user has no permission to open a serial port."""
    if ports.can_open(port):
        return
    group = ports.find_group(port)
    text = f"no permission to open {port}"
    if group:
        yield Diagnosis(
            False,
            f"{text}; add yourself to the group {group}, and log in again",
            f"sudo usermod -aG {group} $USER",
        )
    else:
        yield Diagnosis(False, f"{text}; only root may open it", _make_udev_rule_command(port))


def _make_udev_rule_command(port: str) -> str:
    """Return a command that adds a udev rule, so that all users may open a port."""
    kind = os.path.basename(port).rstrip("0123456789")
    rule = f'KERNEL=="{kind}[0-9]*", MODE="0666"'
    return f"echo '{rule}' | sudo tee /etc/udev/rules.d/99-lidarspec.rules && sudo udevadm trigger"


def _check_serial_users(port: str) -> Iterator[Diagnosis]:
    """Yield a finding for each other program that has opened a serial port."""
    for user in ports.find_users(port):
        yield Diagnosis(False, f"{port} is in use by {user}", f"kill {user.pid}")


def _examine_udp(
    source: str, address: SourceAddress, sensor: Sensor | None, seconds: float
) -> Iterator[Diagnosis]:
    numbers = _select_udp_ports(address, sensor)
    host = address.host_and_port()[0]
    problems = [finding for number in numbers for finding in _check_udp_users(number)]
    yield from problems
    yield from _check_buffer()
    if problems:
        return
    before = ports.count_received_packets()
    began = time.monotonic()
    findings = list(_examine_bytes(source, sensor, seconds))
    yield from findings
    if any(finding.is_silence for finding in findings):
        rates = {
            name: (count - before.get(name, count)) / (time.monotonic() - began)
            for name, count in ports.count_received_packets().items()
        }
        yield from _check_interfaces(numbers, host, rates)


def _select_udp_ports(address: SourceAddress, sensor: Sensor | None) -> list[int]:
    """Return the UDP ports of a SOURCE, or the ports that the sensors declare."""
    port = address.host_and_port()[1]
    text = address.options.get("port", "")
    if text:
        return [int(part) for part in text.split(",") if part.isdecimal()]
    link = find_data_link(sensor, Udp)
    if port:
        return [port]
    if link:
        return list(link.ports)
    return list_udp_ports()


def _check_udp_users(number: int) -> Iterator[Diagnosis]:
    """Yield a finding for each other program that has opened a UDP port."""
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


def _check_buffer() -> Iterator[Diagnosis]:
    """Yield a finding if the system allows only a small receive buffer."""
    limit = Path("/proc/sys/net/core/rmem_max")
    try:
        granted = int(limit.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return
    if granted < REQUESTED_BUFFER_BYTES:
        yield Diagnosis(
            False,
            describe_small_buffer(REQUESTED_BUFFER_BYTES, granted),
            make_sysctl_command(REQUESTED_BUFFER_BYTES),
        )


def _check_interfaces(
    numbers: list[int], host: str, rates: dict[str, float]
) -> Iterator[Diagnosis]:
    """Yield the possible reasons why no packet arrives at UDP ports."""
    listed = "/".join(map(str, numbers))
    active = {name: rate for name, rate in rates.items() if name != LOOPBACK and rate >= 1}
    if host:
        text = f"the source receives only packets to {host}; the sensor may send to another address"
        yield Diagnosis(True, text, f"lidarspec doctor udp://:{numbers[0]}")
    for name, rate in active.items():
        text = (
            f"{name} receives {rate:.0f} packets/s, but no packet on port {listed}: check the"
            " sensor's destination port and address, and the firewall"
        )
        yield Diagnosis(False, text, f"sudo tcpdump -ni {name} udp")
        if ports.filters_senders(name):
            text = (
                f"{name} drops packets from other networks (rp_filter), for example those of a"
                " sensor with its factory address"
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
        verdicts: list[Verdict] = []
        if sensor is not None:
            verdicts = [
                identify_sample(sample) for sample in read_sensor_sample(source, sensor, seconds)
            ]
        if not any(verdict.scores for verdict in verdicts):
            verdicts += identify_senders(source, seconds=seconds)
    except LidarSpecError as error:
        command = suggestion(error)
        yield Diagnosis(
            False,
            str(error),
            "" if "doctor" in command and not isinstance(error, UsageError) else command,
        )
        return
    best = max(verdicts, key=lambda verdict: (bool(verdict.scores), verdict.sample.size))
    yield _diagnose_data(source, best, sensor)
    yield from _check_single_sender(source, verdicts)


def _check_single_sender(source: str, verdicts: Sequence[Verdict]) -> Iterator[Diagnosis]:
    """Yield a finding if several senders send frames of the same sensor."""
    by_sensor: dict[str, list[str]] = {}
    for verdict in verdicts:
        if verdict.scores and verdict.sample.sender:
            sensor_id = verdict.scores[0].sensor.id
            by_sensor.setdefault(sensor_id, []).append(verdict.sample.sender)
    for sensor_id, senders in by_sensor.items():
        if len(senders) > 1:
            chosen = quote(with_option(source, "src", senders[0]))
            yield Diagnosis(
                False,
                f"{' and '.join(senders)} all send frames of {sensor_id}: choose one sender",
                f"lidarspec view {chosen} -s {sensor_id}",
            )


def _diagnose_data(source: str, verdict: Verdict, sensor: Sensor | None) -> Diagnosis:
    """Return the finding about the data of one sender."""
    sample = verdict.sample
    ids = [score.sensor.id for score in verdict.scores]
    # id of each possible sensor -> evidence
    possible = {score.sensor.id: score.evidence for score in verdict.candidates} or dict(
        verdict.others
    )
    quoted = quote(source)
    if not sample.size and sample.warnings:
        return Diagnosis(
            False, sample.warnings[0], f"lidarspec detect {quote(source.partition('?')[0])}"
        )
    if not sample.size:
        return _diagnose_silence(source, sensor)
    if verdict.fault:
        return Diagnosis(False, verdict.fault, f"lidarspec crc {quoted}")
    if not verdict.scores:
        if sample.baud is not None and len(list_bauds()) > 1:
            rate = " at any baud rate"
        else:
            rate = ""
        return Diagnosis(
            False,
            f"{sample.size} bytes received, but no frame of an installed sensor{rate}",
            f"lidarspec detect {quoted}",
        )
    if sample.baud is not None:
        rate = f" at {sample.baud} baud"
    else:
        rate = ""
    if sensor is not None and sensor.id not in ids:
        return Diagnosis(
            False,
            f"received frames of {ids[0]}{rate}, not of {sensor.id}",
            f"lidarspec {verb_to_show(verdict.scores[0].sensor)} {quoted} -s {ids[0]}",
        )
    name = sensor.id if sensor is not None else ids[0]
    if name not in possible:
        other, why = next(iter(possible.items()))
        if verdict.candidates:
            command = f"lidarspec {verb_to_show(verdict.candidates[0].sensor)} {quoted} -s {other}"
        else:
            command = f"lidarspec detect {quoted}"
        text = f"received frames of {other}{rate}, not of {name}; evidence: {why}"
        return Diagnosis(False, text, command)
    score = next(score for score in verdict.scores if score.sensor.id == name)
    link = find_data_link(score.sensor, Serial)
    if sample.baud is not None and link and sample.baud not in link.bauds:
        again = quote(with_option(source, "baud", sample.baud))
        return Diagnosis(
            False,
            f"{name} sends{rate}, but its declared rate is {link.baud} baud",
            f"lidarspec {verb_to_show(score.sensor)} {again} -s {name}",
        )
    share = score.share
    if not sample.datagrams:
        # The first and the last frame in a stream may be incomplete.
        longest = max(frame.max_length for frame in score.sensor.incoming.values())
        share += 2 * longest / sample.size
    if share < CLEAR_SHARE:
        return Diagnosis(
            False,
            f"{name} sends{rate}, but {1 - score.share:.0%} of the bytes are outside frames: check"
            " the cable, the ground connection and the baud rate",
        )
    device = "".join(
        f", {name} {text}"
        for name, text in read_info(score.sensor, score.frames).items()
        if name in IDENTITY
    )
    return Diagnosis(
        True,
        f"{name} sends{rate}: {score.data_frames} data frames, {score.share:.0%} of the bytes are"
        f" in frames{escape_controls(device)}",
    )


def _diagnose_silence(source: str, sensor: Sensor | None) -> Diagnosis:
    """Return the finding for a source without data."""
    quoted = quote(source)
    if sensor is not None and sensor in list_start_required():
        start = next(name for name in sensor.on_open if sensor.commands[name].starts)
        text = f"no data received; {sensor.id} sends nothing until it is started"
        fix = f"lidarspec send {quoted} {start} -s {sensor.id}"
        return Diagnosis(False, text, fix, is_silence=True)
    address = live_address(source)
    if sensor is None and address is not None and address.scheme == "serial":
        text = (
            "no data received: start the sensor, check its power, and check that its TX line is"
            " connected to the RX line of this computer"
        )
        return Diagnosis(False, text, f"lidarspec detect {quoted} --start", is_silence=True)
    return Diagnosis(False, "no data received within the listening time", is_silence=True)
