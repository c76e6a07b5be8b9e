"""A `Device` for asyncio.

`AsyncDevice` calls the methods of a `Device` in its own threads, so that the event loop is never
blocked. An item that arrives during a cancelled call is kept for the next call.
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
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import EVERYTHING, Selection
from lidarspec.sensor_operations import Sensor

T = TypeVar("T")
#: Maximum time that a thread waits before it returns to the event loop, which may have cancelled
#: the call.
_MAX_WAIT_S = 0.2


class AsyncDevice:
    """A `Device` with awaitable methods; an asynchronous context manager.

    Its methods and properties have the arguments, results and errors of `Device`.
    """

    def __init__(self, opening: Callable[[], Device]) -> None:
        self._opening = opening
        self._device: Device | None = None
        self._reading = ThreadPoolExecutor(1, "reader of a device")
        self._sending = ThreadPoolExecutor(1, "sender of a device")
        self._iterators: dict[tuple[str, ...], _ThreadedIterator[Any]] = {}
        self._newest: Scan | None = None

    @property
    def device(self) -> Device:
        """The `Device` whose methods are called.

        Raises:
            UsageError: if the device is not open yet.
        """
        if self._device is None:
            raise UsageError(
                "the device is not open yet: async with lidarspec.open_async(...) as device"
            )
        return self._device

    @property
    def sensor(self) -> Sensor:
        """The sensor; see `Device.sensor`."""
        return self.device.sensor

    @property
    def stats(self) -> Counters:
        """The counters; see `Device.stats`."""
        return self.device.stats

    @property
    def warnings(self) -> list[str]:
        """The current warnings; see `Device.warnings`."""
        return self.device.warnings

    @property
    def state(self) -> str:
        """The state of the source; see `Device.state`."""
        return self.device.state

    async def packets(self, frame: str | None = None) -> AsyncIterator[Packets]:
        """Yield packets in batches; see `Device.packets`."""
        iterator = self._get_iterator("packets", *filter(None, [frame]))
        async for packets in self._fetch(iterator):
            yield packets

    async def scans(self, *, select: Selection = EVERYTHING) -> AsyncIterator[Scan]:
        """Yield scans; see `Device.scans`."""
        sieve = self.device.make_selector(select)
        async for scan in self._fetch(self._get_iterator("scans")):
            wanted = sieve.select(scan)
            if wanted is not None:
                yield wanted
            if sieve.ended:
                break
        if sieve.is_empty:
            raise sieve.make_no_scan_error()

    async def imu(self) -> AsyncIterator[ImuSamples]:
        """Yield the samples of the sensor's IMU; see `Device.imu`."""
        async for samples in self._fetch(self._get_iterator("imu")):
            yield samples

    async def latest(self, timeout: float | None = None) -> Scan:
        """Wait for the newest whole scan and return it; see `Device.latest`."""
        if timeout is None:
            deadline = None
        else:
            deadline = time.monotonic() + timeout
        while self._newest is None:
            await _run_in_thread(self._reading, partial(self._find_newest, deadline))
        newest = self._newest
        self._newest = None
        return newest

    async def send(self, name: str, /, *, timeout: float | None = None, **arguments: Any) -> Reply:
        """Send a command and return the reply; see `Device.send`."""
        send = partial(self.device.send, name, timeout=timeout, **arguments)
        return await _run_in_thread(self._sending, send)

    async def write(self, data: bytes, link: str = "data") -> None:
        """Send bytes as they are; see `Device.write`."""
        await _run_in_thread(self._sending, partial(self.device.write, data, link))

    async def close(self) -> None:
        """Stop the sensor and close the source; see `Device.close`."""
        if self._device is not None:
            await _await_result(
                asyncio.get_running_loop().run_in_executor(None, self._device.close)
            )
        self._reading.shutdown(wait=False)
        self._sending.shutdown(wait=False)

    async def __aenter__(self) -> AsyncDevice:
        opening = asyncio.get_running_loop().run_in_executor(self._sending, self._opening)
        try:
            self._device = await _await_result(opening)
        except BaseException:
            is_open = opening.done() and not opening.cancelled() and opening.exception() is None
            if is_open:
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

    def _get_iterator(self, method: str, *arguments: str) -> _ThreadedIterator[Any]:
        """Return the running iterator of a method of the device; start it on first use."""
        key = (method, *arguments)
        if key not in self._iterators:
            self._iterators[key] = _ThreadedIterator(
                getattr(self.device, method)(*arguments, wait=_MAX_WAIT_S)
            )
        return self._iterators[key]

    async def _fetch(self, iterator: _ThreadedIterator[T]) -> AsyncIterator[T]:
        """Yield the items of an iterator until it ends."""
        while True:
            while iterator.items:
                yield iterator.items.popleft()
            if iterator.ended:
                return
            await _run_in_thread(self._reading, iterator.find_next)

    def _find_newest(self, deadline: float | None) -> None:
        """Wait up to `_MAX_WAIT_S` for the newest scan; called in a worker thread."""
        if self._newest is not None:
            return  # found by the thread of a call that was cancelled
        wait = _MAX_WAIT_S
        if deadline is not None:
            wait = min(wait, max(deadline - time.monotonic(), 0.0))
        self._newest = self.device.newest(wait)
        is_late = deadline is not None and time.monotonic() >= deadline
        if self._newest is None and is_late:
            raise self.device.make_timeout_error()


class _ThreadedIterator(Generic[T]):
    """An iterator that a thread reads for the event loop.

    Args:
        source: an iterator that yields None or an empty batch if nothing has arrived.
    """

    def __init__(self, source: Iterator[Any]) -> None:
        self._source = source
        self.items: deque[T] = deque()
        self.ended = False

    def find_next(self) -> None:
        """Wait up to `_MAX_WAIT_S` for the next item; called in a worker thread."""
        if self.items or self.ended:
            return  # found by the thread of a call that was cancelled
        try:
            item = next(self._source)
        except StopIteration:
            self.ended = True
            return
        is_batch = isinstance(item, Packets | ImuSamples)
        if item is not None and not (is_batch and not len(item)):
            self.items.append(item)


async def _run_in_thread(executor: ThreadPoolExecutor, function: Callable[[], T]) -> T:
    return await asyncio.get_running_loop().run_in_executor(executor, function)


async def _await_result(future: asyncio.Future[T]) -> T:
    """Return the result of a future.

    If the waiting task is cancelled, CancelledError is raised only after the future is done.
    """
    try:
        return await asyncio.shield(future)
    except asyncio.CancelledError:
        await asyncio.wait([future])
        raise


def open_async(
    source: str | Path, sensor: str | Sensor | None = None, **options: Any
) -> AsyncDevice:
    """Open a sensor on any SOURCE, for ``async with``.

    The arguments and errors are those of `open`.
    """
    return AsyncDevice(partial(open_device, source, sensor, **options))
