"""Functions of all live transports: reading a stream, waiting, system errors."""

from __future__ import annotations

import os
import selectors
import socket
import time
from abc import abstractmethod
from collections.abc import Collection
from typing import Any, TypeVar

from lidarspec.errors import SourceError, suggest
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Link
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import Chunk, Disconnected, LiveTransport

#: The pause after a read, in which a fast line gathers bytes: otherwise each byte is a read.
READ_PAUSE_S = 0.002
L = TypeVar("L", bound=Link)
_Descriptor = int | socket.socket
#: `select` supports no descriptor above 1,023. Windows has nothing else, and does not number its
#: descriptors in this way.
_Selector = getattr(selectors, "PollSelector", selectors.SelectSelector)


class StreamTransport(LiveTransport):
    """A byte stream that is read as it arrives, with a short pause after each read.

    Attributes:
        gone: the exceptions that a disconnected line raises.
    """

    gone: tuple[type[BaseException], ...] = (OSError, ValueError)

    def __init__(self, label: str, sensor: Sensor | None) -> None:
        self.label = label
        self._sensor = sensor
        self._clock = HostClock()
        self._pause_end_s = 0.0

    def read(self, timeout: float) -> list[Chunk]:
        sleep_until(self._pause_end_s)
        try:
            data = self._receive(timeout)
        except self.gone as error:
            if self.closed:
                return []
            raise disconnected_error(self.label, error) from None
        if not data:
            self._pause_end_s = 0.0
            return []
        self._pause_end_s = time.monotonic() + READ_PAUSE_S
        return [Chunk(data, self._clock.now())]

    @abstractmethod
    def _receive(self, timeout: float) -> bytes:
        """Return what has arrived; nothing if nothing arrives for `timeout` seconds."""


def sleep_until(end_s: float) -> None:
    """Sleep until a time of the monotonic clock."""
    pause = end_s - time.monotonic()
    if pause > 0:
        time.sleep(pause)


def wait_readable(descriptor: int, timeout: float) -> bool:
    """Wait until a descriptor has input, or its other side has hung up; False after `timeout` s."""
    return bool(wait_ready([descriptor], [], timeout)[0])


def wait_ready(
    reading: Collection[_Descriptor], writing: Collection[_Descriptor], timeout: float
) -> tuple[list[Any], list[Any]]:
    """Wait until a descriptor is ready, at most `timeout` seconds.

    Returns:
        Those of `reading` that have input or have been hung up, and those of `writing` that have
        room.
    """
    with _Selector() as selector:
        for descriptor in {*reading, *writing}:
            events = 0
            if descriptor in reading:
                events |= selectors.EVENT_READ
            if descriptor in writing:
                events |= selectors.EVENT_WRITE
            selector.register(descriptor, events)
        ready = selector.select(timeout)
    readable = [key.fileobj for key, events in ready if events & selectors.EVENT_READ]
    writable = [key.fileobj for key, events in ready if events & selectors.EVENT_WRITE]
    return readable, writable


def source_error(text: str, following: str) -> SourceError:
    """Return a SourceError with the next command to type."""
    return suggest(SourceError(text), following)


def disconnected_error(label: str, error: BaseException | str) -> Disconnected:
    """Return the error for a device that went away."""
    return Disconnected(f"{label}: the connection was lost: {system_reason(error)}")


def system_reason(error: BaseException | str) -> str:
    """Return the text of the system for an error, without the words that pyserial adds to it."""
    if isinstance(error, BaseException):
        numbers = error_numbers(error)
    else:
        numbers = []
    if numbers:
        return os.strerror(numbers[0])
    return str(error)


def error_numbers(error: BaseException) -> list[int]:
    """Return the error numbers of the system among the arguments of an exception."""
    return [number for number in error.args if isinstance(number, int)]


def data_link(sensor: Sensor | None, kind: type[L]) -> L | None:
    """Return the data link of a sensor if it is of this kind."""
    if sensor is not None:
        link = sensor.links.get("data")
    else:
        link = None
    if isinstance(link, kind):
        return link
    return None


def sensor_option(sensor: Sensor | None) -> str:
    """Return the option that names a sensor in a command to type, after a space."""
    if sensor is not None:
        return f" -s {sensor.id}"
    return ""
