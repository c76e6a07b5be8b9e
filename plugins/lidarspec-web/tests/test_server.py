"""Tests of the page's server: its messages to one page and to ten."""

from __future__ import annotations

import contextlib
import re
import socket
import time
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import UsageError
from lidarspec.scans.selection import Selection

from .pages import DEADLINE, FLAT, SOLID, Station, mask, write_recording


@pytest.mark.parametrize(
    ("sensor", "planar"), [(FLAT, True), pytest.param(SOLID, False, marks=pytest.mark.slow)]
)
def test_the_first_message_describes_the_source(tmp_path: Path, sensor: str, planar: bool) -> None:
    with Station(f"sim:{sensor}", tmp_path) as station, station.page() as page:
        hello = page.until("hello")
        assert (hello["sensor"], hello["source"], hello["live"], hello["planar"]) == (
            sensor,
            f"sim:{sensor}",
            True,
            planar,
        )
        assert (hello["duration"], hello["records"]) == (None, True)
        assert {"pcd", "csv", "svg"} <= set(hello["saves"])
        state = page.state(lambda state: state["figures"])
        assert 0 < state["position"] < 10  # since the first scan
        assert (state["state"], state["paused"], state["damaged"]) == (
            "streaming",
            False,
            {"total": 0, "newest": []},
        )
        assert state["figures"]["speed_hz"] == pytest.approx(10, rel=0.2)
        names = {
            "lost",
            "disconnects",
            "latency_s",
            "jitter_s",
            "loss_rate",
            "clock_offset_s",
            "at",
        }
        assert names <= state["figures"].keys()
        assert state["clock"]


