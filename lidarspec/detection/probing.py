"""Sensors that keep silent until they are started: their start commands are sent, and what comes back is heard."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from lidarspec.decoder import Decoder
from lidarspec.detection.hearing import PLENTY, Heard, has_no_baud
from lidarspec.errors import LidarSpecError
from lidarspec.files import LiveTransport
from lidarspec.links import Serial
from lidarspec.plugins import sensors
from lidarspec.replies import Pending
from lidarspec.session import Session
from lidarspec.sources import live_address, transport
from lidarspec.spec import Sensor

#: seconds to wait for data: of a device that has answered, and a motor may have to come up; and of one that has not.
ANSWERED, UNANSWERED = 4.0, 1.0
#: seconds that one read takes at most, and after which the line counts as silent.
TURN = 0.05
#: seconds for the commands that stop it again.
STOPPING = 2.0


def started_first() -> list[Sensor]:
    """The installed sensors on a serial port that send nothing before they are told to."""
    return [sensor for sensor in sensors().values() if _starts(sensor) and isinstance(sensor.links.get("data"), Serial)]


def probe(source: str | Path) -> Iterator[Heard]:
    """What comes after the start commands of each sensor that needs them, at each of its baud rates; it is stopped again.

    Raises:
        SourceError: where the port cannot be opened.
    """
    address, tried = live_address(source), set[object]()
    if address is None or address.scheme != "serial":
        return
    mark, plain = "&" if "?" in str(source) else "?", has_no_baud(address.place)
    for sensor in started_first():
        link = sensor.links["data"]
        for baud in link.bauds if isinstance(link, Serial) else ():
            asked = (None if plain else baud, *(sensor.command(name) for name in sensor.on_open))
            if asked in tried or address.options.get("baud", str(baud)) != str(baud):
                continue
            tried.add(asked)
            given = str(source) if "baud" in address.options else f"{source}{mark}baud={baud}"
            opened: LiveTransport = transport(given, sensor)  # type: ignore[assignment]
            try:
                chunks = _Probe(sensor, opened).run()
            finally:
                opened.close()
            yield Heard(str(source), tuple(chunks), baud=None if plain else baud)


def _starts(sensor: Sensor) -> bool:
    return any(sensor.commands[name].starts for name in sensor.on_open)


class _Probe:
    """One conversation with a port."""

    def __init__(self, sensor: Sensor, opened: LiveTransport) -> None:
        self._sensor, self._opened = sensor, opened
        self._session, self._decoder = Session(sensor), Decoder(sensor, stream=True)
        self._heard: list[bytes] = []

    def run(self) -> list[bytes]:
        """Everything that was heard between start and stop."""
        try:
            started = self._asked(self._sensor.on_open)
            self._turns(lambda: all(pending.done for pending in started), ANSWERED)
            self._turns(lambda: sum(map(len, self._heard)) >= PLENTY, ANSWERED if any(map(_answered, started)) else UNANSWERED)
            found = list(self._heard)
            stopped = self._asked(self._sensor.on_close)
            self._turns(lambda: all(pending.done for pending in stopped), STOPPING)
        except LidarSpecError:
            return self._heard
        return found

    def _asked(self, names: tuple[str, ...]) -> list[Pending]:
        self._session.abandon("asked for something else")
        return [self._session.request(name, time.monotonic_ns()) for name in names]

    def _turns(self, done: object, seconds: float) -> None:
        """Send, listen and keep time until something is so, or the time is up."""
        assert callable(done)
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end:
            self._session.tick(time.monotonic_ns())
            for out in self._session.outgoing():
                if out.lines:
                    self._opened.lines(**out.lines)
                self._opened.write(out.data)
            chunks = self._opened.read(TURN)
            found = [item for chunk in chunks for item in self._decoder.feed(chunk.data)] if chunks else self._decoder.idle()
            self._heard += [chunk.data for chunk in chunks]
            self._session.receive(found, time.monotonic_ns())


def _answered(pending: Pending) -> bool:
    try:
        return pending.done and pending.result().confirmed
    except LidarSpecError:
        return False
