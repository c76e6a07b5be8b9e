"""Read sample bytes from a source, to identify the sensor that sent them.

`read_samples` reads the beginning of a file, or listens to a live source. `probe` also starts
sensors that send nothing until they receive a command.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lidarspec.detect.sample_bytes import MAX_SAMPLE_BYTES, SampleBytes, read_beginning
from lidarspec.device.session import PendingReply, Session
from lidarspec.errors import LidarSpecError, SourceError
from lidarspec.framing.decoder import Decoder
from lidarspec.plugins import sensors
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Serial, Udp
from lidarspec.transports.addresses import with_option
from lidarspec.transports.base import find_data_link
from lidarspec.transports.open_url import live_address, open_live, open_transport
from lidarspec.transports.protocol import (
    Chunk,
    Disconnected,
    LiveTransport,
    format_sender,
    name_senders,
)

#: The maximum number of datagrams to read from a file.
MAX_FILE_DATAGRAMS = 400
#: The number of bytes after which listening to a live source stops.
ENOUGH_BYTES = 1 << 14
#: The time to listen to a live source.
LISTEN_S = 1.2
#: The maximum duration of one read while listening.
LISTEN_READ_S = 0.1
#: The time to wait for data after a device has replied to a start command. Its motor may need time.
DATA_TIMEOUT_S = 4.0
#: The time to wait for data if a device has not replied.
UNCONFIRMED_DATA_TIMEOUT_S = 1.0
#: The maximum duration of one read while probing. If nothing arrives in this time, the line is
#: idle.
PROBE_READ_S = 0.05
#: The time to wait for replies to the stop commands.
STOP_TIMEOUT_S = 2.0
#: The baud rate for a pseudo-terminal, which ignores it, and for examples in messages.
ANY_BAUD = 115_200
#: UDP port for examples in messages.
EXAMPLE_PORT = 2368


def list_bauds() -> list[int]:
    """Return the declared baud rates of installed sensors, the most common first."""
    declared = [
        baud
        for sensor in sensors().values()
        for link in sensor.links.values()
        if isinstance(link, Serial)
        for baud in link.bauds
    ]
    return sorted(set(declared), key=lambda baud: (-declared.count(baud), baud))


def list_udp_ports() -> list[int]:
    """Return the UDP ports that installed sensors declare for data."""
    links = (find_data_link(sensor, Udp) for sensor in sensors().values())
    return sorted({port for link in links if link for port in link.ports})


def ignore_progress(_: str) -> None:
    """Do nothing. This is the default of `read_samples(on_progress=...)`."""


def read_samples(
    source: str | Path,
    *,
    seconds: float = LISTEN_S,
    on_progress: Callable[[str], None] = ignore_progress,
) -> Iterator[SampleBytes]:
    """Yield the bytes of each sender of a source.

    For a serial port without a baud rate, tries the baud rates that installed sensors declare.

    Args:
        seconds: the time to listen to a live source, at each baud rate.
        on_progress: called with a description of the source before each attempt.

    Raises:
        SourceError: if the source cannot be opened, or if its baud rate or port is unknown.
    """
    text = str(source)
    address = live_address(source)
    if address is not None and address.scheme == "serial" and "baud" not in address.options:
        if has_no_baud(address.location):
            on_progress(text)
            yield from _read_sample(with_option(text, "baud", ANY_BAUD), seconds, None, text)
            return
        rates = list_bauds()
        if not rates:
            example = with_option(text, "baud", ANY_BAUD)
            raise SourceError(
                f"{text}: no installed sensor declares a baud rate. Add the rate to the source:"
                f" {example}"
            )
        first_rates = list(dict.fromkeys([rates[0], min(rates), max(rates)]))
        other_rates = [baud for baud in rates if baud not in first_rates]
        is_silent = True
        for baud in first_rates + other_rates:
            # a sensor that sends would cause some bytes at one of the first rates
            if is_silent and baud in other_rates:
                return
            on_progress(f"{text} at {baud} baud")
            for sample in _read_sample(with_option(text, "baud", baud), seconds, baud, text):
                is_silent = is_silent and not sample.size
                yield sample
    elif (
        address is not None
        and address.scheme == "udp"
        and not address.host_and_port()[1]
        and "port" not in address.options
    ):
        ports = ",".join(map(str, list_udp_ports()))
        if not ports:
            example = with_option(text, "port", EXAMPLE_PORT)
            raise SourceError(
                f"{text}: no installed sensor declares a port. Add a port to the source: {example}"
            )
        yield from _read_sample(with_option(text, "port", ports), seconds, None, text)
    else:
        baud = None
        if address is not None and "baud" in address.options:
            baud = int(address.options["baud"])
        yield from _read_sample(text, seconds, baud, text)


def has_no_baud(port: str) -> bool:
    """Return whether a port has no baud rate, because it is a pseudo-terminal."""
    return os.path.realpath(port).startswith("/dev/pts/")


def _read_sample(source: str, seconds: float, baud: int | None, name: str) -> Iterator[SampleBytes]:
    with contextlib.closing(open_transport(source)) as opened:
        max_chunks = MAX_FILE_DATAGRAMS if opened.datagrams else None
        warnings: tuple[str, ...] = ()
        if isinstance(opened, LiveTransport):
            chunks = _read_chunks(opened, seconds)
            if not chunks:
                warnings = _make_sender_warnings(opened)
        else:
            chunks = read_beginning(opened, MAX_SAMPLE_BYTES, max_chunks=max_chunks)
            warnings = tuple(opened.warnings)
    yield from _split_by_sender(
        SampleBytes(name, (), opened.datagrams, baud, warnings=warnings), chunks
    )


def _make_sender_warnings(opened: LiveTransport) -> tuple[str, ...]:
    """Return a warning if datagrams came, but none from the requested sender."""
    if opened.other_sender is None:
        return ()
    example = format_sender(opened.other_sender)
    others = f"{opened.foreign} datagrams came from other senders, such as {example}"
    return (f"{opened.label}: no data from the requested sender; {others}",)


def _split_by_sender(sample: SampleBytes, chunks: Sequence[Chunk]) -> Iterator[SampleBytes]:
    """Yield a copy of `sample` for each sender, with the chunks of the sender."""
    names = name_senders((chunk.sender, chunk.receiver) for chunk in chunks)
    by_sender: dict[str, list[Chunk]] = {name: [] for name in names.values()} or {"": []}
    for chunk in chunks:
        by_sender[names[chunk.sender]].append(chunk)
    for sender, sent in by_sender.items():
        ports = frozenset(chunk.receiver[1] for chunk in sent if chunk.receiver is not None)
        data = tuple(chunk.data for chunk in sent)
        yield replace(sample, chunks=data, sender=sender if len(by_sender) > 1 else "", ports=ports)


def read_sensor_sample(source: str | Path, sensor: Sensor, seconds: float) -> list[SampleBytes]:
    """Listen to a live source with the link settings of a sensor.

    Returns:
        The bytes of each sender; an empty list if nothing arrives in time.
    """
    address = live_address(source)
    chunks = list[Chunk]()
    with contextlib.closing(open_transport(source, sensor)) as opened:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and isinstance(opened, LiveTransport):
            chunks += opened.read(min(left, LISTEN_READ_S))
    if address is not None and has_no_baud(address.location):
        baud = None
    else:
        baud = opened.baud
    if chunks:
        return list(_split_by_sender(SampleBytes(str(source), (), opened.datagrams, baud), chunks))
    return []


def _read_chunks(opened: LiveTransport, seconds: float) -> list[Chunk]:
    """Read chunks for some seconds, or until `ENOUGH_BYTES` have arrived."""
    chunks: list[Chunk] = []
    size = 0
    end = time.monotonic() + seconds
    with contextlib.suppress(Disconnected):
        while (left := end - time.monotonic()) > 0 and size < ENOUGH_BYTES:
            arrived = opened.read(min(left, LISTEN_READ_S))
            chunks += arrived
            size += sum(len(chunk.data) for chunk in arrived)
    return chunks


def list_start_required() -> list[Sensor]:
    """Return the installed serial sensors that send no data before a start command."""
    started = [
        sensor
        for sensor in sensors().values()
        if any(sensor.commands[name].starts for name in sensor.on_open)
    ]
    return [sensor for sensor in started if find_data_link(sensor, Serial)]


def probe(source: str | Path) -> Iterator[SampleBytes]:
    """Start the sensors on a serial port, and yield the bytes that they send.

    Sends the start commands of the installed sensors at each of their baud rates, and the stop
    commands afterwards. For any other source, yields nothing.

    Raises:
        SourceError: if the port cannot be opened.
    """
    address = live_address(source)
    tried = set[object]()
    if address is None or address.scheme != "serial":
        return
    ignores_baud = has_no_baud(address.location)
    for sensor in list_start_required():
        link = find_data_link(sensor, Serial)
        for baud in link.bauds if link else ():
            commands = [sensor.command(name) for name in sensor.on_open]
            attempt = (None if ignores_baud else baud, *commands)
            if attempt in tried or address.options.get("baud", str(baud)) != str(baud):
                continue
            tried.add(attempt)
            if "baud" in address.options:
                text = str(source)
            else:
                text = with_option(source, "baud", baud)
            with contextlib.closing(open_live(text, sensor)) as opened:
                chunks = _StartProbe(sensor, opened).run()
            yield SampleBytes(str(source), tuple(chunks), baud=None if ignores_baud else baud)


class _StartProbe:
    """Starts a sensor, reads its data, and stops it."""

    def __init__(self, sensor: Sensor, opened: LiveTransport) -> None:
        self._sensor = sensor
        self._opened = opened
        self._session = Session(sensor)
        self._decoder = Decoder(sensor, stream=True)
        self._sample: list[bytes] = []

    def run(self) -> list[bytes]:
        """Start the sensor, stop it again, and return all bytes that were received."""
        try:
            started = self._request(self._sensor.on_open)
            self._exchange(lambda: all(pending.done for pending in started), DATA_TIMEOUT_S)
            if any(map(_is_confirmed, started)):
                timeout = DATA_TIMEOUT_S
            else:
                timeout = UNCONFIRMED_DATA_TIMEOUT_S
            self._exchange(lambda: sum(map(len, self._sample)) >= ENOUGH_BYTES, timeout)
            sample = list(self._sample)
            stopped = self._request(self._sensor.on_close)
            self._exchange(lambda: all(pending.done for pending in stopped), STOP_TIMEOUT_S)
        except LidarSpecError:
            return self._sample
        return sample

    def _request(self, names: tuple[str, ...]) -> list[PendingReply]:
        self._session.abandon("another command was sent")
        return [self._session.request(name, time.monotonic_ns()) for name in names]

    def _exchange(self, is_done: Callable[[], bool], timeout: float) -> None:
        """Send and receive until `is_done` returns True, or for `timeout` seconds."""
        end = time.monotonic() + timeout
        while not is_done() and time.monotonic() < end:
            self._session.tick(time.monotonic_ns())
            for out in self._session.take_outgoing():
                if out.lines:
                    self._opened.lines(**out.lines)
                self._opened.write(out.data)
            chunks = self._opened.read(PROBE_READ_S)
            if chunks:
                frames = [item for chunk in chunks for item in self._decoder.feed(chunk.data)]
            else:
                frames = self._decoder.idle()
            self._sample += [chunk.data for chunk in chunks]
            self._session.receive(frames, time.monotonic_ns())


def _is_confirmed(pending: PendingReply) -> bool:
    try:
        return pending.done and pending.result().confirmed
    except LidarSpecError:
        return False
