"""Write the bytes of a simulated sensor to a file, without waiting.

The file equals a recording that begins when the device is started.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from lidarspec.errors import LidarSpecError, SpecError, UsageError
from lidarspec.frames.commands import build_command
from lidarspec.recording.recorders import open_recorder
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.transports.protocol import Chunk
from lidarspec.transports.serving import advance_device

#: Minimum and maximum step of the device's time between two writes to the file. With the minimum,
#: the frames of a fast sensor accumulate, as for a program that reads a port.
_MIN_STEP_NS = SECOND // 1000
_MAX_STEP_NS = SECOND // 100

_Transfer = tuple[Chunk, Literal["in", "out"]]


def write_file(
    device: SimulatedDevice, path: str | Path, seconds: float, *, overwrite: bool = False
) -> int:
    """Write the bytes that a device sends in a period after its start.

    The commands that lidarspec sends when it opens such a sensor are recorded as well. If the
    device sends no data, no file is created.

    Args:
        path: an .lsr, .pcap, .pcapng or .bin file.
        seconds: the duration of the period.
        overwrite: whether an existing file may be replaced.

    Returns:
        The number of bytes that the device sent.

    Raises:
        UnknownFormat, UsageError: if the file exists, if its format cannot contain the bytes, or if
            nothing is sent.
        SpecError: if the commands in `Sensor.on_open` do not start the data of the sensor.
        SourceError: if the file cannot be written.
    """
    transfers = _simulate_opened(device, seconds)
    until_first_data = _take_until_data(transfers)
    if not until_first_data:
        raise _explain_silence(device, seconds)
    sensor = device.sensor
    sent_bytes = 0
    with contextlib.closing(
        open_recorder(
            path, sensor, f"sim:{sensor.id}", datagrams=sensor.datagrams, overwrite=overwrite
        )
    ) as log:
        for chunk, direction in itertools.chain(until_first_data, transfers):
            log.write(chunk, direction)
            log.wait_for_room()
            if direction == "in":
                sent_bytes += len(chunk.data)
    return sent_bytes


def _take_until_data(transfers: Iterator[_Transfer]) -> list[_Transfer]:
    """Return the transfers up to the first data of the device; empty if it sends none."""
    taken = []
    for transfer in transfers:
        taken.append(transfer)
        if transfer[1] == "in":
            return taken
    return []


def _simulate_opened(device: SimulatedDevice, seconds: float) -> Iterator[_Transfer]:
    """Open a simulated device; yield the commands sent to it, and the data that it sends."""
    sensor = device.sensor
    start_ns = time.time_ns()
    opening = _list_opening_commands(sensor)
    now = 0
    end_ns = round(seconds * SECOND)
    device.utc_offset_ns = start_ns
    device.start(now)
    while now < end_ns:
        if opening:
            name = opening.pop(0)
            data = build_command(sensor, name, {})
            yield Chunk(data, start_ns + now), "out"
            device.receive(data, now, sensor.commands[name].link)
        now = min(now + _find_step(device, now), end_ns)
        for chunk in advance_device(device, now, start_ns + now).get("data", []):
            yield chunk, "in"


def _find_step(device: SimulatedDevice, now: int) -> int:
    """Return the time until the device sends again, within the limits of a step, ns."""
    if device.deadline is None or math.isinf(device.rate):
        return _MAX_STEP_NS
    return min(max(device.deadline - now, _MIN_STEP_NS), _MAX_STEP_NS)


def _list_opening_commands(sensor: Sensor) -> list[str]:
    """Return the names of the commands in `on_open` that send a frame.

    The other commands only set control lines.
    """
    return [name for name in sensor.on_open if sensor.commands[name].frame]


def _explain_silence(device: SimulatedDevice, seconds: float) -> LidarSpecError:
    """Return an error that gives the reason why a device has sent no data."""
    sensor = device.sensor
    sent = {name: device.sent[name] for name in sensor.main_frames if device.sent[name]}
    if sent:
        frames = ", ".join(f"{number} {name}" for name, number in sent.items())
        return UsageError(
            f"nothing was written, because all sent frames ({frames}) were lost in the simulated"
            " transmission: reduce loss and errors"
        )
    if device.deadline is not None:
        due = f"the next frame is due after {device.deadline / SECOND:g} s"
        return UsageError(
            f"nothing was written: the simulated {sensor.id} sends no data in the first {seconds:g}"
            f" s; {due}"
        )
    is_started = any(command.starts for command in sensor.commands.values())
    if not is_started and not device.commands_received:
        return UsageError(
            f"nothing was written, because the simulated {sensor.id} sends only replies to"
            " commands: run sim without --to, and send commands to the simulated sensor"
        )
    recognized = ", ".join(device.commands_received) or "no command"
    missed = [
        name for name in _list_opening_commands(sensor) if name not in device.commands_received
    ]
    cause = f"the sensor received {recognized}, and sends no data until another command starts it"
    if missed:
        cause = f"the command {missed[0]!r} was sent, but the sensor recognized {recognized}"
    return SpecError(
        f"nothing was written: the simulated sensor sends nothing; {cause}",
        path="on_open",
        sensor=sensor.id,
    )
