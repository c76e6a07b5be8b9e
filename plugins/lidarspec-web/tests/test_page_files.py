"""Tests of recording, saving and reconnection on the page."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.scenes import Room
from lidarspec.testing.fixtures import virtual_port

from .visits import Visit, serve

pytestmark = pytest.mark.slow

#: The first bytes of a PNG.
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def save_file(visit: Visit, kind: str) -> tuple[str, bytes]:
    """Return the name and the content of the file that the browser stores for a scan."""
    visit.page.click("#save summary")
    with visit.page.expect_download() as download:
        visit.page.click(f"#saves [data-value={kind}]")
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def test_data_is_recorded_until_the_next_click(browser: Any, tmp_path: Path) -> None:
    with serve("sim:ldrobot-stl27l", folder=tmp_path) as link:
        visit = Visit(browser, link)
        assert visit.text("#recording") == "Record"
        visit.page.click("#record")
        visit.until(
            lambda: "0.1 MB" in visit.text("#recording"), "it is not shown how much is recorded"
        )
        name = visit.text("#recording").partition(" · ")[0]
        visit.page.click("#record")
        visit.until(lambda: visit.text("#recording") == "Record", "the recording does not end")
        asked = len(visit.asked_for("next"))
        visit.until(lambda: len(visit.asked_for("next")) > asked + 3, "the picture does not go on")
        visit.context.close()
        assert not visit.errors
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with ls.open(tmp_path / name) as device:
        assert sum(scan.complete for scan in device.scans()) > 3
        assert device.sensor.id == "ldrobot-stl27l"
        assert device.stats.bad_checksum == 0


def test_a_double_click_starts_one_recording_that_all_pages_show(
    browser: Any, tmp_path: Path
) -> None:
    with serve("sim:ldrobot-stl27l?rate=0.5", folder=tmp_path) as link:
        visit, other = Visit(browser, link), Visit(browser, link)
        visit.page.dblclick("#record")
        for page in (visit, other):
            page.until(
                lambda page=page: " · " in page.text("#recording"),
                "it is not shown that it records",
            )
        assert (
            visit.text("#recording").partition(" ")[0] == other.text("#recording").partition(" ")[0]
        )
        visit.page.wait_for_timeout(600)  # afterwards it counts as another press
        other.page.click("#record")
        for page in (visit, other):
            page.until(
                lambda page=page: page.text("#recording") == "Record",
                "it is not shown that it ended",
            )
            page.context.close()
            assert not page.errors
    assert len(list(tmp_path.glob("*.lsr"))) == 1


def test_the_scan_that_is_shown_is_saved(browser: Any) -> None:
    with serve("sim:ldrobot-stl27l") as link:
        visit = Visit(browser, link)
        visit.pause()
        position = visit.value("lidarspec.picture.scan.position")
        name, table = save_file(visit, "csv")
        assert name == f"ldrobot-stl27l-{position:.3f}s.csv"
        rows = list(csv.DictReader(io.StringIO(table.decode())))
        shown = visit.scan
        own = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
        np.testing.assert_allclose(
            np.stack([shown[axis] for axis in "xyz"], axis=1), own[shown["index"]], atol=1e-3
        )
        name, cloud = save_file(visit, "pcd")
        assert name.endswith(".pcd")
        assert f"POINTS {len(rows)}\n".encode() in cloud
        name, picture = save_file(visit, "png")
        assert name.endswith(".png")
        check_picture(visit, picture)
        assert not visit.page.locator("#notice").is_visible()
        visit.context.close()
        assert not visit.errors


def check_picture(visit: Visit, data: bytes) -> None:
    """Compare a saved picture with the one on the screen: size and coloured walls."""
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    assert data.startswith(SIGNATURE)
    pixels = np.asarray(image.open(io.BytesIO(data)).convert("RGB"), int)
    coloured, _ = visit.find_coloured
    assert pixels.shape[:2] == coloured.shape
    scan, walls = visit.scan, Room().walls
    assert walls is not None
    ahead = np.abs(scan["x"] - walls.high[0]) < 0.05
    across, down = np.rint(scan["place"][ahead]).astype(int).T
    spread = np.ptp(pixels, axis=2)
    assert np.count_nonzero(ahead) > 50
    assert np.mean(spread[down, across] > 60) > 0.9, "the wall ahead is not in the picture"


def test_an_unplugged_sensor_is_reported_until_it_returns(browser: Any) -> None:
    with virtual_port("ldrobot-stl27l") as port, serve(port.path, "-s", "ldrobot-stl27l") as link:
        visit = Visit(browser, link)
        assert visit.until(lambda: visit.text("#status"), "no state is shown") == "streaming"
        port.unplug()
        visit.until(
            lambda: visit.text("#status") == "disconnected",
            "it is not said that the sensor is gone",
        )
        visit.until(
            lambda: (
                "the device is disconnected; waiting for it to return" in visit.text("#warnings")
            ),
            "it is not said what comes next",
        )
        before = visit.value("lidarspec.picture.scan.scan")
        port.plug()
        visit.until(
            lambda: visit.text("#status") == "streaming", "it is not said that the sensor is back"
        )
        visit.until(
            lambda: visit.value("lidarspec.picture.scan.scan") > before + 3,
            "the picture does not go on",
        )
        visit.until(lambda: visit.text("#warnings") == "", "it is still said that it is gone")
        visit.context.close()
        assert not visit.errors
