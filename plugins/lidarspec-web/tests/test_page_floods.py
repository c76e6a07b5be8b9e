"""Tests of request floods and unread saved scans: other pages are still served."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lidarspec_web import scan_files as saving
from lidarspec_web.connections import Client, Connections
from lidarspec_web.page_requests import MAX_WAITING, RateLimit
from lidarspec_web.recent_bytes import RecentBytes
from lidarspec_web.temporary_folder import PREFIX

from .pages import DEADLINE, FLAT, Station

FLOOD = 5000
SAVES = 2
#: Larger than the buffers of a connection.
LARGE = 1 << 23


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


@pytest.fixture
def station(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Station]:
    """Yield a server with a low limit of saved scans."""
    monkeypatch.setattr(saving, "MAX_SAVES", SAVES)
    monkeypatch.setattr(saving, "MAX_REST_S", 0.0)
    with Station(f"sim:{FLAT}", tmp_path) as station:
        yield station


def kept_scan(page: Any) -> int:
    """Return the number of a scan that the page holds."""
    number = page.scan()[0]["scan"]
    page.say("pause")
    page.state(lambda state: state["paused"])
    return int(number)


def start_save(station: Station, number: int) -> socket.socket:
    """Request a scan without reading it."""
    raw = socket.socket()
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    raw.settimeout(DEADLINE)
    raw.connect(("127.0.0.1", station.port))
    path = f"/save/{number}.csv?token={station.token}"
    raw.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{station.port}\r\n\r\n".encode())
    return raw


def files(folder: Path) -> list[Path]:
    return list(folder.glob(f"{PREFIX}*/*"))


def wait_until_files(folder: Path, count: int) -> None:
    end = time.monotonic() + DEADLINE
    while len(files(folder)) != count:
        assert time.monotonic() < end, files(folder)
        time.sleep(0.01)


def test_messages_above_the_rate_wait() -> None:
    limit = RateLimit(burst=3, per_second=10.0)
    assert [limit.delay_s(100.0) for _ in range(5)] == pytest.approx([0, 0, 0, 0.1, 0.2])
    assert limit.delay_s(100.2) == pytest.approx(0.1)
    assert [limit.delay_s(200.0) for _ in range(4)] == pytest.approx([0, 0, 0, 0.1])


def test_a_page_that_asks_without_end_waits_for_itself(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another page gets its scans meanwhile, and pausing again does nothing."""
    counts = Counter[str]()
    delay_s, frozen = RateLimit.delay_s, RecentBytes.freeze

    def counted_delay_s(limit: RateLimit, now: float) -> float:
        counts["messages"] += 1
        return delay_s(limit, now)

    def counted_freeze(backlog: RecentBytes) -> RecentBytes:
        counts["freeze"] += 1
        return frozen(backlog)

    monkeypatch.setattr(RateLimit, "delay_s", counted_delay_s)
    monkeypatch.setattr(RecentBytes, "freeze", counted_freeze)
    with station.page() as flooding, station.page() as other:
        flooding.scan()
        for _ in range(FLOOD):
            flooding.say("pause")
        for _ in range(2):
            assert other.scan()[1]["x"].size
        assert other.request("frame", number=0)["is"] == "frame"
        assert 4 < counts["messages"] < FLOOD / 2
        assert counts["freeze"] == 1


def test_questions_of_a_page_are_answered_in_their_order(station: Station) -> None:
    """None is refused because others wait."""
    count = 3 * MAX_WAITING
    with station.page() as page:
        page.scan()
        for number in range(count):
            page.say("frame", number=number)
        answers = [page.until("frame") for _ in range(count)]
    assert [answer["number"] for answer in answers] == list(range(count))


def test_writing_scans_does_not_delay_pages(
    station: Station, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk hangs, and there are more requests than the limit of saved scans."""
    may_write = threading.Event()
    write = saving.write_file

    def wait_and_write(path: Path, shown: Any) -> None:
        may_write.wait(DEADLINE)
        write(path, shown)

    monkeypatch.setattr(saving, "write_file", wait_and_write)
    with station.page() as page, contextlib.ExitStack() as stack:
        number = kept_scan(page)
        try:
            for _ in range(10 * SAVES):
                stack.enter_context(start_save(station, number))
            with station.page() as other:
                assert other.until("hello")
                assert other.scan()[1]["x"].size
                assert other.request("frame", number=0)["is"] == "frame"
            status, _, body = station.request(f"/save/{number}.csv")
            assert (status, body) == (
                503,
                b"2 scans are being saved already: try again in a moment",
            )
        finally:
            may_write.set()
        end = time.monotonic() + DEADLINE
        while station.request(f"/save/{number}.csv")[0] != 200:
            assert time.monotonic() < end, "no scan is saved any more"
            time.sleep(0.05)


def test_a_scan_that_is_not_read_is_given_up(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dropped = threading.Semaphore(0)
    drop = Connections.drop

    def counted_drop(connections: Connections, client: Client | None) -> None:
        drop(connections, client)
        dropped.release()

    monkeypatch.setattr(Connections, "drop", counted_drop)
    monkeypatch.setattr(saving, "write_file", lambda path, shown: path.write_bytes(bytes(LARGE)))
    monkeypatch.setattr(saving, "SEND_TIMEOUT_S", 0.1)
    with (
        Station(f"sim:{FLAT}", tmp_path) as station,
        station.page() as page,
        contextlib.ExitStack() as stack,
    ):
        number = kept_scan(page)
        unread = [stack.enter_context(start_save(station, number)) for _ in range(SAVES)]
        for _ in unread:
            assert dropped.acquire(timeout=DEADLINE)
        for raw in unread:
            received = 0
            with contextlib.suppress(ConnectionError):
                while data := raw.recv(1 << 16):
                    received += len(data)
            assert received < LARGE
        wait_until_files(folder, 0)
        monkeypatch.setattr(saving, "SEND_TIMEOUT_S", DEADLINE)
        assert len(station.request(f"/save/{number}.csv")[2]) == LARGE


def test_saved_scans_leave_nothing_behind(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the server ends while they are sent, or was killed."""
    stale = folder / f"{PREFIX}stale"
    stale.mkdir()
    monkeypatch.setattr(saving, "write_file", lambda path, shown: path.write_bytes(bytes(LARGE)))
    with contextlib.ExitStack() as stack:
        with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
            assert not stale.exists()
            number = kept_scan(page)
            for _ in range(3):
                stack.enter_context(start_save(station, number))
            wait_until_files(folder, 3)
        assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_made_is_reported(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    with station.page() as page:
        number = kept_scan(page)
        status, _, body = station.request(f"/save/{number}.csv")
        assert (status, b"/nowhere" in body) == (500, True)
