"""Tests of the page on a phone, by keyboard, and after a pause."""

from __future__ import annotations

import os
import pty
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls

from .visits import Visit, serve, streaming

pytestmark = pytest.mark.slow

PHONE = (390, 844)
MIN_TARGET_PX = 44
AXE = Path(__file__).parents[1] / "page" / "node_modules" / "axe-core" / "axe.min.js"
#: Elements that reach beyond the window and cannot be scrolled into it: the strip of figures
#: scrolls by itself.
TOO_WIDE = """[...document.querySelectorAll("body *")].filter((element) => {
  const { left, right, width } = element.getBoundingClientRect();
  return width > 1 && (left < -1 || right > innerWidth + 1) && !element.closest("#side, .scroll");
}).map((element) => element.id || element.className || element.tagName)"""
#: Visible buttons and similar elements that are too small for a finger.
TOO_SMALL = """(least) => [...document.querySelectorAll("button, select, input, summary, [role=treeitem]")].filter((element) => {
  const { width, height } = element.getBoundingClientRect();
  return element.checkVisibility() && (width < least || height < least);
}).map((element) => element.id || element.textContent)"""

#: Saves the shown scan as a table, and returns its number and its time in the file.
SAVE_SHOWN = """(() => {
  const { scan, position } = lidarspec.picture.scan;
  document.querySelector("#saves [data-value=csv]").click();
  return [scan, position];
})()"""
#: The findings of axe-core: the rule, an element that breaks it, and the remedy.
VIOLATIONS = """axe.run().then(({ violations }) =>
  violations.map(({ id, nodes }) => `${id}: ${nodes[0].html}: ${nodes[0].failureSummary}`))"""


@pytest.fixture(scope="module")
def link() -> Iterator[str]:
    with serve("sim:ldrobot-ld14p") as link:
        yield link


@pytest.fixture(scope="module")
def desk_page(browser: Any, link: str) -> Iterator[Visit]:
    visit = Visit(browser, link)
    yield visit
    visit.context.close()
    assert not visit.errors


@pytest.fixture
def desk(desk_page: Visit) -> Iterator[Visit]:
    with streaming(desk_page):
        yield desk_page


@pytest.fixture(scope="module")
def phone_page(browser: Any, link: str) -> Iterator[Visit]:
    visit = Visit(browser, link, size=PHONE, touch=True)
    yield visit
    visit.context.close()
    assert not visit.errors


@pytest.fixture
def phone(phone_page: Visit) -> Iterator[Visit]:
    with streaming(phone_page):
        yield phone_page


def check_fits(visit: Visit) -> None:
    assert visit.value("document.scrollingElement.scrollWidth") == PHONE[0]
    assert visit.value(TOO_WIDE) == []
    assert visit.value(TOO_SMALL, MIN_TARGET_PX) == []


def move_fingers(visit: Visit, *steps: list[tuple[float, float]]) -> None:
    """Put fingers on the screen, move them along positions, and lift them."""
    session = visit.context.new_cdp_session(visit.page)
    for kind, places in (
        ("touchStart", steps[0]),
        *(("touchMove", step) for step in steps[1:]),
        ("touchEnd", []),
    ):
        points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    session.detach()


def home(visit: Visit) -> list[float]:
    """Return the position of the sensor in the picture, in pixels."""
    return list(visit.value("lidarspec.picture.place(0, 0, 0)"))


def metre(visit: Visit) -> float:
    """Return the number of pixels per metre."""
    return float(
        visit.value("lidarspec.picture.place(0, 0, 0)[1] - lidarspec.picture.place(1, 0, 0)[1]")
    )


def test_a_phone_shows_the_picture_first_and_nothing_is_cut_off(phone: Visit) -> None:
    box = phone.page.locator("#picture").bounding_box()
    assert box["width"] == PHONE[0]
    assert box["height"] == pytest.approx(0.55 * PHONE[1], abs=1)
    assert (
        box["y"]
        < phone.page.locator("#tools").bounding_box()["y"]
        < phone.page.locator("#side").bounding_box()["y"]
    )
    check_fits(phone)
    phone.page.click("#save summary")
    check_fits(phone)
    phone.page.click("#save summary")


@pytest.mark.parametrize("tab", ["bytes", "damaged", "commands"])
def test_a_tab_covers_the_whole_of_a_phone(phone: Visit, tab: str) -> None:
    phone.page.tap(f"#tab-{tab}")
    assert phone.page.locator("#drawer").bounding_box() == {
        "x": 0,
        "y": 0,
        "width": PHONE[0],
        "height": PHONE[1],
    }
    if tab == "bytes":
        phone.until(lambda: phone.page.locator(".branch[data-path]").count(), "no frame is shown")
    check_fits(phone)
    phone.page.tap("#fold")
    assert not phone.page.locator(f"#{tab}").is_visible()


