"""What verbs are given: bytes as text, files, live sources; and what is said where nothing of use comes."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from shlex import quote

from lidarspec.device.device import Device
from lidarspec.device.settings import devices
from lidarspec.discovery.detect import chosen, nearest, never_right, verdict
from lidarspec.discovery.listen import Heard, beginning
from lidarspec.errors import CommandError, LidarSpecError, SourceError, UsageError, WireError, suggest, system_errors
from lidarspec.plugins import sensors
from lidarspec.scans.scans import Scan
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.open_url import is_port, live_address, transport
from lidarspec.wire.parse import parse_typed

#: longest hexadecimal text that is repeated in the next command, and of other text in a message.
REPEATED, QUOTED = 400, 64
#: datagrams and bytes looked at again to say why there is no data in a file.
LOOKED_AT = 1 << 16
#: seconds that a device is given for its first frame.
PATIENCE = 10.0
#: seconds between two looks at a source that sends nothing.
LOOK = 0.1


def read(words: Sequence[str]) -> Heard:
    """The input that the words of a command line stand for.

    Raises:
        UsageError: for text that is neither hexadecimal nor a file.
        SourceError: for a file that cannot be read.
    """
    text = " ".join(words)
    if text == "-":
        data = sys.stdin.buffer.read()
        return Heard("-", (_unhexed(data) or data,))
    if len(words) == 1 and os.path.exists(text) and not is_port(text):
        return _file(text)
    try:
        return Heard(text if len(text) <= REPEATED else "-", (_bytes(text),))
    except ValueError as error:
        if text in (known := devices()):
            return read([known[text].source])
        if len(words) == 1 and live_address(text) is not None:
            raise suggest(UsageError(f"{text} is live: this takes bytes or a file"), f"lidarspec read {quote(text)} --packets") from None
        if len(words) == 1 and re.search(r"[/\\.]", text):
            raise SourceError(f"{text}: no such file") from None
        raise UsageError(f"{text[:QUOTED]!r} is no file, and not hexadecimal: {error}") from None


def refuse_overwriting(source: str, target: str, what: str = "source") -> None:
    """Nothing, where a file is written to that is not the one that is read.

    Raises:
        UsageError: where it is.
    """
    path = source.partition("?")[0]
    if os.path.exists(path) and os.path.exists(target) and os.path.samefile(path, target):
        raise UsageError(f"{target} is the {what}: it would be overwritten")


def no_frame(sensor: Sensor, given: Heard) -> WireError:
    """Why there is no frame of this sensor in the input, with the next command."""
    data = given.data
    longest = max((frame.max_length for frame in sensor.frames.values()), default=0)
    command = f"lidarspec explain {given.source} -s {sensor.id}"
    if not data:
        return suggest(WireError(f"{given.source} holds no bytes", sensor=sensor.id), f"lidarspec build {sensor.id} --help")
    if (fault := _never_right(given)) is not None:
        return fault
    if len(data) > longest:
        error = WireError(f"no frame in {len(data)} bytes", sensor=sensor.id, expected="a frame", data=data[:longest])
        return suggest(error, "lidarspec sensors")
    try:
        parse_typed(sensor, data)
    except WireError as error:
        return suggest(error, command)
    return suggest(WireError("the bytes are not plausible", sensor=sensor.id, data=data), command)


def nearest_fault(given: Heard) -> WireError:
    """No sensor fits: what the one that came farthest says, with its id, or that none came far."""
    if not given.data:
        return suggest(WireError(f"{given.source} holds no bytes"), "lidarspec sensors")
    if (fault := _never_right(given)) is not None:
        return fault
    best = nearest(given.data)
    if best is None:
        text = f"no frame of any of the {len(sensors())} installed sensors"
        return suggest(WireError(text, data=given.data[:QUOTED]), "lidarspec sensors")
    return suggest(best, f"lidarspec explain {given.source} -s {best.sensor}")


def _never_right(given: Heard) -> WireError | None:
    """That the input is frames of a sensor whose checksums are never right; None where it is not."""
    fault = never_right(given.chunks, datagrams=given.datagrams)
    return suggest(WireError(f"{given.source}: {fault}"), f"lidarspec crc {given.source}") if fault else None


def nothing_came(device: Device, source: str, seconds: float | None = None) -> LidarSpecError:
    """Why there is nothing to show: no data frame in a file, a silent device, or one whose bytes are no frames."""
    sensor, stats = device.sensor, device.stats
    if not device.is_live:
        if stats.bytes_in and (instead := fits_instead(sensor, source)):
            return suggest(WireError(f"{source} {instead[0]}", sensor=sensor.id), f"the same with {instead[1]}")
        if not stats.frames and (given := again(source)) is not None and (fault := _never_right(given)) is not None:
            return fault
        what = "holds no bytes" if stats.bytes_in == 0 else f"has no data frame: {stats}"
        return suggest(WireError(f"{source} {what}", sensor=sensor.id), f"lidarspec explain {source} -s {sensor.id}")
    waited = "" if seconds is None else f" within {seconds:.1f} s".replace(".0 s", " s")
    if stats.bytes_in == 0:
        return suggest(CommandError(f"{sensor.id} on {source} sent nothing{waited}"), f"lidarspec doctor {source} -s {sensor.id}")
    error = WireError(f"{source}: {stats.bytes_in} bytes{waited}, and not a scan of data frames among them: {stats}", sensor=sensor.id)
    return suggest(error, f"lidarspec detect {source}")


def again(source: str) -> Heard | None:
    """The beginning of a file once more; None for what can be read only once."""
    if not Path(source.partition("?")[0]).is_file():
        return None
    with contextlib.closing(transport(source)) as opened:
        try:
            return Heard(source, tuple(chunk.data for chunk in beginning(opened, LOOKED_AT)), opened.datagrams)
        except LidarSpecError:
            return None


def fits_instead(sensor: Sensor, source: str) -> tuple[str, str] | None:
    """What a file holds that has no data frame of a sensor, and the options with which it is read; None where nothing fits."""
    given = again(source)
    found = verdict(given).scores if given is not None else ()
    own = next((score.sensor.options for score in found if score.sensor.id == sensor.id), None)
    if own:
        told = " and ".join(f"{name}={value}" for name, value in own.items())
        return f"does not say which data frames it holds: they are found with {told}", chosen(sensor.configure(**own))
    others = [score.sensor for score in found if score.sensor.id != sensor.id]
    if not others:
        return None
    return f"has no data frame of it; its frames are those of {', '.join(other.id for other in others)}", chosen(others[0])


class Patience:
    """The time in which a live source has to send its first frame."""

    def __init__(self, device: Device, source: str) -> None:
        self._device, self._source, self._began = device, source, time.monotonic()

    def check(self) -> None:
        """Nothing, while there is hope.

        Raises:
            CommandError, WireError: where the device has sent nothing, or nothing of the sensor's, for too long.
        """
        waited = time.monotonic() - self._began
        if waited > PATIENCE and self._device.is_live and not self._device.stats.frames:
            raise nothing_came(self._device, self._source, waited)


def scans_of(device: Device, source: str) -> Iterator[Scan]:
    """The scans of a device, which has to send its first frame in time.

    Raises:
        CommandError, WireError: where the device has sent nothing, or nothing of the sensor's, for too long.
    """
    patience = Patience(device, source)
    for scan in device.scans(wait=LOOK):
        if scan is not None:
            yield scan
        patience.check()


def _file(path: str) -> Heard:
    with system_errors(path), contextlib.closing(transport(path)) as opened:
        return Heard(path, tuple(chunk.data for chunk in opened.chunks()), opened.datagrams)


def _bytes(text: str) -> bytes:
    """The bytes of hexadecimal text, with spaces, commas, colons and 0x as one likes."""
    digits = re.sub(r"0[xX]|[\s,:]", "", text)
    bad = re.search(r"[^0-9a-fA-F]", digits)
    if bad or not digits:
        raise ValueError(f"{bad[0]!r} is no digit of it" if bad else "there are no digits")
    if len(digits) % 2:
        raise ValueError(f"{len(digits)} digits make no whole bytes")
    return bytes.fromhex(digits)


def _unhexed(data: bytes) -> bytes | None:
    """The bytes that a text stands for, None where it is not hexadecimal."""
    try:
        return _bytes(data.decode("ascii"))
    except ValueError:
        return None
