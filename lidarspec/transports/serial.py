"""Read and write serial ports.

A port is opened exclusively. After a disconnection, it can be opened again. If the device
disappears, pyserial raises SerialException, OSError or `termios.error`. If another thread closes
the port during a read, pyserial raises TypeError.

On POSIX systems, the port is read through its descriptor, with pauses between reads, so that the
thread does not wake up for every byte.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from shlex import quote

import serial

from lidarspec.errors import SourceError, UsageError
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Serial
from lidarspec.transports.addresses import SourceAddress
from lidarspec.transports.base import (
    StreamTransport,
    disconnected_error,
    error_numbers,
    find_data_link,
    sensor_option,
    source_error,
    system_reason,
    wait_readable,
    wait_ready,
)

try:
    from termios import error as TermiosError
except ImportError:  # no POSIX
    TermiosError = OSError  # type: ignore[assignment,misc]

#: the exceptions that a port raises if the device has disappeared.
DISCONNECT_ERRORS = (serial.SerialException, OSError, TermiosError, TypeError, ValueError)
#: maximum number of bytes per read.
MAX_READ_BYTES = 1 << 16
#: maximum time until a device has accepted written bytes.
WRITE_TIMEOUT_S = 2.0
#: options of a serial SOURCE.
OPTIONS = ("baud", "dtr", "rts")


class SerialTransport(StreamTransport):
    """A serial port with 8 data bits, no parity and 1 stop bit.

    Args:
        dtr: level of the control line DTR while the port is open; None does not set it.
        rts: level of the control line RTS while the port is open; None does not set it.
        sensor: the sensor; None if unknown. Its longest frame determines when the line counts as
            silent.

    Raises:
        SourceError: if the port cannot be opened, or does not support the baud rate.
    """

    baud: int
    disconnect_errors = DISCONNECT_ERRORS

    def __init__(
        self,
        port: str,
        baud: int,
        *,
        dtr: bool | None = None,
        rts: bool | None = None,
        sensor: Sensor | None = None,
    ) -> None:
        super().__init__(port, sensor)
        self.baud = baud
        self._levels = {"dtr": dtr, "rts": rts}
        if sensor:
            longest = max((frame.max_length for frame in sensor.frames.values()), default=0)
        else:
            longest = 0
        # The silence is longer than the transmission of a frame, with 10 bits per byte.
        self.silence = max(self.silence, 2 * longest * 10 / baud)
        self._port = self._open()

    def write(self, data: bytes) -> None:
        try:
            if os.name == "posix":
                self._send(self._port.fileno(), memoryview(data))
            else:
                self._port.write(data)
        except DISCONNECT_ERRORS as error:
            raise disconnected_error(self.label, error) from None

    def _send(self, descriptor: int, left: memoryview) -> None:
        """Write all bytes through the descriptor."""
        # the `select` of pyserial supports only descriptors up to 1,023
        limit = time.monotonic() + WRITE_TIMEOUT_S
        while left:
            if not wait_ready([], [descriptor], max(limit - time.monotonic(), 0.0))[1]:
                raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
            with contextlib.suppress(BlockingIOError):
                left = left[os.write(descriptor, left) :]

    def lines(self, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        for name, level in (("dtr", dtr), ("rts", rts)):
            if level is None:
                continue
            self._levels[name] = level
            try:
                setattr(self._port, name, level)
            except DISCONNECT_ERRORS as error:
                has_no_lines = {errno.ENOTTY, errno.EINVAL} & set(error_numbers(error))
                if not has_no_lines:  # pseudo-terminals have no control lines
                    raise disconnected_error(self.label, error) from None

    def reopen(self) -> None:
        self._close_port()
        self._port = self._open()

    def close(self) -> None:
        self.closed = True
        self._close_port()

    def _close_port(self) -> None:
        with contextlib.suppress(*DISCONNECT_ERRORS):
            self._port.close()

    def _open(self) -> serial.Serial:
        port = serial.Serial(
            baudrate=self.baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True
        )
        port.port = self.label
        for name, level in self._levels.items():
            if level is not None:
                setattr(port, name, level)
        try:
            port.open()
        except DISCONNECT_ERRORS as error:
            with contextlib.suppress(*DISCONNECT_ERRORS):
                port.close()
            raise self._make_open_error(error) from None
        return port

    def _make_open_error(self, error: Exception) -> SourceError:
        """Return the error for a port that cannot be opened; it suggests a command."""
        number = error.errno if isinstance(error, OSError) else None
        source = f"serial://{self.label}{sensor_option(self._sensor)}"
        if number == errno.ENOENT or "FileNotFoundError" in str(error):
            return source_error(f"{self.label}: no such port", "lidarspec ports")
        if number == errno.EACCES:
            return source_error(
                f"{self.label}: permission denied", f"lidarspec doctor {quote(source)}"
            )
        if (
            number in (errno.EBUSY, errno.EAGAIN)
            or "exclusively lock" in str(error)
            or "PermissionError" in str(error)
        ):
            return source_error(
                f"{self.label}: in use by another program", f"lidarspec doctor {quote(source)}"
            )
        if isinstance(error, ValueError) or "baud" in str(error).lower():
            return source_error(
                f"{self.label}: the port does not support {self.baud} baud: {error}",
                f"lidarspec detect {quote(self.label)}",
            )
        return source_error(f"{self.label}: {system_reason(error)}", "lidarspec ports")

    def _receive(self, timeout: float) -> bytes:
        if os.name != "posix":
            self._port.timeout = timeout
            return bytes(self._port.read(max(1, self._port.in_waiting)))
        descriptor = self._port.fileno()
        with contextlib.suppress(BlockingIOError):
            if data := os.read(descriptor, MAX_READ_BYTES):
                return data
        # If no bytes are read, the device may have disappeared, which only a wait detects.
        if not wait_readable(descriptor, timeout):
            return b""
        data = os.read(descriptor, MAX_READ_BYTES)
        if not data:
            raise disconnected_error(self.label, "the port was disconnected")
        return data


def connect(address: SourceAddress, sensor: Sensor | None = None) -> SerialTransport:
    """Open the port of a serial SOURCE.

    Examples are "serial:///dev/ttyUSB0?baud=230400&dtr=0", "/dev/ttyUSB0" and "COM4".

    Raises:
        UsageError: if the baud rate is unknown, or for an unknown option.
        SourceError: if the port cannot be opened.
    """
    address.check(OPTIONS)
    declared = find_data_link(sensor, Serial)
    baud = address.number("baud", 50, 20_000_000) or (declared.baud if declared else None)
    if not address.location:
        raise UsageError(f"{address.text}: expected a port, as in serial:///dev/ttyUSB0")
    if baud is None:
        raise UsageError(
            f"{address.text}: the baud rate is unknown: name the sensor with -s, or use"
            f" {address.text}?baud=115200"
        )
    dtr, rts = (declared.dtr, declared.rts) if declared else (None, None)
    levels = {
        name: default if (level := address.switch(name)) is None else level
        for name, default in (("dtr", dtr), ("rts", rts))
    }
    return SerialTransport(address.location, baud, sensor=sensor, **levels)
