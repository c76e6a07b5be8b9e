"""Read the input of verbs, and explain why it contains no frame.

The input is hexadecimal text, a file, standard input or a configured device. Slow modules are
imported inside functions, so that verbs start quickly.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.terminal import note
from lidarspec.detect.sample_bytes import (
    MAX_SAMPLE_BYTES,
    SampleBytes,
    read_beginning,
    take_leading,
)
from lidarspec.errors import (
    CommandError,
    LidarSpecError,
    SourceError,
    UsageError,
    WireError,
    suggest,
    system_errors,
)
from lidarspec.frames.parse import identify
from lidarspec.plugins import sensors
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import Selection, Times, iter_received
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.hex_text import is_hexadecimal, iter_hex_chunks, parse_hex
from lidarspec.transports.protocol import Chunk, no_bytes_message

if TYPE_CHECKING:
    from lidarspec.device.device import Device
    from lidarspec.transports.files import FileTransport

#: Maximum length of hexadecimal text to copy into a suggested command.
MAX_REPEATED_CHARS = 400
#: Maximum length of other input to quote in a message.
MAX_QUOTED_CHARS = 64
#: The number of bytes after which `read_sample` stops reading.
MAX_INPUT_BYTES = 1 << 20
#: Maximum time to wait for the first frame of a device, in seconds.
FIRST_FRAME_TIMEOUT_S = 10.0
#: Polling interval for a source that sends nothing, in seconds.
POLL_S = 0.1


@contextlib.contextmanager
def open_input(
    words: Sequence[str], times: Times = (None, None), *, reports_damage: bool = False
) -> Iterator[tuple[SampleBytes, Iterator[Chunk]]]:
    """Open the input that command-line arguments name.

    Yields:
        The first bytes of the input; and an iterator over the chunks of the whole input, from its
        start, which reads them when they are needed.

    Args:
        words: the arguments: hexadecimal text, "-", a file name, or a device of lidarspec.toml.
        times: the range of arrival times to read, if the input is a file.
        reports_damage: whether to exit with code 1 at the end, if a corrupt part of a file could
            not be read.

    Raises:
        UsageError: for text that is neither hexadecimal nor a file.
        SourceError: for a file that cannot be read.
        click.exceptions.Exit: see `reports_damage`.
    """
    text = " ".join(words)
    if text == "-" or (len(words) == 1 and _is_file(text)):
        reading = _open_file(text, times, reports_damage=reports_damage)
    else:
        try:
            if not (data := parse_hex(text)):
                raise ValueError("no digits found")
            reading = _read_beginning(
                text if len(text) <= MAX_REPEATED_CHARS else "-",
                iter([Chunk(data)]),
                datagrams=False,
            )
        except ValueError as error:
            from lidarspec.device.named_devices import find_device

            if (device := find_device(text)) is None:
                raise _make_no_bytes_error(words, error) from None
            reading = open_input([device.source], times, reports_damage=reports_damage)
    with reading as sample:
        yield sample


def _is_file(text: str) -> bool:
    if not os.path.exists(text):
        return False
    from lidarspec.transports.open_url import is_port

    return not is_port(text)


@contextlib.contextmanager
def _open_file(
    path: str, times: Times, *, reports_damage: bool
) -> Iterator[tuple[SampleBytes, Iterator[Chunk]]]:
    from lidarspec.transports.files import FileTransport
    from lidarspec.transports.open_url import open_transport

    with contextlib.closing(open_transport(path)) as file:
        if path == "-" and type(file) is FileTransport:
            chunks = _iter_standard_input(file)
        else:
            chunks = iter_received(file, times, path)
        with _read_beginning(
            path, chunks, datagrams=file.datagrams, warnings=file.warnings
        ) as opened:
            try:
                yield opened
            finally:  # also if the verb exits because of damaged frames
                for warning in file.warnings if opened[0].chunks else ():
                    note(warning)
        if reports_damage:
            exit_if_damaged(file.unread)


@contextlib.contextmanager
def _read_beginning(
    source: str, chunks: Iterator[Chunk], *, datagrams: bool, warnings: Sequence[str] = ()
) -> Iterator[tuple[SampleBytes, Iterator[Chunk]]]:
    with system_errors(source):
        head = take_leading(chunks, MAX_SAMPLE_BYTES)
    data = tuple(chunk.data for chunk in head)
    yield (
        SampleBytes(source, data, datagrams, warnings=tuple(warnings)),
        itertools.chain(head, _read_rest(source, chunks)),
    )


def _read_rest(source: str, chunks: Iterator[Chunk]) -> Iterator[Chunk]:
    with system_errors(source):
        yield from chunks


def _iter_standard_input(file: FileTransport) -> Iterator[Chunk]:
    """Yield the bytes of standard input as they arrive; hexadecimal text is converted."""
    head = sys.stdin.buffer.read(MAX_SAMPLE_BYTES)
    stdin = sys.stdin.buffer
    if not is_hexadecimal(head, whole=len(head) < MAX_SAMPLE_BYTES):
        yield Chunk(head)
        yield from file.chunks()
        return
    looked_at = io.BytesIO(head)

    def readline(size: int) -> bytes:
        line = looked_at.readline(size)
        if line.endswith(b"\n") or len(line) == size:
            return line
        return line + stdin.readline(size - len(line))

    yield from iter_hex_chunks("standard input", readline)


def read_sample(words: Sequence[str]) -> SampleBytes:
    """Return the first bytes of the input that command-line arguments name.

    Reading stops after `MAX_INPUT_BYTES`.

    Raises:
        UsageError: for text that is neither hexadecimal nor a file.
        SourceError: for a file that cannot be read.
    """
    with open_input(words) as (sample, chunks):
        return replace(
            sample, chunks=tuple(chunk.data for chunk in take_leading(chunks, MAX_INPUT_BYTES))
        )


def _make_no_bytes_error(words: Sequence[str], error: ValueError) -> LidarSpecError:
    """Return the error for arguments that are neither files nor hexadecimal digits."""
    from lidarspec.transports.open_url import live_address

    text = " ".join(words)
    if len(words) == 1 and live_address(text) is not None:
        return suggest(
            UsageError(f"expected hexadecimal bytes or a file, got the live source {text}"),
            f"lidarspec read {quote(text)} --packets",
        )
    if len(words) == 1 and re.search(r"[/\\.]", text):
        return SourceError(f"{text}: no such file")
    return UsageError(
        f"{text[:MAX_QUOTED_CHARS]!r} is neither a file nor hexadecimal text: {error}"
    )


def refuse_overwriting(
    target: str | Sequence[str] | None, *inputs: str | Path | Sensor | None, force: bool = True
) -> None:
    """Raise an error if a verb must not overwrite its output file.

    Args:
        target: the output file or files.
        inputs: SOURCEs, names of input files, and sensors, because the options of a sensor may name
            input files.
        force: whether the verb may overwrite existing files. Inputs are never overwritten.

    Raises:
        UsageError: if an output file is an input, or if an output file exists and `force` is false.
    """
    existing = [
        file
        for file in ([target] if isinstance(target, str) else target or ())
        if os.path.exists(file)
    ]
    files = [file for file in existing if os.path.isfile(file)]
    for path in [path for source in inputs for path in _iter_input_files(source)] if files else ():
        if os.path.exists(path):
            same = next((file for file in files if os.path.samefile(path, file)), None)
        else:
            same = None
        if same is not None:
            if path == 0:
                name = "standard input"
            elif path != same:
                name = f"the same file as the input {path}"
            else:
                name = "the input"
            raise UsageError(f"{same} is {name}, and would be overwritten")
    if existing and not force:
        error = UsageError(f"{existing[0]} exists already; --force overwrites it")
        raise suggest(error, "repeat with --force, or with another file")


def _iter_input_files(argument: str | Path | Sensor | None) -> Iterator[str | int]:
    """Yield the names of the files that a command may read for an argument.

    Some of these files do not exist. For standard input, the descriptor 0 is yielded.
    """
    if isinstance(argument, Sensor):
        yield from (
            str(value) for value in argument.options.values() if isinstance(value, str | Path)
        )
        return
    word = str(argument or "")
    yield from (
        [0]
        if word == "-"
        else [word, word.partition("?")[0], word.rpartition(":")[0], word.partition("=")[2]]
    )
    from lidarspec.device.named_devices import find_device

    # Errors in the settings are reported when the source is opened.
    with contextlib.suppress(LidarSpecError):
        device = find_device(word)
        yield from (
            (device.source.partition("?")[0], *map(str, device.options.values())) if device else ()
        )


def make_no_frame_error(sensor: Sensor, sample: SampleBytes) -> WireError:
    """Return the error for an input that contains no frame of a sensor."""
    data = sample.data
    longest = max((frame.max_length for frame in sensor.frames.values()), default=0)
    command = f"lidarspec explain {quote(sample.source)} -s {sensor.id}"
    if not data:
        return suggest(
            WireError(no_bytes_message(sample.source, sample.warnings), sensor=sensor.id),
            f"lidarspec build {sensor.id} --help",
        )
    if (fault := _make_wrong_checksums_error(sample)) is not None:
        return fault
    if len(data) > longest:
        kind = " of text" if sample.is_text else ""
        error = WireError(
            f"no frame in {len(data)} bytes{kind}",
            sensor=sensor.id,
            expected="a frame",
            data=data[:longest],
        )
        return suggest(error, "lidarspec sensors")
    try:
        name = identify(sensor, data)
    except WireError as error:
        return suggest(error, command)
    return suggest(
        WireError(
            f"these bytes are a {name} frame, but its values are not plausible",
            sensor=sensor.id,
            data=data,
        ),
        command,
    )


def make_no_sensor_error(sample: SampleBytes) -> WireError:
    """Return the error for an input that no sensor fits."""
    from lidarspec.detect.identification import find_nearest_fault
    from lidarspec.detect.uninstalled_sensors import suggest_installation

    if not sample.data:
        return suggest(
            WireError(no_bytes_message(sample.source, sample.warnings)), "lidarspec sensors"
        )
    if (fault := _make_wrong_checksums_error(sample)) is not None:
        return fault
    best = find_nearest_fault(sample.data)
    if best is None:
        if sensors():
            text = f"found no frame of the {len(sensors())} installed sensors"
        else:
            text = "found no frame of an installed sensor"
        if sample.is_text:
            text = f"{sample.source} is text: {text}"
        error = suggest_installation(WireError(text, data=sample.data[:MAX_QUOTED_CHARS]), sample)
        return suggest(error, "lidarspec sensors")
    return suggest(best, f"lidarspec explain {quote(sample.source)} -s {best.sensor}")


def _make_wrong_checksums_error(sample: SampleBytes) -> WireError | None:
    """Return an error if the input has frames of a sensor, all with wrong checksums."""
    from lidarspec.detect.identification import find_wrong_checksums

    fault = find_wrong_checksums(sample.chunks, datagrams=sample.datagrams)
    if fault:
        return suggest(
            WireError(f"{sample.source}: {fault}"), f"lidarspec crc {quote(sample.source)}"
        )
    return None


def make_no_scan_error(device: Device, source: str, seconds: float | None = None) -> LidarSpecError:
    """Return the error that says why a source has no scan."""
    sensor = device.sensor
    stats = device.stats
    if (failure := stats.failure(sensor.id)) is not None:
        return failure
    if not device.is_live:
        if stats.bytes_in and (instead := identify_file(sensor, source)):
            return suggest(
                WireError(f"{source} {instead[0]}", sensor=sensor.id), f"repeat with {instead[1]}"
            )
        sample = None if stats.frames else reread(source)
        if sample is not None and (fault := _make_wrong_checksums_error(sample)) is not None:
            return fault
        if sample is not None and sample.is_text:
            error = WireError(f"{source} is text without a data frame: {stats}", sensor=sensor.id)
            return suggest(error, f"lidarspec detect {quote(source)}")
        if stats.bytes_in:
            reason = "; ".join([f"{source} has no data frame: {stats}", *device.warnings])
        else:
            reason = no_bytes_message(source, device.warnings)
        return suggest(
            WireError(reason, sensor=sensor.id), f"lidarspec explain {quote(source)} -s {sensor.id}"
        )
    if seconds is None:
        waited = ""
    else:
        waited = f" within {seconds:.1f} s".replace(".0 s", " s")
    if stats.bytes_in == 0:
        others = ""
        if stats.foreign:
            others = f"; other senders sent {stats.foreign} datagrams"
        return suggest(
            CommandError(f"{sensor.id} on {source} sent nothing{waited}{others}"),
            f"lidarspec doctor {quote(source)} -s {sensor.id}",
        )
    error = WireError(
        f"{source}: received {stats.bytes_in} bytes{waited}, but no complete scan: {stats}",
        sensor=sensor.id,
    )
    return suggest(error, f"lidarspec detect {quote(source)}")


def report_outcome(device: Device) -> None:
    """Print the options that the sensor reported, and the warnings, after reading a source.

    Raises:
        PluginError: if the plugin raised an exception for some packets.
        click.exceptions.Exit: with exit code 1, if a corrupt part of the source could not be read.
    """
    failure = device.stats.failure(device.sensor.id)
    for name, value in device.learned.items():
        note(
            f"{device.sensor.id} reported its {name}:"
            f" {f'{len(value)} bytes' if isinstance(value, bytes) else value}"
        )
    for warning in device.warnings:
        if failure is None or warning != str(failure):
            note(warning)
    if failure is not None:
        raise failure
    exit_if_damaged(device.stats.unread)


def exit_if_damaged(unread: int) -> None:
    """Exit with code 1 if a corrupt part of a source could not be read.

    Args:
        unread: number of bytes that could not be read, from `Transport.unread`.
    """
    if unread:
        raise click.exceptions.Exit(FINDINGS)


def reread(source: str) -> SampleBytes | None:
    """Read the beginning of a file again; return None if that is not possible."""
    from lidarspec.transports.open_url import open_transport

    if not Path(source.partition("?")[0]).is_file():
        return None
    with contextlib.closing(open_transport(source)) as file:
        try:
            chunks = tuple(chunk.data for chunk in read_beginning(file, MAX_SAMPLE_BYTES))
            return SampleBytes(source, chunks, file.datagrams, warnings=tuple(file.warnings))
        except LidarSpecError:
            return None


def identify_file(sensor: Sensor, source: str) -> tuple[str, str] | None:
    """Identify a file that has no data frame of `sensor`.

    Returns:
        A description of the content, and the options to read the file; None if no sensor fits.
    """
    from lidarspec.detect.identification import format_sensor_options, identify_sample

    sample = reread(source)
    scores = identify_sample(sample).scores if sample is not None else ()
    own = next((score.sensor.options for score in scores if score.sensor.id == sensor.id), None)
    if own:
        assignments = " and ".join(f"{name}={value}" for name, value in own.items())
        return (
            f"does not contain the sensor's settings: to read the data frames, set {assignments}",
            format_sensor_options(sensor.configure(**own)),
        )
    others = [score.sensor for score in scores if score.sensor.id != sensor.id]
    if not others:
        return None
    return (
        (
            "has no data frame of this sensor, but has frames of"
            f" {', '.join(other.id for other in others)}"
        ),
        format_sensor_options(others[0]),
    )


def require_points(device: Device, source: str) -> None:
    """Raise a UsageError for a sensor without points."""
    sensor = device.sensor
    if not sensor.has_points:
        frames = ", ".join(sensor.incoming)
        error = UsageError(f"{sensor.id} measures no points; it sends the frames {frames}")
        frame = next(iter(sensor.incoming), "FRAME")
        raise suggest(error, f"lidarspec read {quote(source)} -s {sensor.id} -f {frame}")


class FirstFrameTimeout:
    """A timeout for the first frame of a live source.

    Args:
        frame: the frame type to wait for; by default any data frame.
    """

    def __init__(self, device: Device, source: str, frame: str | None = None) -> None:
        self._device = device
        self._source = source
        self._began = time.monotonic()
        if frame is None:
            self._awaited = device.sensor.main_frames
        else:
            self._awaited = (frame,)

    def check(self) -> None:
        """Raise an error if the timeout has passed without a data frame.

        Raises:
            CommandError: if the device has sent nothing.
            WireError: if the device has sent no frame of the sensor.
        """
        waited = time.monotonic() - self._began
        if (
            waited > FIRST_FRAME_TIMEOUT_S
            and self._device.is_live
            and not any(name in self._device.stats.frames for name in self._awaited)
        ):
            raise make_no_scan_error(self._device, self._source, waited)


def iter_device_scans(
    device: Device, source: str, select: Selection | None = None, *, until: float = math.inf
) -> Iterator[Scan]:
    """Yield the selected scans of a device.

    Args:
        select: the scans to yield; by default all.
        until: a time of `time.monotonic` at which to end.

    Raises:
        CommandError: if the device sends nothing until a timeout.
        WireError: if the device sends no frame of the sensor until a timeout.
        UsageError: if none of the scans is selected.
    """
    patience = FirstFrameTimeout(device, source)
    for scan in device.scans(wait=POLL_S, select=select):
        if scan is not None:
            yield scan
            del scan
        patience.check()
        if time.monotonic() >= until:
            return
