"""A device for asyncio: each wait goes on in a thread of the device's own, so that the event loop
is never held up.

What a thread has found is kept where the next call finds it: a call that is cancelled loses
nothing.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, TypeVar

from lidarspec.device.device import Device, open as open_device
from lidarspec.device.session import Reply
from lidarspec.errors import UsageError
from lidarspec.framing.results import Counters
from lidarspec.packets.imu import ImuSamples
from lidarspec.packets.packets import Packets
from lidarspec.scans.scans import Scan
from lidarspec.scans.selection import EVERYTHING, Selection, Sieve
from lidarspec.spec.sensor import Sensor

T = TypeVar("T")
#: seconds that a thread waits before it looks whether it is still wanted.
STEP = 0.2


class AsyncDevice:
    """A `Device` whose waits are awaited; an asynchronous context manager.

    Args:
        opening: what opens the device.
    """

    def __init__(self, opening: Callable[[], Device]) -> None:
        self._opening = opening
        self._device: Device | None = None
        self._reader = ThreadPoolExecutor(1, "reader of a device")
        self._sender = ThreadPoolExecutor(1, "sender of a device")
        self._scans: _Feed[Scan] | None = None
        self._imu: _Feed[ImuSamples] | None = None
        self._packets: dict[str | None, _Feed[Packets]] = {}
        self._newest: Scan | None = None

    @property
    def device(self) -> Device:
        """The device underneath.

        Raises:
            UsageError: before it is opened.
        """
        if self._device is None:
            raise UsageError(
                "the device is not open yet: async with lidarspec.open_async(...) as device"
            )
        return self._device

    @property
    def sensor(self) -> Sensor:
        """The sensor, given or detected."""
        return self.device.sensor

    @property
    def stats(self) -> Counters:
        """The counters of everything read so far."""
        return self.device.stats

    @property
    def warnings(self) -> list[str]:
        """What is to be said about the source now."""
        return self.device.warnings

    @property
    def state(self) -> str:
        """How the source is doing: "streaming", "waiting", "silent", "no frames", "disconnected",
        "ended" or "closed".
        """
        return self.device.state

    async def packets(self, frame: str | None = None) -> AsyncIterator[Packets]:
        """The packets of the data frame, or of another type, in batches, until the input ends or
        the device is closed.

        Raises:
            SourceError: where a file has been read to its end before.
        """
        feed = self._packets.setdefault(
            frame, _Feed(self.device.packets(frame, wait=STEP), lambda packets: not len(packets))
        )
        async for packets in self._drained(feed):
            yield packets

    async def scans(self, *, select: Selection = EVERYTHING) -> AsyncIterator[Scan]:
        """Every scan; the first and last piece, and those before and after an interruption, are
        marked ``complete=False``.

        Args:
            select: which of them, and what of each; those before the first that is wanted are read.

        Raises:
            SourceError: where a file has been read to its end before.
            UsageError: where none of its scans is wanted.
        """
        if self._scans is None:
            self._scans = _Feed(self.device.scans(wait=STEP), lambda scan: scan is None)
        sieve = Sieve(select, self.device.source)
        async for scan in self._drained(self._scans):
            if (wanted := sieve.take(scan)) is not None:
                yield wanted
            if sieve.ended:
                break
        if sieve.is_empty:
            raise sieve.missing()

    async def imu(self) -> AsyncIterator[ImuSamples]:
        """What the sensor's IMU felt, in batches, until the input ends or the device is closed.

        Raises:
            UsageError: where no frame of the sensor says what an IMU felt.
            SourceError: where a file has been read to its end before.
        """
        if self._imu is None:
            self._imu = _Feed(self.device.imu(wait=STEP), lambda samples: not len(samples))
        async for samples in self._drained(self._imu):
            yield samples

    async def latest(self, timeout: float | None = None) -> Scan:
        """The newest whole scan, newer than the one that the last call gave; from a file the next.

        Args:
            timeout: seconds to wait.

        Raises:
            SourceTimeout: where none comes in time; SourceError where the input has ended or the
                device was closed.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            if self._newest is None:
                await self._run(self._reader, partial(self._look, deadline))
            newest, self._newest = self._newest, None
            if newest is not None:
                return newest

    async def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """The reply to a command; at once with ``confirmed=False`` where none is documented.

        Args:
            name: of the command.
            timeout: seconds to wait for the reply; by default what the sensor declares.
            arguments: by name, in units.

        Raises:
            UnknownCommand, UnknownField, MissingField, OutOfRange: for what the sensor does not
                take; nothing is sent.
            CommandError: where the device refuses, or the connection is lost; ReplyTimeout where it
                keeps silent.
        """
        return await self._run(
            self._sender, partial(self.device.send, name, timeout=timeout, **arguments)
        )

    async def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes by hand, as they are; nothing is waited for, and what answers them comes with
        everything else.

        Args:
            data: the bytes; nobody looks at what they say, so that a sensor that they start is not
                stopped on closing.
            link: over which of the sensor's links.

        Raises:
            UsageError: for a text, and for a link that the sensor does not have.
            SourceError: where the connection is lost, or there is no device.
        """
        await self._run(self._sender, partial(self.device.write, data, link))

    async def close(self) -> None:
        """Stop the sensor where it was started, and give the source back; a second call does
        nothing.
        """
        if self._device is not None:
            await _whole(asyncio.get_running_loop().run_in_executor(None, self._device.close))
        self._reader.shutdown(wait=False)
        self._sender.shutdown(wait=False)

    async def __aenter__(self) -> AsyncDevice:
        opening = asyncio.get_running_loop().run_in_executor(self._sender, self._opening)
        try:
            self._device = await _whole(opening)
        except BaseException:
            if opening.done() and not opening.cancelled() and opening.exception() is None:
                self._device = opening.result()
            await self.close()
            raise
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    async def _run(self, executor: ThreadPoolExecutor, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(executor, function)

    async def _drained(self, feed: _Feed[T]) -> AsyncIterator[T]:
        """What a feed finds, until it ends."""
        while True:
            while feed.found:
                yield feed.found.popleft()
            if feed.ended:
                return
            await self._run(self._reader, feed.step)

    def _look(self, deadline: float | None) -> None:
        """Wait for the newest scan a little while; in the thread."""
        if self._newest is None:
            left = STEP if deadline is None else min(STEP, max(deadline - time.monotonic(), 0.0))
            self._newest = self.device.newest(left)
            if self._newest is None and deadline is not None and time.monotonic() >= deadline:
                raise self.device.overdue()


class _Feed(Generic[T]):
    """What an iterator yields, found in a thread and fetched in the event loop.

    Args:
        source: the iterator; what it yields when nothing came is passed over.
        empty: whether something it yields is that.
    """

    def __init__(self, source: Iterator[Any], empty: Callable[[Any], bool]) -> None:
        self._source, self._empty = source, empty
        self.found: deque[T] = deque()
        self.ended = False

    def step(self) -> None:
        """Wait for the next; in the thread."""
        if self.found or self.ended:
            return  # the step of a call that was cancelled has found something
        try:
            item = next(self._source)
        except StopIteration:
            self.ended = True
            return
        if not self._empty(item):
            self.found.append(item)


async def _whole(future: asyncio.Future[T]) -> T:
    """The result of something that must not be left half done: a cancellation waits for its end."""
    try:
        return await asyncio.shield(future)
    except asyncio.CancelledError:
        await asyncio.wait([future])
        raise


def open_async(
    source: str | Path, sensor: str | Sensor | None = None, **options: Any
) -> AsyncDevice:
    """A sensor on any SOURCE, to be used with ``async with``; arguments and errors are those of
    `open`.
    """
    return AsyncDevice(partial(open_device, source, sensor, **options))