@pytest.mark.slow
def test_later_pages_get_the_figures_of_the_last_minute(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as first:
        first.state(lambda state: state["figures"])
        with station.page() as second:
            assert second.until("hello")["history"]


def test_scans_are_those_of_the_sensor_and_always_the_newest(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        first, _ = page.scan()
        until = station.broadcast.shown
        assert until is not None
        while station.broadcast.shown.number < first["scan"] + 4:  # type: ignore[union-attr]
            time.sleep(0.01)
        header, columns = page.scan()
        assert header["scan"] >= first["scan"] + 4  # the scans between them were skipped
        shown = station.broadcast.find_scan(header["scan"])
        assert shown is not None
        assert np.array_equal(columns["x"], shown.scan.points.x[columns["index"]])
        assert header["position"] > first["position"]


def test_scans_are_sent_only_on_request(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        page.scan()
        page.scan(most=100)
        with pytest.raises(TimeoutError):
            page.receive_matching(lambda message: isinstance(message, tuple), within=1.0)
        header, _ = page.scan(most=100)
        assert 90 < header["points"] <= 100 < header["of"]


@pytest.mark.slow
def test_equal_requests_share_one_message(tmp_path: Path) -> None:
    path = write_recording(tmp_path)
    with Station(path, tmp_path) as station, station.page() as one, station.page() as other:
        one.scan()
        one.say("pause")
        one.state(lambda state: state["state"] == "paused")
        other.scan()
        shown = station.broadcast.shown
        assert shown is not None
        assert shown.message(1 << 20) is shown.message(1 << 20)


@pytest.mark.slow
def test_ten_pages_see_one_source(tmp_path: Path) -> None:
    with Station(f"sim:{SOLID}?rate=0.3", tmp_path) as station, contextlib.ExitStack() as opened:
        pages = [opened.enter_context(station.page()) for _ in range(10)]
        for page in pages:
            page.say("next", most=5000)
        seen = {
            page.receive_matching(lambda message: isinstance(message, tuple))[0]["scan"]
            for page in pages
        }
        assert len(seen) < 10  # they share scans
        for page in pages:
            assert page.scan(most=5000)[1]["x"].size
        assert station.broadcast.device.stats.queue_dropped == 0
    assert station.said[-1].endswith("open pages: 0")


@pytest.mark.slow
def test_connecting_and_leaving_pages_are_announced(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station:
        with station.page() as page:
            page.until("hello")
        # The client may have closed before the server reports it.
        end = time.monotonic() + DEADLINE
        while len(station.said) < 2 and time.monotonic() < end:
            time.sleep(0.01)
        with station.page() as page:
            page.until("hello")
            assert station.said == [
                "page 1 was opened by 127.0.0.1; open pages: 1",
                "page 1 was closed; open pages: 0",
                "page 2 was opened by 127.0.0.1; open pages: 1",
            ]


@pytest.mark.slow
def test_pausing_a_live_source_affects_one_page_only(tmp_path: Path) -> None:
    with (
        Station(f"sim:{FLAT}", tmp_path) as station,
        station.page() as paused,
        station.page() as other,
    ):
        header, columns = paused.scan()
        paused.say("pause")
        stands = paused.state(lambda state: state["paused"])
        assert (stands["state"], stands["position"]) == ("paused", header["position"])
        paused.say("next", most=1000)
        first, _ = other.scan()
        assert not other.state()["paused"]
        while other.scan()[0]["scan"] < first["scan"] + 5:
            pass
        with pytest.raises(TimeoutError):
            paused.receive_matching(lambda message: isinstance(message, tuple), within=0.5)
        frame = paused.request(
            "frame", point={"scan": header["scan"], "index": int(columns["index"][3])}
        )
        assert frame["is"] == "frame"
        paused.say("play")
        assert (
            paused.receive_matching(lambda message: isinstance(message, tuple))[0]["scan"]
            >= first["scan"] + 5
        )


@pytest.mark.slow
@pytest.mark.parametrize("word", ["step", "seek", "speed"])
def test_a_live_source_cannot_be_moved_through(tmp_path: Path, word: str) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        refused = page.request(word, to=1, times=2)
        assert (refused["is"], refused["of"]) == ("refused", word)
        assert f"sim:{FLAT}" in refused["text"]


@pytest.mark.parametrize("suffix", [".lsr", pytest.param(".pcap", marks=pytest.mark.slow)])
def test_a_file_is_paused_stepped_and_moved_through(tmp_path: Path, suffix: str) -> None:
    sensor = FLAT if suffix == ".lsr" else SOLID
    path = write_recording(tmp_path, sensor, suffix=suffix)
    first, *scans = ls.open(path, sensor).scans()
    times = [(scan.stamp_ns - first.stamp_ns) * 1e-9 for scan in scans]
    with Station(path, tmp_path, sensor) as station, station.page() as page:
        hello = page.until("hello")
        assert (hello["live"], hello["duration"]) == (False, pytest.approx(5, abs=0.3))
        page.say("pause")
        assert page.state(lambda state: state["paused"])["state"] == "paused"
        page.scan()
        page.say("seek", to=times[20])
        header, columns = page.scan_at(times[20])
        assert header["position"] == pytest.approx(times[20], abs=0.21)
        which = int(np.argmin(np.abs(np.array(times) - header["position"])))
        assert np.array_equal(columns["x"], scans[which].points.x[columns["index"]])
        for further in (1, 2):
            page.say("step")
            header, columns = page.scan()
            assert np.array_equal(columns["x"], scans[which + further].points.x[columns["index"]])
        assert page.state()["state"] == "paused"
        page.say("seek", to=0)
        page.scan_at(0.0)


@pytest.mark.slow
def test_a_file_is_played_at_its_speed_and_at_another(tmp_path: Path) -> None:
    """Two parts, compared with each other and with the clock."""
    with (
        Station(write_recording(tmp_path, seconds=20), tmp_path) as station,
        station.page() as page,
    ):
        page.say("pause")

        def speed(times: float) -> float:
            page.say("speed", times=times)
            page.say("play")
            before, began = page.scan()[0]["position"], time.monotonic()
            while time.monotonic() < began + 1.5:
                header, _ = page.scan()
            return float(header["position"] - before) / (time.monotonic() - began)

        slow, quick = speed(1), speed(4)
        assert 0.5 < slow < 1.5
        assert 2.5 < quick / slow < 6
        assert page.state()["speed"] == 4
        assert page.request("speed", times=0)["is"] == "refused"


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "suffix"), [(FLAT, ".bin"), (FLAT, ".lsr"), (SOLID, ".pcap")])
def test_a_file_is_read_as_it_is_played(tmp_path: Path, sensor: str, suffix: str) -> None:
    """Figures, bytes and damaged frames are those of the shown scans alone."""
    path = write_recording(tmp_path, sensor, 8, suffix)
    with Station(path, tmp_path, sensor) as station, station.page() as page:
        header, _ = page.scan()
        page.say("pause")
        position = page.state(lambda state: state["paused"])["position"]
        assert station.broadcast.device.stats.bytes_in < path.stat().st_size * (position + 1.5) / 8
        assert header["position"] < 3


@pytest.mark.slow
def test_a_file_ends_and_is_played_again(tmp_path: Path) -> None:
    path = write_recording(tmp_path, seconds=1)
    with Station(path, tmp_path) as station, station.page() as page:
        assert "sent.lsr has ended" in page.until("ended")["text"]
        assert page.state()["state"] == "ended"
        page.scan()
        page.say("play")
        page.scan_at(0.2)
        assert page.until("ended")


@pytest.mark.slow
def test_seeking_past_the_end_shows_the_end(tmp_path: Path) -> None:
    with Station(write_recording(tmp_path, seconds=1), tmp_path) as station, station.page() as page:
        page.say("seek", to=100)
        page.until("ended")
        page.say("seek", to=0)
        page.scan()
        assert station.failure is None


@pytest.mark.slow
def test_a_selection_of_a_file_cannot_be_sought(tmp_path: Path) -> None:
    path = write_recording(tmp_path)
    with (
        Station(path, tmp_path, select=Selection(times=(1.0, 2.0))) as station,
        station.page() as page,
    ):
        assert page.until("hello")["duration"] is None
        assert "cannot seek" in page.request("seek", to=1)["text"]
        page.until("ended")


def test_a_failing_source_is_reported(tmp_path: Path) -> None:
    with (
        Station(
            write_recording(tmp_path), tmp_path, select=Selection(times=(100.0, 200.0))
        ) as station,
        station.page() as page,
    ):
        assert "the selection" in page.until("ended")["text"]
    assert isinstance(station.failure, UsageError)


NONSENSE = (
    "{",
    "[" * 5000,
    "17",
    '{"do":"dance"}',
    '{"do":["next"]}',
    '{"do":"next"}',
    '{"do":"next","most":-1}',
    '{"do":"next","most":1e400}',
    '{"do":"next","most":true}',
    '{"do":"frame","point":{"scan":"1","index":0}}',
    '{"do":"frame","number":null}',
    '{"do":"compose","command":7}',
    '{"do":"send","command":"x","arguments":{"a":1}}',
)


def test_invalid_requests_are_refused_and_end_nothing(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        for message in NONSENSE:
            page.socket.send(message)
            assert page.until("refused")["text"], message
            page.socket.send(message.encode())  # as a binary message
            assert page.until("refused")["text"], message
        assert page.scan()[1]["x"].size


def test_a_too_long_message_closes_its_own_page_only(tmp_path: Path) -> None:
    with (
        Station(f"sim:{FLAT}", tmp_path) as station,
        station.page() as page,
        station.page() as other,
    ):
        page.socket.send(" " * (1 << 17))
        with pytest.raises(Exception, match=r"1009|too big"):
            page.receive_matching(lambda message: False)
        assert other.scan()[1]["x"].size


def test_a_scan_is_saved_as_it_is_shown(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        header, columns = page.scan()
        page.say("pause")
        page.state(lambda state: state["paused"])
        for suffix in page.until("hello")["saves"]:
            status, headers, body = station.request(f"/save/{header['scan']}.{suffix}")
            assert (status, len(body) > 1000) == (200, True), suffix
            assert re.search(
                rf'filename="{FLAT}-\d+\.\d{{3}}s\.{suffix}"', headers["content-disposition"]
            )
            assert headers["cache-control"] == "no-store"
            if suffix == "csv":
                x = np.array(
                    [float(line.split(b",")[0]) for line in body.splitlines()[1:]], np.float32
                )
                assert np.allclose(x, columns["x"])
        for name in (
            "9999.pcd",
            f"{header['scan']}.exe",
            f"{header['scan']}.",
            "x.pcd",
            "..%2f..%2fetc%2fpasswd",
            "-1.pcd",
        ):
            assert station.request(f"/save/{name}")[0] == 404, name


def test_a_recording_is_switched_on_and_off(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        page.scan()
        assert page.state()["recording"] is None
        page.say("record")
        recording = page.state(
            lambda state: state["recording"] and state["recording"]["bytes"] > 10_000
        )["recording"]
        page.say("record")
        page.state(lambda state: state["recording"] is None)
    with ls.open(tmp_path / recording["name"]) as again:
        assert sum(scan.whole for scan in again.scans()) > 1


@pytest.mark.slow
def test_a_file_is_not_recorded(tmp_path: Path) -> None:
    with Station(write_recording(tmp_path), tmp_path) as station, station.page() as page:
        assert not page.until("hello")["records"]
        assert "file" in page.request("record")["text"]


@pytest.mark.slow
def test_a_page_that_does_not_read_is_disconnected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It requests scan after scan and reads none of them, until its window is full."""
    monkeypatch.setattr("lidarspec_web.open_page.SEND_TIMEOUT_S", 2.0)
    with (
        Station(f"sim:{SOLID}", tmp_path) as station,
        station.page() as healthy,
        socket.create_connection(("127.0.0.1", station.port)) as raw,
    ):
        healthy.say("record")
        name = healthy.state(lambda state: state["recording"])["recording"]["name"]
        raw.sendall(station.handshake())
        end = time.monotonic() + DEADLINE
        while (
            not any("stopped reading" in text for text in station.said) and time.monotonic() < end
        ):
            with contextlib.suppress(OSError):
                raw.sendall(mask({"do": "next", "most": 1 << 20}))
            assert healthy.scan(most=2000)[1]["x"].size
        assert station.said[-1].startswith("page 2 was disconnected")
        healthy.say("record")
        healthy.state(lambda state: state["recording"] is None)
    with ls.open(tmp_path / name) as again:
        for _ in again.scans():
            pass
        assert (again.stats.lost, again.stats.queue_dropped, again.stats.disconnects) == (0, 0, 0)
        assert again.stats.frames["data"] > 1000
