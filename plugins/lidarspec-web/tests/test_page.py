"""Tests of the page in a real browser: its picture, marked bytes and clicks."""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.scenes import Room
from lidarspec.transports.protocol import Chunk
from lidarspec_web.access import write_redirect_page
from lidarspec_web.server import PAGE

from .browser import FLAGS, find_browser
from .pages import Station
from .visits import PATIENCE, Visit, serve, streaming

pytestmark = pytest.mark.slow

#: Packets per second of the planar sensor.
RATE = 1800


@pytest.fixture(scope="module")
def m1_page(browser: Any) -> Iterator[Visit]:
    """Yield a page of a sensor with many points.

    It is slowed down to one scan a second, because drawing them in software is slow.
    """
    with serve("sim:robosense-m1?rate=0.1") as link:
        visit = Visit(browser, link)
        yield visit
        visit.context.close()
        assert not visit.errors


@pytest.fixture
def m1(m1_page: Visit) -> Iterator[Visit]:
    with streaming(m1_page):
        yield m1_page


def near(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return the pixels within a distance of these, along each axis."""
    for axis in (0, 1):
        mask = np.any([np.roll(mask, step, axis) for step in range(-reach, reach + 1)], axis=0)
    return mask


def check_drawing(visit: Visit) -> None:
    """Compare the pixels of the picture with the scan that the server saves.

    Points are drawn where the scan has some, and nowhere else.
    """
    scan, (coloured, looked) = visit.scan, visit.find_coloured
    own = np.array([[float(row[axis]) for axis in "xyz"] for row in visit.save()])
    assert visit.value("lidarspec.picture.scan.of") == len(own)
    np.testing.assert_allclose(
        np.stack([scan[axis] for axis in "xyz"], axis=1), own[scan["index"]], atol=1e-3
    )
    across, down = np.rint(scan["place"]).astype(int).T
    inside = (across >= 0) & (across < coloured.shape[1]) & (down >= 0) & (down < coloured.shape[0])
    points = np.zeros_like(coloured)
    points[down[inside], across[inside]] = True
    assert np.count_nonzero(points & looked) > 300
    assert near(coloured, 2)[points & looked].mean() > 0.95, "points of the scan are not drawn"
    assert near(points, 4)[coloured & looked].mean() > 0.95, (
        "something is drawn where the scan has no points"
    )


def test_the_room_of_a_3d_sensor_is_seen(m1: Visit) -> None:
    m1.page.click("#views [data-value=top]")
    m1.pause()
    ahead, left, home = (
        m1.value("place => lidarspec.picture.place(...place)", place)
        for place in ([1, 0, 0], [0, 1, 0], [0, 0, 0])
    )
    assert ahead[1] < home[1], "forward is up"
    assert left[0] < home[0], "left is left"
    assert math.isclose(home[1] - ahead[1], home[0] - left[0], rel_tol=1e-3)
    check_drawing(m1)
    walls = Room().walls
    assert walls is not None
    assert np.mean(np.abs(m1.scan["x"] - walls.high[0]) < 0.05) > 0.1, (
        "the wall ahead is in the scan"
    )
    m1.page.click("#views [data-value=orbit]")
    check_drawing(m1)


def test_colours_and_keys(m1: Visit) -> None:
    for name in ("intensity", "height", "range"):
        m1.page.select_option("#colour", name)
    m1.page.locator("#picture").click(position={"x": 5, "y": 5})
    m1.page.keyboard.press("c")
    assert m1.page.locator("#colour").input_value() == "intensity"
    m1.page.keyboard.press("?")
    assert m1.page.locator("#keys").is_visible()
    m1.page.keyboard.press("Escape")
    home = m1.value("lidarspec.picture.place(0, 0, 0)")
    m1.page.keyboard.press("ArrowUp")
    assert m1.value("lidarspec.picture.place(0, 0, 0)") != home
    m1.page.keyboard.press("0")


def test_a_click_on_a_point_opens_its_frame_and_pointing_at_a_byte_names_its_field(
    m1: Visit,
) -> None:
    m1.page.click("#views [data-value=orbit]")
    m1.pause()
    scan = m1.scan
    across, down = scan["place"][len(scan["x"]) // 2]
    asked = len(m1.asked_for("frame"))
    m1.page.locator("#picture canvas").nth(1).click(position={"x": across, "y": down})
    m1.until(
        lambda: (
            len(m1.asked_for("frame")) > asked and m1.told.get("frame", {}).get("why") == "point"
        ),
        "no frame is asked for",
    )
    index = m1.asked_for("frame")[-1]["point"]["index"]
    row = int(np.flatnonzero(scan["index"] == index)[0])
    frame = m1.told["frame"]
    kept = m1.page.locator(".branch.kept")
    assert (
        m1.until(
            lambda: kept.count() and kept.get_attribute("data-path"),
            "the point's value is not marked",
        )
        == frame["value"]
    )
    explained = ls.explain(bytes.fromhex(frame["hex"]), ls.sensor("robosense-m1"))
    path = frame["value"].rpartition(".")[0] or frame["value"]
    element = next(
        one
        for one in explained.rows
        if one.path and (frame["value"] + ".").startswith(one.path + ".")
    )
    assert any(
        math.isclose(point.range, scan["range"][row], abs_tol=1e-3) for point in element.points
    ), path
    assert m1.page.locator(".dump i.kept").count() > 0
    check_bytes(m1, explained)


def check_bytes(visit: Visit, explained: Any) -> None:
    """Point at some visible bytes of the dump, and at a field."""
    offsets = [
        int(cell.get_attribute("data-offset")) for cell in visit.page.locator(".hex i").all()[::40]
    ]
    assert offsets
    for offset in offsets:
        visit.page.locator(f".hex i[data-offset='{offset}']").hover()
        names = [value.path for value in explained.fields.values() if value.covers_byte(offset)]
        said = visit.page.locator(".said b").all_inner_texts()
        assert said == names, f"byte {offset}"
    path = visit.page.locator(".branch[data-path]").last.get_attribute("data-path")
    visit.page.locator(f".branch[data-path='{path}']").hover()
    marked = {
        int(cell.get_attribute("data-offset"))
        for cell in visit.page.locator(".hex i.pointed").all()
    }
    inside = [
        value
        for value in explained.fields.values()
        if f"{value.path}.".startswith((f"{path}.", f"{path}["))
    ]
    assert marked
    assert all(any(value.covers_byte(offset) for value in inside) for offset in marked)


@pytest.fixture(scope="module")
def stl27l_page(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visit]:
    """Yield a page of a file of a planar sensor, with damage in it."""
    sensor, path, began = (
        ls.sensor("ldrobot-stl27l"),
        tmp_path_factory.mktemp("page") / "stl27l.lsr",
        1_700_000_000_000_000_000,
    )
    with ls.Recorder(path, sensor) as recorder:
        for number, frame in enumerate(ls.simulate(sensor, packets=20 * RATE)):
            data = frame if number % 500 else frame[:20] + bytes([frame[20] ^ 1]) + frame[21:]
            recorder.write(Chunk(data, began + number * 1_000_000_000 // RATE))
    with serve(str(path)) as link:
        visit = Visit(browser, link, theme="light")
        yield visit
        visit.context.close()
        assert not visit.errors


@pytest.fixture
def stl27l(stl27l_page: Visit) -> Iterator[Visit]:
    with streaming(stl27l_page):
        yield stl27l_page


def test_the_room_of_a_planar_sensor_is_seen(stl27l: Visit) -> None:
    stl27l.pause()
    assert stl27l.page.locator("#views [aria-pressed=true]").inner_text() == "Polar"
    check_drawing(stl27l)
    walls, scan = Room().walls, stl27l.scan
    assert walls is not None
    for axis, wall in (
        ("x", walls.low[0]),
        ("x", walls.high[0]),
        ("y", walls.low[1]),
        ("y", walls.high[1]),
    ):
        assert np.mean(np.abs(scan[axis] - wall) < 0.05) > 0.05, (
            f"the wall at {axis} {wall} m is seen"
        )


def test_a_file_is_sought_stepped_through_and_played_at_another_speed(stl27l: Visit) -> None:
    def position() -> float:
        return float(stl27l.value("lidarspec.picture.scan.position"))

    stl27l.pause()
    stands = position()
    stl27l.page.wait_for_timeout(500)
    assert position() == stands
    stl27l.page.click("#step")
    stl27l.until(lambda: stands < position() < stands + 0.5, "it does not step to the next scan")
    seek = stl27l.page.locator("#seek")
    seek.click(position={"x": seek.bounding_box()["width"] * 0.7, "y": 5})
    stl27l.until(lambda: 12.5 < position() < 15.5, "it is not where the bar was clicked")
    stl27l.until(
        lambda: abs(float(seek.input_value()) - position()) < 0.5,
        "the bar is not where the scan is",
    )
    stl27l.page.select_option("#speed", "0.25")
    stl27l.play()
    stl27l.until(lambda: stl27l.told["state"]["speed"] == 0.25, "its speed does not change")
    stl27l.page.select_option("#speed", "8")
    seek.click(position={"x": seek.bounding_box()["width"] * 0.95, "y": 5})
    stl27l.until(lambda: "has ended" in stl27l.text("#notice"), "its end is not said")
    stl27l.until(lambda: stl27l.text("#play") == "▶ Play", "it cannot be played again")
    stl27l.page.select_option("#speed", "1")
    stl27l.page.click("#play")
    stl27l.until(
        lambda: position() < 10 and not stl27l.page.locator("#notice").is_visible(),
        "it does not begin anew",
    )


def test_a_damaged_frame_is_explained(stl27l: Visit) -> None:
    stl27l.page.click("#tabs [data-value=damaged]")
    first = stl27l.page.locator("button.damage").first
    stl27l.until(first.count, "no damaged frame is listed")
    stl27l.pause()
    verdict = stl27l.page.locator("button.damage span").nth(3).inner_text()
    first.click()
    stl27l.until(lambda: stl27l.told.get("frame", {}).get("why") == "damaged", "no frame is shown")
    explanation = stl27l.told["frame"]["explanation"]
    stl27l.until(
        lambda: "bad" in stl27l.page.locator(".verdict").get_attribute("class"),
        "its verdict is not shown",
    )
    assert explanation["fault"]["reason"] in stl27l.text(".verdict")
    assert verdict


def test_a_command_shows_its_bytes_and_its_reply(browser: Any) -> None:
    with serve("sim:ldrobot-ld14p") as link:
        visit = Visit(browser, link)
        visit.page.click("#tabs [data-value=commands]")
        visit.page.click(".list [data-value=set_speed]")
        speed, send = (
            visit.page.locator(".form input[name=speed]"),
            visit.page.locator(".form .primary"),
        )
        assert send.is_disabled()
        speed.fill("100000")
        visit.until(
            lambda: visit.page.locator("#commands .bytes .bad").count(),
            "what is out of range is not refused",
        )
        assert send.is_disabled()
        speed.fill("2520")
        visit.until(send.is_enabled, "its bytes are not shown")
        assert visit.text("#commands .bytes .whole") == ls.sensor("ldrobot-ld14p").command(
            "set_speed", speed=2520
        ).hex(" ")
        assert "2520 deg/s" in visit.text("#commands .bytes")
        assert not visit.asked_for("send")
        send.click()
        visit.until(lambda: "replied" in visit.told, "there is no reply")
        assert visit.asked_for("send")[0]["arguments"] == {"speed": "2520"}
        assert (
            visit.until(lambda: visit.text("#commands .reply pre"), "the reply is not shown")
            == visit.told["replied"]["text"]
        )
        visit.context.close()
        assert not visit.errors


def test_text_of_the_sensor_is_never_part_of_the_page(browser: Any, tmp_path: Path) -> None:
    sensor, name = (
        ls.sensor("hokuyo-ust-10lx"),
        "<script>window.taken=1</script><img src=x onerror='window.taken=1'>",
    )
    parameters = sensor.parse(sensor.example("parameters"))
    parameters["model"]["text"] = name.encode()
    path = tmp_path / "ust.bin"
    path.write_bytes(b"".join([sensor.build("parameters", parameters), *ls.simulate(sensor, 200)]))
    with serve(str(path), "-s", sensor.id) as link:
        visit = Visit(browser, link)
        visit.until(lambda: name in visit.text("#info"), "the model's name is not shown")
        assert visit.value(
            "window.taken === undefined && document.querySelectorAll('body img, body"
            " script').length === 0"
        )
        visit.context.close()
        assert not visit.errors


def test_lost_halves_of_dual_returns_are_a_figure(browser: Any, tmp_path: Path) -> None:
    sensor = ls.sensor("robosense-m1")
    packet = sensor.parse(sensor.example("data"))
    numbers = [number for number in range(1, 1261) if number % 100]
    path = tmp_path / "dual.hex"
    frames = [
        # The file lasts five seconds, so that the page gets figures while it is played. Its packets
        # are far apart, so most of the halves count as lost.
        sensor.build(
            "data",
            packet,
            pkt_psn=number,
            wave_mode=0,
            seconds=number // 250,
            microseconds=number % 250 * 4000,
        )
        for number in numbers
    ]
    path.write_text("\n\n".join(frame.hex() for frame in frames))
    with ls.open(path, sensor) as device:
        list(device.packets())
        groups = device.stats.incomplete_returns
    with serve(str(path), "-s", sensor.id) as link:
        visit = Visit(browser, link)
        label = visit.page.locator("dt", has_text="Incomplete returns")
        visit.until(lambda: label.count() == 1, "the figure is not on the page")
        figure = label.locator("xpath=following-sibling::dd[1]")
        assert 0 < int(figure.text_content()) <= groups
        visit.context.close()
        assert not visit.errors


def test_a_page_reports_a_restarted_server(browser: Any) -> None:
    """The new server has a new token: its printed link shows the page."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    source = "sim:ldrobot-stl27l?rate=0.5"
    with serve(source, address=f"127.0.0.1:{port}") as link:
        visit = Visit(browser, link)
    visit.until(lambda: "Connection lost" in visit.text("#notice"), "nothing is said of it")
    assert visit.text("#status") == "no server"
    with serve(source, address=f"127.0.0.1:{port}") as link:
        visit.until(
            lambda: "Open the link that it printed" in visit.text("#notice"),
            "it does not say what to do",
        )
        visit.page.reload()
        assert "lidarspec view --web" in visit.text("body")
        visit.page.goto(link)
        visit.until(lambda: visit.text("#status") == "streaming", "the new link does not show it")
        assert not visit.page.locator("#notice").is_visible()
        visit.context.close()


def test_a_page_reconnects(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network fails briefly: the same server is there again, with the same token."""
    monkeypatch.setattr("lidarspec_web.server.make_token", lambda: "token" * 6)
    source = "sim:ldrobot-stl27l?rate=0.5"
    with Station(source, tmp_path, page=PAGE) as station:
        visit = Visit(browser, station.link)
    visit.until(lambda: "Connection lost" in visit.text("#notice"), "nothing is said of it")
    with Station(source, tmp_path, page=PAGE, port=station.port):
        visit.until(lambda: visit.text("#status") == "streaming", "it does not connect again")
        assert not visit.page.locator("#notice").is_visible()
        asked = len(visit.asked_for("next"))
        visit.until(lambda: len(visit.asked_for("next")) > asked + 3, "no scan comes any more")
        visit.context.close()


def test_the_file_that_a_browser_is_started_with_leads_to_the_page(
    browser: Any, tmp_path: Path
) -> None:
    with serve("sim:ldrobot-stl27l?rate=0.5") as link:
        page = browser.new_page()
        page.goto(write_redirect_page(tmp_path, link).as_uri())
        page.wait_for_url(link)
        page.wait_for_selector('#status:has-text("streaming")')
        assert page.evaluate("document.referrer") == ""
        page.close()


def test_a_hidden_page_requests_no_scans(tmp_path: Path) -> None:
    """Without playwright, which keeps every page visible.

    Tabs of one window are controlled by the browser's own
    protocol.
    """
    with serve("sim:ldrobot-stl27l?rate=0.5") as link, tabs(link, tmp_path) as (evaluated, turned):
        newest = "globalThis.lidarspec?.picture?.scan?.scan ?? 0"

        def goes_on() -> bool:
            before = evaluated(newest)
            time.sleep(1.0)
            return (evaluated(newest) or 0) > (before or 0)

        until(goes_on, "no scan is shown")
        turned(False)
        assert evaluated("document.visibilityState") == "hidden"
        until(lambda: not goes_on(), "it goes on")
        assert not goes_on()
        turned(True)
        until(goes_on, "it does not go on when it is seen again")


def until(holds: Callable[[], Any], otherwise: str) -> None:
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, otherwise


@contextlib.contextmanager
def tabs(link: str, folder: Path) -> Iterator[tuple[Callable[[str], Any], Callable[[bool], None]]]:
    """Yield two functions for a page in a tab.

    The first evaluates an expression in it, the second moves it in front of another tab or behind
    it.
    """
    from websockets.sync.client import connect

    words = [
        find_browser(),
        "--headless=new",
        *FLAGS,
        "--window-size=400,300",
        "--no-first-run",
        "--remote-debugging-port=0",
    ]
    words += [f"--user-data-dir={folder}", link]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        root = next(
            found[1]
            for line in process.stderr
            if (found := re.search(r"ws:(//[^/]+)/devtools", line))
        )

        def ask(path: str, method: str = "GET") -> bytes:
            with urllib.request.urlopen(
                urllib.request.Request(f"http:{root}/json/{path}", method=method)
            ) as answer:
                return bytes(answer.read())

        tab = next(one for one in json.loads(ask("list")) if one["type"] == "page")
        other = json.loads(ask("new?about:blank", "PUT"))
        ask(f"activate/{tab['id']}")
        with connect(tab["webSocketDebuggerUrl"]) as socket:

            def evaluated(expression: str) -> Any:
                asked = {
                    "id": 1,
                    "method": "Runtime.evaluate",
                    "params": {"expression": expression, "returnByValue": True},
                }
                socket.send(json.dumps(asked))
                # The value is None while a page is loading.
                return json.loads(socket.recv()).get("result", {}).get("result", {}).get("value")

            def turned(front: bool) -> None:
                ask(f"activate/{(tab if front else other)['id']}")
                until(
                    lambda: (evaluated("document.visibilityState") == "visible") == front,
                    "the tab is not turned to",
                )

            yield evaluated, turned
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)
