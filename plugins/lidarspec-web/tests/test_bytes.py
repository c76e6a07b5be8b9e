"""Tests of the byte view: the frame of a point, frames by number, damaged frames."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.faults import Faults
from lidarspec_web.page_messages import PageMessages
from lidarspec_web.recent_bytes import DamagedBytes, RecentBytes

from .pages import FLAT, SOLID, Page, Station, write_recording

#: A byte stream, datagrams, points that wait for the next packet, parts of a frame, text on the
#: wire, messages of several datagrams.
SENSORS = (
    FLAT,
    SOLID,
    "slamtec-rplidar-a1",
    "sick-multiscan136",
    "hokuyo-ust10lx",
    "robosense-airy",
)
#: Further sensors of these kinds.
MORE_SENSORS = ("livox-mid360", "velodyne-vlp16")
#: Rate of the simulation of sensors with many points: some of them need a whole processor at full
#: speed.
SLOWLY = "rate=0.3"
#: Number of points of a scan that are tested.
ASKED = 8
#: The same for sensors with frames that take long to explain.
ASKED_OF_LONG_FRAMES = 3


def agree(
    page: Page, header: dict[str, Any], columns: dict[str, np.ndarray], spot: int, scan: ls.Scan
) -> None:
    """Check that a point's frame is explained as by `explain`, with this point."""
    index = int(columns["index"][spot])
    frame = page.request("frame", point={"scan": header["scan"], "index": index})
    assert (frame["is"], frame["why"]) == ("frame", "point"), frame
    data, sensor = bytes.fromhex(frame["hex"]), ls.sensor(scan.sensor.id)
    explanation = ls.explain(data, sensor, frame["explanation"]["frame"])
    assert explanation.verdict == "valid"
    assert frame["explanation"]["rows"] == explanation.to_dict()["rows"]
    rows = [row for row in frame["explanation"]["rows"] if row["path"] == frame["value"]]
    if frame["value"] is None:  # a frame with one point has it for itself
        assert len(explanation.fields) < 10
        return
    ranges, azimuths, elevations = scan.points.range, scan.points.azimuth, scan.points.elevation
    assert any(
        math.isclose(point["range"], ranges[index], abs_tol=1e-4)
        and abs((point["azimuth_deg"] - math.degrees(azimuths[index]) + 180) % 360 - 180) < 0.01
        and math.isclose(point["elevation_deg"], math.degrees(elevations[index]), abs_tol=0.01)
        for row in rows
        for point in row["points"]
    ), (frame["value"], ranges[index])


