"""Functions that live transports share: read a stream, wait, and describe system errors."""

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

#: Pause after a read, during which bytes accumulate. Without it, each byte of a fast serial line
#: would cause a read.
READ_PAUSE_S = 0.002
L = TypeVar("L", bound=Link)
_Descriptor = int | socket.socket
#: `select` supports only descriptors up to 1,023, so `poll` is preferred. Windows has only
#: `select`, without this limit.
_Selector = getattr(selectors, "PollSelector", selectors.SelectSelector)


class StreamTransport(LiveTransport):
    """Base class of transports for byte streams.

    After each read there is a short pause, in which bytes accumulate. The following read then
    returns many bytes at once instead of single bytes.

    Attributes:
        disconnect_errors: the exceptions that reading raises if the device is disconnected.
    """

    disconnect_errors: tuple[type[BaseException], ...] = (OSError, ValueError)

    def __init__(self, label: str, sensor: Sensor | None) -> None:
        self.label = label
        self._sensor = sensor
        self._clock = HostClock()
        self._pause_end_s = 0.0

    def read(self, timeout: float) -> list[Chunk]:
        sleep_until(self._pause_end_s)
        try:
            data = self._receive(timeout)
        except self.disconnect_errors as error:
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
        """Return the bytes that have arrived; b"" if none arrive for `timeout` seconds."""


def sleep_until(end_s: float) -> None:
    """Sleep until a time of the monotonic clock."""
    pause = end_s - time.monotonic()
    if pause > 0:
        time.sleep(pause)


def wait_readable(descriptor: int, timeout: float) -> bool:
    """Wait until a descriptor has input or is closed at the other end.

    Returns:
        False if the timeout has passed.
    """
    return bool(wait_ready([descriptor], [], timeout)[0])


def wait_ready(
    reading: Collection[_Descriptor], writing: Collection[_Descriptor], timeout: float
) -> tuple[list[Any], list[Any]]:
    """Wait until a descriptor is ready, at most `timeout` seconds.

    Returns:
        The descriptors of `reading` that have input or are closed at the other end, and the
        descriptors of `writing` that can be written to.
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


def source_error(text: str, command: str) -> SourceError:
    """Return a SourceError that suggests a command."""
    return suggest(SourceError(text), command)


def disconnected_error(label: str, error: BaseException | str) -> Disconnected:
    """Return the error for a device that has disappeared."""
    return Disconnected(f"{label}: the connection was lost: {system_reason(error)}")


def system_reason(error: BaseException | str) -> str:
    """Return the system's text for an error, without the text that pyserial adds."""
    if isinstance(error, BaseException):
        numbers = error_numbers(error)
    else:
        numbers = []
    if numbers:
        return os.strerror(numbers[0])
    return str(error)


def error_numbers(error: BaseException) -> list[int]:
    """Return the system error numbers in the arguments of an exception."""
    return [number for number in error.args if isinstance(number, int)]


def find_data_link(sensor: Sensor | None, kind: type[L]) -> L | None:
    """Return the data link of a sensor; None if it is not of class `kind`."""
    if sensor is not None:
        link = sensor.links.get("data")
    else:
        link = None
    if isinstance(link, kind):
        return link
    return None


def sensor_option(sensor: Sensor | None) -> str:
    """Return the option " -s ID" for a suggested command; "" without a sensor."""
    if sensor is not None:
        return f" -s {sensor.id}"
    return ""
