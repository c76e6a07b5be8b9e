"""Bytes out of any source, to find out whose they are: the beginning of a file, or a second of what
comes over a live one.

Some sensors keep silent until they are started: `probe` sends their start commands, and hears what
comes back.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lidarspec.detect.heard import LOOKED_AT, Heard, beginning
from lidarspec.device.session import Pending, Session
from lidarspec.errors import LidarSpecError
from lidarspec.framing.decoder import Decoder
from lidarspec.plugins import sensors
from lidarspec.spec.links import Serial, Udp
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.addresses import with_option
from lidarspec.transports.base import data_link
from lidarspec.transports.open_url import live, live_address, transport
from lidarspec.transports.protocol import Chunk, Disconnected, LiveTransport, endpoint, sender_names

#: datagrams that are looked at; of a live source, bytes that are enough.
DATAGRAMS = 400
PLENTY = 1 << 14
#: seconds to listen for, and between two looks.
LISTEN = 1.2
LOOK = 0.1
#: seconds to wait for data: of a device that has answered, and a motor may have to come up; and of
#: one that has not.
ANSWERED = 4.0
UNANSWERED = 1.0
#: seconds that one read takes at most, and after which the line counts as silent.
TURN = 0.05
#: seconds for the commands that stop it again.
STOPPING = 2.0


def bauds() -> list[int]:
    """The baud rates that installed sensors declare, those of the most sensors first."""
    declared = [
        baud
        for sensor in sensors().values()
        for link in sensor.links.values()
        if isinstance(link, Serial)
        for baud in link.bauds
    ]
    return sorted(set(declared), key=lambda baud: (-declared.count(baud), baud))


def udp_ports() -> list[int]:
    """The UDP ports that data of installed sensors come to."""
    links = (data_link(sensor, Udp) for sensor in sensors().values())
    return sorted({port for link in links if link for port in link.ports})


def ignore(_: str) -> None:
    """Do nothing with what is being listened to: nobody watches."""


def hear(
    source: str | Path, *, seconds: float = LISTEN, tell: Callable[[str], None] = ignore
) -> Iterator[Heard]:
    """What comes from a source; a serial port whose baud rate is not given, once for each that
    installed sensors declare.

    If a serial port is silent at the commonest, the lowest and the highest rate, no other rate is
    tried: what is sent at one rate arrives at another one as wrong bytes, but it arrives.

    Args:
        seconds: to listen for, each time.
        tell: called with what is being listened to, before each time.

    Raises:
        SourceError: where it cannot be opened.
    """
    text = str(source)
    address = live_address(source)
    if address is not None and address.scheme == "serial" and "baud" not in address.options:
        if has_no_baud(address.place):
            tell(text)
            yield from _heard(with_option(text, "baud", bauds()[0]), seconds, None, text)
            return
        rates = bauds()
        first_rates = list(dict.fromkeys([rates[0], min(rates), max(rates)]))
        other_rates = [baud for baud in rates if baud not in first_rates]
        is_silent = True
        for baud in first_rates + other_rates:
            if is_silent and baud in other_rates:
                return
            tell(f"{text} at {baud} baud")
            for heard in _heard(with_option(text, "baud", baud), seconds, baud, text):
                is_silent = is_silent and not heard.size
                yield heard
    elif (
        address is not None
        and address.scheme == "udp"
        and not address.host_and_port()[1]
        and "port" not in address.options
    ):
        yield from _heard(
            with_option(text, "port", ",".join(map(str, udp_ports()))), seconds, None, text
        )
    else:
        yield from _heard(
            text,
            seconds,
            int(address.options["baud"])
            if address is not None and "baud" in address.options
            else None,
            text,
        )


def has_no_baud(port: str) -> bool:
    """Whether a port is a pseudo-terminal, at which every baud rate is the same."""
    return os.path.realpath(port).startswith("/dev/pts/")


def _heard(source: str, seconds: float, baud: int | None, name: str) -> Iterator[Heard]:
    with contextlib.closing(transport(source)) as opened:
        number = DATAGRAMS if opened.datagrams else None
        if isinstance(opened, LiveTransport):
            chunks = _listened(opened, seconds)
        else:
            chunks = beginning(opened, LOOKED_AT, number=number)
        if not isinstance(opened, LiveTransport):
            said = tuple(opened.warnings)
        elif chunks:
            said = ()
        else:
            said = _strangers(opened)
    yield from _by_sender(Heard(name, (), opened.datagrams, baud, warnings=said), chunks)


def _strangers(opened: LiveTransport) -> tuple[str, ...]:
    """That others send, and not the one that is asked for."""
    if opened.stranger is None:
        return ()
    others = f"{opened.foreign} datagrams came from others, such as {endpoint(opened.stranger)}"
    return (f"{opened.label}: nothing came from the sender that is asked for, and {others}",)


def _by_sender(heard: Heard, chunks: Sequence[Chunk]) -> Iterator[Heard]:
    """What was heard, of each sender; of a single one without a name."""
    names = sender_names((chunk.sender, chunk.receiver) for chunk in chunks)
    by_sender: dict[str, list[Chunk]] = {name: [] for name in names.values()} or {"": []}
    for chunk in chunks:
        by_sender[names[chunk.sender]].append(chunk)
    for sender, sent in by_sender.items():
        ports = frozenset(chunk.receiver[1] for chunk in sent if chunk.receiver is not None)
        data = tuple(chunk.data for chunk in sent)
        yield replace(heard, chunks=data, sender=sender if len(by_sender) > 1 else "", ports=ports)


def heard_as(source: str | Path, sensor: Sensor, seconds: float) -> list[Heard]:
    """What comes over a live source within some seconds, of each sender, where it is opened as a
    sensor declares; [] where nothing does.
    """
    address = live_address(source)
    chunks = list[Chunk]()
    with contextlib.closing(transport(source, sensor)) as opened:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and isinstance(opened, LiveTransport):
            chunks += opened.read(min(left, LOOK))
    if address is not None and has_no_baud(address.place):
        baud = None
    else:
        baud = opened.baud
    if chunks:
        return list(_by_sender(Heard(str(source), (), opened.datagrams, baud), chunks))
    return []


def _listened(opened: LiveTransport, seconds: float) -> list[Chunk]:
    """What comes within some seconds, or as soon as it is plenty."""
    chunks: list[Chunk] = []
    end = time.monotonic() + seconds
    with contextlib.suppress(Disconnected):
        while (left := end - time.monotonic()) > 0 and sum(
            len(chunk.data) for chunk in chunks
        ) < PLENTY:
            chunks += opened.read(min(left, LOOK))
    return chunks


def started_first() -> list[Sensor]:
    """The installed sensors on a serial port that send nothing before they are told to."""
    told = [
        sensor
        for sensor in sensors().values()
        if any(sensor.commands[name].starts for name in sensor.on_open)
    ]
    return [sensor for sensor in told if data_link(sensor, Serial)]


def probe(source: str | Path) -> Iterator[Heard]:
    """What comes after the start commands of each sensor that needs them, at each of its baud
    rates; it is stopped again.

    Raises:
        SourceError: where the port cannot be opened.
    """
    address = live_address(source)
    tried = set[object]()
    if address is None or address.scheme != "serial":
        return
    plain = has_no_baud(address.place)
    for sensor in started_first():
        link = data_link(sensor, Serial)
        for baud in link.bauds if link else ():
            asked = (None if plain else baud, *(sensor.command(name) for name in sensor.on_open))
            if asked in tried or address.options.get("baud", str(baud)) != str(baud):
                continue
            tried.add(asked)
            if "baud" in address.options:
                given = str(source)
            else:
                given = with_option(source, "baud", baud)
            with contextlib.closing(live(given, sensor)) as opened:
                chunks = _Probe(sensor, opened).run()
            yield Heard(str(source), tuple(chunks), baud=None if plain else baud)


class _Probe:
    """One conversation with a port."""

    def __init__(self, sensor: Sensor, opened: LiveTransport) -> None:
        self._sensor = sensor
        self._opened = opened
        self._session = Session(sensor)
        self._decoder = Decoder(sensor, stream=True)
        self._heard: list[bytes] = []

    def run(self) -> list[bytes]:
        """Everything that was heard between start and stop."""
        try:
            started = self._asked(self._sensor.on_open)
            self._turns(lambda: all(pending.done for pending in started), ANSWERED)
            self._turns(
                lambda: sum(map(len, self._heard)) >= PLENTY,
                ANSWERED if any(map(_answered, started)) else UNANSWERED,
            )
            found = list(self._heard)
            stopped = self._asked(self._sensor.on_close)
            self._turns(lambda: all(pending.done for pending in stopped), STOPPING)
        except LidarSpecError:
            return self._heard
        return found

    def _asked(self, names: tuple[str, ...]) -> list[Pending]:
        self._session.abandon("asked for something else")
        return [self._session.request(name, time.monotonic_ns()) for name in names]

    def _turns(self, done: Callable[[], bool], seconds: float) -> None:
        """Send, listen and keep time until something is so, or the time is up."""
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end:
            self._session.tick(time.monotonic_ns())
            for out in self._session.outgoing():
                if out.lines:
                    self._opened.lines(**out.lines)
                self._opened.write(out.data)
            chunks = self._opened.read(TURN)
            if chunks:
                found = [item for chunk in chunks for item in self._decoder.feed(chunk.data)]
            else:
                found = self._decoder.idle()
            self._heard += [chunk.data for chunk in chunks]
            self._session.receive(found, time.monotonic_ns())


def _answered(pending: Pending) -> bool:
    try:
        return pending.done and pending.result().confirmed
    except LidarSpecError:
        return False