@pytest.mark.parametrize(
    "sensor",
    [
        FLAT,
        *(pytest.param(name, marks=pytest.mark.slow) for name in SENSORS[1:]),
        *(pytest.param(name, marks=pytest.mark.soak) for name in MORE_SENSORS),
    ],
)
def test_a_point_leads_to_its_frame_and_its_field(tmp_path: Path, sensor: str) -> None:
    """Newer scans arrive meanwhile."""
    source = f"sim:{sensor}" if sensor == FLAT else f"sim:{sensor}?{SLOWLY}"
    with Station(source, tmp_path) as station, station.page() as page:
        page.scan()
        header, columns = page.scan()
        shown = station.broadcast.find_scan(header["scan"])
        assert shown is not None
        assert page.scan()[0]["scan"] > header["scan"]
        asked = ASKED if sensor == FLAT else ASKED_OF_LONG_FRAMES
        for spot in range(0, header["points"], max(header["points"] // asked, 1)):
            agree(page, header, columns, spot, shown.scan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "suffix", "to"), [(FLAT, ".lsr", 15), (FLAT, ".bin", 3), (SOLID, ".pcap", 3)]
)
def test_a_point_of_a_file_leads_to_its_frame(
    tmp_path: Path, sensor: str, suffix: str, to: int
) -> None:
    """Also after a seek, when the same bytes have other offsets in the input."""
    path = write_recording(tmp_path, sensor, to + 2, suffix)
    with Station(path, tmp_path, sensor) as station, station.page() as page:
        page.scan()
        page.say("pause")
        page.state(lambda state: state["paused"])
        page.say("seek", to=to)
        header, columns = page.scan_at(to)
        assert page.request("frame", number=0)["is"] == "gone"  # a frame from before the move
        shown = station.broadcast.find_scan(header["scan"])
        assert shown is not None
        for spot in range(0, header["points"], header["points"] // ASKED_OF_LONG_FRAMES):
            agree(page, header, columns, spot, shown.scan)


@pytest.mark.slow
def test_lost_and_reordered_packets_do_not_mislead(tmp_path: Path) -> None:
    with (
        Station(f"sim:{SOLID}?loss=0.05&reorder=3&{SLOWLY}", tmp_path) as station,
        station.page() as page,
    ):
        page.state(lambda state: state["figures"] and state["figures"]["lost"])
        header, columns = page.scan()
        shown = station.broadcast.find_scan(header["scan"])
        assert shown is not None
        for spot in range(0, header["points"], header["points"] // ASKED):
            agree(page, header, columns, spot, shown.scan)


@pytest.mark.slow
def test_a_point_leads_to_its_frame_after_bytes_were_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lidarspec_web.recent_bytes.MAX_INPUT_BYTES", 1)
    with Station(f"sim:{SOLID}?{SLOWLY}", tmp_path) as station, station.page() as page:
        header, columns = page.scan()
        shown = station.broadcast.find_scan(header["scan"])
        assert shown is not None
        agree(page, header, columns, 7, shown.scan)
        assert page.request("frame", number=0) == {"is": "gone", "what": "frame 0"}


@pytest.mark.slow
def test_points_of_old_scans_are_discarded(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        header, _ = page.scan()
        assert page.request("frame", point={"scan": header["scan"] + 9, "index": 1})["is"] == "gone"
        assert (
            page.request("frame", point={"scan": header["scan"], "index": 1 << 20})["is"] == "gone"
        )


@pytest.mark.slow
def test_frames_follow_one_another_by_number(tmp_path: Path) -> None:
    """Each is the frame after the previous one in the file."""
    path = write_recording(tmp_path, suffix=".bin")
    data = path.read_bytes()
    with Station(path, tmp_path, FLAT) as station, station.page() as page:
        page.scan()
        frames = [page.request("frame", number=number) for number in range(20)]
        assert [frame["number"] for frame in frames] == list(range(20))
        assert b"".join(bytes.fromhex(frame["hex"]) for frame in frames) in data
        assert page.request("frame", number=10**6)["is"] == "gone"


@pytest.mark.slow
def test_the_newest_frame_is_sent_while_it_is_watched(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        page.say("watch", frames=True)
        first, second, third = (page.until("frame") for _ in range(3))
        assert first["number"] < second["number"] < third["number"]
        assert {frame["why"] for frame in (first, second, third)} == {"last"}
        assert third["position"] - first["position"] > 0.8  # at most twice a second
        page.say("watch", frames=False)
        page.state()
        page.state()
        with pytest.raises(TimeoutError):
            page.receive_matching(
                lambda message: isinstance(message, dict) and message["is"] == "frame", within=1.5
            )


@pytest.mark.slow
def test_paused_bytes_stand_still(tmp_path: Path) -> None:
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        page.scan()
        page.say("pause")
        page.state(lambda state: state["paused"])
        page.say("watch", frames=True)
        last = page.until("frame")
        with pytest.raises(TimeoutError):
            page.receive_matching(
                lambda message: isinstance(message, dict) and message["is"] == "frame", within=1.5
            )
        assert page.request("frame", number=last["number"] - 1)["is"] == "frame"
        assert page.request("frame", number=last["number"] + 1)["is"] == "gone"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "what"),
    [(f"sim:{FLAT}?errors=0.0002", "flipped"), (f"sim:{SOLID}?errors=0.0001&{SLOWLY}", "bit")],
)
def test_damaged_frames_are_listed_and_explained(tmp_path: Path, source: str, what: str) -> None:
    with Station(source, tmp_path) as station, station.page() as page:
        listed: list[dict[str, Any]] = []
        while len(listed) < 10:
            damaged = page.state(lambda state: state["damaged"]["newest"])["damaged"]
            listed += damaged["newest"]
        numbers = [piece["number"] for piece in listed]
        assert numbers == sorted(set(numbers))
        assert damaged["total"] > numbers[-1]
        assert all(piece["verdict"] and piece["size"] > 0 for piece in listed)
        frames = [page.request("frame", damaged=number) for number in numbers[-8:]]
        assert {frame["is"] for frame in frames} == {"frame"}
        for frame, piece in zip(frames, listed[-8:], strict=True):
            assert (frame["why"], frame["number"], len(frame["hex"]) // 2) == (
                "damaged",
                piece["number"],
                piece["size"],
            )
            rows = frame["explanation"]["rows"]
            # The rows contain every byte once, in order.
            assert "".join(row["hex"].replace(" ", "") for row in rows) == frame["hex"]
            assert [row["offset"] for row in rows] == np.cumsum(
                [0, *(len(bytes.fromhex(row["hex"])) for row in rows[:-1])]
            ).tolist()
        if what == "flipped":
            assert any(
                "flipped bit" in note for frame in frames for note in frame["explanation"]["notes"]
            )


def test_a_piece_that_arrives_while_a_state_is_made_is_listed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_recording(tmp_path, suffix=".bin", faults=Faults(errors=0.0005))
    list_damaged = RecentBytes.list_damaged

    def list_after_another(backlog: RecentBytes, number: int) -> list[DamagedBytes]:
        backlog._keep_damaged(0, 1, 0, b"\0", is_datagram=False)
        return list_damaged(backlog, number)

    with Station(path, tmp_path, FLAT) as station, station.page() as page:
        page.say("speed", times=20)
        page.until("ended")
        answers = PageMessages(station.broadcast, control=False)
        monkeypatch.setattr(RecentBytes, "list_damaged", list_after_another)
        first = answers.state(frozen=False, first_damaged=0)["damaged"]
        second = answers.state(frozen=False, first_damaged=first["total"])["damaged"]
    last = first["newest"][-1]["number"]
    assert [piece["number"] for piece in second["newest"]] == [last + 1]
    assert second["total"] == last + 2


def test_damage_in_a_file_equals_that_of_explain(tmp_path: Path) -> None:
    path = write_recording(tmp_path, suffix=".bin", faults=Faults(errors=0.0005))
    data, sensor = path.read_bytes(), ls.sensor(FLAT)
    decoder, gaps, end = sensor.decoder(), [], 0
    for frame in decoder.feed(data):
        if frame.gap:
            gaps.append((end, frame.offset - end))
        end = frame.offset + len(frame.data)
    with Station(path, tmp_path, FLAT) as station, station.page() as page:
        page.say("speed", times=20)
        page.until("ended")
        pieces = station.broadcast.backlog.list_damaged(0)
        assert [(piece.offset, piece.size) for piece in pieces] == gaps[-500:]
        assert all(piece.data == data[piece.offset : piece.offset + piece.size] for piece in pieces)
        assert station.broadcast.backlog.damaged == len(gaps) > 10


@pytest.mark.slow
def test_nothing_is_listed_where_nothing_is_damaged(tmp_path: Path) -> None:
    with Station(f"sim:{SOLID}?loss=0.05&{SLOWLY}", tmp_path) as station, station.page() as page:
        state = page.state(lambda state: state["figures"] and state["figures"]["lost"])
        assert state["damaged"] == {"total": 0, "newest": []}
        assert page.request("frame", damaged=0) == {"is": "gone", "what": "damaged piece 0"}
