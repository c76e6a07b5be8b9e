"""Tests of u-blox receivers: published messages, times and commands."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
import lidarspec_ublox
from lidarspec import simulate
from lidarspec.errors import UsageError, WireError
from lidarspec.packets.clock_monitor import ClockMonitor
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.packets.utc_times import UtcTimes
from lidarspec.simulation.device import SECOND, SimulatedDevice
from tests.lines import TIMEOUT_S

GNSS = ls.sensor("ublox-gnss")
VECTORS = json.loads((Path(lidarspec_ublox.__file__).parent / "vectors.json").read_text())
INCOMING = [vector for vector in VECTORS if vector["frame"] in GNSS.incoming]
#: From the page of a NEO-6M whose output after power-on is among the vectors.
OTHER_SENTENCES = (
    b"$GPGSA,A,1,,,,,,,,,,,,,99.99,99.99,99.99*30\r\n",
    b"$GPGSV,1,1,00*79\r\n",
    b"$GPVTG,,,,,,,,,N*30\r\n",
)


def test_both_protocols_on_one_line_are_frames() -> None:
    sent = [bytes.fromhex(vector["hex"]) for vector in INCOMING]
    stream = b"".join(data + OTHER_SENTENCES[i % 3] for i, data in enumerate(sent))
    found = GNSS.split(stream)
    assert b"".join(item.data for item in found) == stream
    assert [item.frame for item in found[::2]] == [vector["frame"] for vector in INCOMING]
    assert {item.frame for item in found[1::2]} == {"nmea"}


def test_a_binary_message_within_a_sentence_is_found() -> None:
    """A receiver that is switched to UBX may interrupt a sentence."""
    pvt, rmc = simulate(GNSS, 6)[1], OTHER_SENTENCES[0]
    found = GNSS.split(rmc[:20] + pvt + rmc)
    assert [item.frame for item in found] == ["nav_pvt", "nmea"]


@pytest.mark.parametrize("rate", [1, 7])
def test_a_split_of_the_stream_changes_nothing(rate: int) -> None:
    stream = b"".join(bytes.fromhex(vector["hex"]) for vector in INCOMING)
    decoder = GNSS.decoder()
    found = [
        item
        for start in range(0, len(stream), rate)
        for item in decoder.feed(stream[start : start + rate])
    ]
    found += decoder.finish()
    assert [(item.frame, item.offset) for item in found] == [
        (item.frame, item.offset) for item in GNSS.split(stream)
    ]


def test_the_state_of_the_clock_is_that_of_the_receiver() -> None:
    frames = b"".join(simulate(GNSS, 20))
    packets = GNSS.decode(frames, frame="nav_pvt")
    monitor = ClockMonitor(GNSS)
    monitor.add(packets)
    report = monitor.report()
    assert (report.epoch, report.state, report.locked) == ("utc", "time resolved by GNSS", True)


@pytest.mark.parametrize(
    ("frame", "flag", "state"),
    [
        ("nav_pvt", "date", "time not fully resolved"),
        ("nav_pvt", "time", "time not fully resolved"),
        ("nav_pvt", "fully_resolved", "time not fully resolved"),
        ("nav_timeutc", "utc", "UTC not valid"),
    ],
)
def test_an_invalid_time_is_not_used_as_utc(frame: str, flag: str, state: str) -> None:
    stream = b"".join(bytes.fromhex(vector["hex"]) for vector in INCOMING)
    values = next(GNSS.parse(item.data) for item in GNSS.split(stream) if item.frame == frame)
    valid = GNSS.decode(GNSS.build(frame, values), frame=frame)
    times = UtcTimes(GNSS.id, GNSS.frames[frame].clock)
    assert times.convert(valid).tolist() == valid.time_ns.tolist()
    assert times.warnings == []

    values["valid"][flag] = 0
    invalid = GNSS.decode(GNSS.build(frame, values), frame=frame)
    host_ns = 1_800_000_000 * 10**9
    with pytest.raises(UsageError, match="UTC is unknown"):
        times.convert(invalid)
    utc_ns = times.to_utc(invalid.time_ns.item(), host_ns, read_clock_status(invalid).item())
    assert utc_ns == host_ns
    assert times.changes[-1].source.state == state
    assert times.changes[-1].source.locked is False


def test_times_are_utc() -> None:
    stream = b"".join(bytes.fromhex(vector["hex"]) for vector in INCOMING)
    times = GNSS.decode(stream, frame="nav_pvt").time_ns.astype("datetime64[ns]")
    # 14:01:25 less 378166 ns; 15:59:29 and 199629557 ns
    assert times.astype(str).tolist() == [
        "2022-02-21T14:01:24.999621834",
        "2018-04-26T15:59:29.199629557",
    ]
    utc = GNSS.decode(stream, frame="nav_timeutc").time_ns.astype("datetime64[ns]")
    assert utc.astype(str).tolist() == ["2016-07-23T00:00:43.000030572"]


def test_speed_is_in_metres_a_second() -> None:
    """0.004 knots of the manual's example are 0.002058 m/s."""
    stream = b"".join(bytes.fromhex(vector["hex"]) for vector in INCOMING)
    speed = GNSS.decode(stream, frame="rmc")["speed"]
    np.testing.assert_allclose(speed, [0.004 * 1852 / 3600, np.nan], rtol=1e-6)


def test_the_example_of_the_manual_has_the_checksum_of_a_shorter_sentence() -> None:
    longer = b"$GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A,V*57\r\n"
    with pytest.raises(WireError, match="expected b'\\*2D'"):
        GNSS.parse(longer)
    values = GNSS.parse(longer.replace(b"*57", b"*2D"))
    assert values.navigation_status == b"V"
    assert GNSS.parse(longer.replace(b",V*57", b"*57")).navigation_status == b"\x00"


def test_a_simulated_receiver_acknowledges_and_answers_polls() -> None:
    with ls.open("sim:ublox-gnss", GNSS) as device:
        send = partial(device.send, timeout=TIMEOUT_S)
        assert send("message", message_class=1, message_id=33, rate=1).frame == "acknowledge"
        assert send("rate", period=0.2).frame == "acknowledge"
        assert send("nav_timeutc").frame == "nav_timeutc"


def test_the_simulated_hour_moves_north_in_steps_of_the_clock() -> None:
    stream = b"".join(simulate(GNSS, 900))
    packets = GNSS.decode(stream, frame="nav_pvt")
    assert packets.stats.bytes_skipped == 0
    assert set(np.diff(packets.time_ns).tolist()) == {200_000_000}
    assert (np.diff(packets["latitude"]) > 0).all()


def test_a_polled_time_is_that_of_the_periodic_messages() -> None:
    device = SimulatedDevice(GNSS)
    device.utc_offset_ns = 1_800_000_000 * SECOND
    device.start(0)
    stream = b""
    for step in range(10):
        if step == 7:
            device.receive(GNSS.command("nav_timeutc"), step * SECOND // 2)
        stream += b"".join(data for _, data in device.outgoing(step * SECOND // 2))
    times = [
        GNSS.decode(item.data, frame="nav_timeutc").time_ns.item() / SECOND - 1_800_000_000
        for item in GNSS.split(stream)
        if item.frame == "nav_timeutc"
    ]
    assert times == [0, 1, 2, 3, 3.5, 4]