def test_fingers_drag_pinch_and_tap(phone: Visit) -> None:
    box = phone.page.locator("#picture").bounding_box()
    x, y = box["x"] + 120, box["y"] + 200
    before = home(phone)
    move_fingers(phone, *([(x + 12 * step, y + 6 * step)] for step in range(6)))
    phone.until(lambda: home(phone)[0] > before[0] + 20, "it does not move with a finger")
    large = metre(phone)
    move_fingers(phone, *([(x - 8 * step, y), (x + 60 + 8 * step, y)] for step in range(6)))
    phone.until(lambda: metre(phone) > 1.3 * large, "two fingers do not make it larger")
    phone.page.tap("#reset")
    phone.pause()
    across, down = phone.scan["place"][len(phone.scan["x"]) // 3]
    phone.page.touchscreen.tap(box["x"] + across + 12, box["y"] + down)
    phone.until(
        lambda: phone.told.get("frame", {}).get("why") == "point",
        "a tap beside a point does not open its frame",
    )
    phone.page.tap("#fold")
    phone.play()


def test_bytes_follow_the_newest_frame_until_one_is_held(desk: Visit) -> None:
    def number() -> int:
        return int(desk.told.get("frame", {}).get("number") or 0)

    first = desk.until(number, "no frame is shown")
    desk.until(lambda: number() > first, "the bytes stand still")
    held = desk.page.locator("#bytes .held")
    assert not held.is_visible()
    desk.page.click("#bytes .live")
    assert held.is_visible()
    caption = desk.text("#bytes .caption")
    desk.page.wait_for_timeout(1200)
    assert desk.text("#bytes .caption") == caption
    desk.page.click("#bytes .live")
    assert not held.is_visible()
    desk.until(lambda: desk.text("#bytes .caption") != caption, "it does not go on")


def test_tabs_are_tabs_and_the_keyboard_reaches_everything(desk: Visit) -> None:
    selected = desk.page.locator("[role=tab][aria-selected=true]")
    desk.page.click("#tab-bytes")
    assert desk.page.locator("#bytes").is_visible(), "a click on the open tab does not close it"
    for key, tab in (
        ("ArrowRight", "damaged"),
        ("End", "commands"),
        ("ArrowRight", "bytes"),
        ("ArrowLeft", "commands"),
        ("Home", "bytes"),
    ):
        desk.page.keyboard.press(key)
        assert selected.get_attribute("data-value") == tab
        assert desk.page.locator(f"#{tab}[role=tabpanel]").is_visible()
        assert desk.value("document.activeElement.id") == f"tab-{tab}"
    desk.page.locator("#bytes .live").click()
    desk.page.locator("#bytes .tree").focus()
    desk.page.keyboard.press("Home")
    desk.page.keyboard.press("ArrowDown")
    assert (
        desk.page.locator("[role=treeitem][aria-selected=true]").get_attribute("data-path")
        == "speed"
    )
    assert desk.page.locator(".dump i.kept").count() == 4, "two bytes, in hexadecimal and as text"
    desk.page.locator("#bytes .live").click()
    desk.page.locator("#picture").focus()
    desk.page.keyboard.press("Enter")
    desk.until(lambda: desk.asked_for("frame"), "a point cannot be opened by keyboard")
    desk.page.locator("#bytes .live").click()
    desk.page.set_viewport_size({"width": 1440, "height": 600})
    side = desk.page.locator("#side")
    desk.until(
        lambda: side.evaluate("side => side.scrollHeight > side.clientHeight"),
        "the figures fit into the lower window",
    )
    side.focus()
    desk.page.keyboard.press("End")
    desk.until(lambda: side.evaluate("side => side.scrollTop") > 0, "the figures are not scrolled")
    desk.page.set_viewport_size({"width": 1440, "height": 900})
    desk.page.click("#fold")
    assert not desk.page.locator("#bytes").is_visible()
    desk.page.keyboard.press("Enter")
    assert desk.page.locator("#bytes").is_visible()


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("where", ["desk", "phone"])
def test_axe_finds_no_violation(request: pytest.FixtureRequest, where: str, theme: str) -> None:
    if not AXE.exists():
        pytest.skip("axe-core is not installed")
    visit = request.getfixturevalue(where)
    if where == "phone" and visit.page.locator("#drawer.open").count():
        visit.page.click("#fold")
    if visit.value("document.documentElement.dataset.theme") != theme:
        visit.page.click("#theme")
    visit.value(AXE.read_text())
    for tab in ("bytes", "damaged", "commands"):
        visit.page.locator(f"#tab-{tab}").click()
        found = visit.value(VIOLATIONS)
        assert found == [], tab
    if where == "phone":
        visit.page.click("#fold")
        assert visit.value(VIOLATIONS) == []


def test_a_damaged_packet_is_counted_once(browser: Any, tmp_path: Path) -> None:
    """Its checksum is wrong, and the sensor's clock shows its loss as well."""
    sensor = ls.sensor("ldrobot-stl27l")
    frames = list(ls.simulate(sensor, packets=6000))
    damaged = [
        frame if number % 2 else frame[:20] + bytes([frame[20] ^ 1]) + frame[21:]
        for number, frame in enumerate(frames)
    ]
    path = tmp_path / "damaged.bin"
    path.write_bytes(b"".join(damaged))
    with serve(str(path), "-s", sensor.id) as link:
        visit = Visit(browser, link)
        visit.until(
            lambda: visit.text(".split").startswith(("damaged 49", "damaged 5")),
            "the share of damaged packets is not shown",
        )
        titles = visit.page.locator(".chart:visible h2").all_inner_texts()
        assert (
            sum("missing" in title or "lost" in title or "damaged" in title for title in titles)
            == 1
        )
        total = float(next(title for title in titles if "missing" in title).split()[-2])
        assert 45 < total < 55
        visit.context.close()
        assert not visit.errors


def test_an_unplugged_sensor_is_reported_and_dimmed(browser: Any, tmp_path: Path) -> None:
    """The line can be dismissed, and does not repeat the path of the port."""
    sensor = ls.sensor("ldrobot-stl27l")
    frames = list(ls.simulate(sensor, packets=1800))
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = tmp_path / "usb-a-port-with-a-name-that-is-as-long-as-those-by-id"
    port.symlink_to(os.ttyname(slave))
    unplugged = threading.Event()

    def send() -> None:
        number = 0
        while not unplugged.wait(0.05):
            for _ in range(90):
                os.write(master, frames[number % len(frames)])
                number += 1

    sending = threading.Thread(target=send)
    sending.start()
    try:
        with serve(str(port), "-s", sensor.id) as link:
            visit = Visit(browser, link)
            visit.until(lambda: visit.text("#status") == "streaming", "it does not stream")
            assert not visit.page.locator("#notice").is_visible()
            assert not visit.page.locator("#age").is_visible()
            unplugged.set()
            visit.until(lambda: visit.page.locator("#age").is_visible(), "its age is not shown")
            assert (
                visit.value("getComputedStyle(document.getElementById('picture')).opacity")
                == "0.35"
            )
            notice = visit.page.locator("#notice")
            visit.until(notice.is_visible, "nothing is said of it")
            assert len(visit.text("#reason")) < 60
            assert port.name not in visit.text("#reason")
            visit.page.click("#dismiss")
            visit.page.wait_for_timeout(1200)
            assert not notice.is_visible()
            visit.context.close()
            assert not visit.errors
    finally:
        unplugged.set()
        sending.join()
        os.close(master)
        os.close(slave)


def test_a_question_to_a_running_sensor_stops_it_and_starts_it_again(browser: Any) -> None:
    with serve("sim:slamtec-rplidar-a1") as link:
        visit = Visit(browser, link)
        visit.page.click("#tab-commands")
        assert visit.page.locator("#commands h2").all_inner_texts() == [
            "Read",
            "Set",
            "Start and stop",
        ]
        assert visit.page.locator(".list [aria-pressed=true]").count() == 0
        assert not visit.page.locator("#commands .primary").count(), (
            "nothing can be sent before it is chosen"
        )
        visit.page.click(".list [data-value=get_info]")
        send = visit.page.locator("#commands .primary")
        visit.until(
            lambda: send.inner_text() == "Stop, send, start again" and send.is_enabled(),
            "it does not offer to stop",
        )
        send.click()
        visit.until(lambda: "replied" in visit.text("#commands .reply"), "there is no reply")
        visit.until(lambda: len(visit.asked_for("send")) == 3, "it is not started again")
        assert visit.asked_for("send")[1]["command"] == "get_info"
        before = visit.value("lidarspec.picture.scan.scan")
        visit.until(
            lambda: visit.value("lidarspec.picture.scan.scan") > before + 3,
            "no scan comes any more",
        )
        visit.context.close()
        assert not visit.errors


def test_a_saved_scan_is_named_after_its_time_in_the_file_at_each_replay(
    browser: Any, tmp_path: Path
) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    path = tmp_path / "short.bin"
    path.write_bytes(b"".join(ls.simulate(sensor, packets=1800)))  # one second
    with serve(str(path), "-s", sensor.id) as link:
        visit = Visit(browser, link)
        newest = -1
        for _ in range(2):
            visit.until(
                lambda newest=newest: visit.value("lidarspec.picture.scan.scan") > newest,
                "it does not begin anew",
            )
            visit.until(lambda: visit.text("#play") == "▶ Play", "it does not end")
            visit.page.click("#save summary")
            with visit.page.expect_download() as download:
                # In one step: on a busy machine the last scans of the file may still be drawn.
                newest, position = visit.value(SAVE_SHOWN)
            assert position < 1.0
            assert download.value.suggested_filename == f"{sensor.id}-{position:.3f}s.csv"
            visit.page.click("#play")
        visit.context.close()
        assert not visit.errors
