"""Tests of Hesai: vectors, calculated points and times, clock and correction files."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.detect.identification import SampleBytes, identify_sample
from lidarspec.simulation.faults import Faults
from lidarspec.spec import Learned, Tcp, Udp
from lidarspec.testing.fixtures import virtual_port
from lidarspec_hesai import at128
from lidarspec_hesai.xt import TABLE_32
from tests.agreement import assert_same_points
from tests.evidence import PROTOCOLS, assert_points, decode, vector_bytes, vectors
from tests.lines import SLACK, TIMEOUT_S, free_port

FILE = "vectors_udp3d.json"
SENSORS = {name: ls.sensor(f"hesai-{name}") for name in ("pandar40p", "xt32", "xt16", "qt64")}
P40, XT32, XT16, QT64 = SENSORS.values()
P64, XT32M, QT128 = (ls.sensor(f"hesai-{name}") for name in ("pandar64", "xt32m", "qt128"))
FORM = {
    "pandar40p": (10, 40),
    "xt32": (8, 32),
    "xt16": (8, 16),
    "qt64": (4, 64),
}  # blocks, channels
VECTORS = {
    "hesai_40p_real": P40,
    "hesai_xt32_real": XT32,
    "hesai_xt16_real": XT16,
    "hesai_qt64_real": QT64,
}
VECTORS |= {"hesai_64_real": P64, "hesai_xt32m_real": XT32M, "hesai_qt128_real": QT128}
NAMES = {
    "motor": "motor_speed",
    "ret": "return_mode",
    "factory": "factory",
    "seq": "sequence",
    "shutdown": "shutdown",
}
UTC = ("year", "month", "day", "hour", "minute", "second")
HEADER = {
    "dist_unit_mm": "dis_unit",
    "laser_num": "lasers",
    "block_num": "block_count",
    "first_return": "first_return",
    "return_num": "return_count",
}

# Three channels for each model, by its nominal table, as (block, azimuth on the wire, channel, raw
# distance, x y z in REP-103): x = d cosE cosA, y = -d cosE sinA, z = d sinE, with A = azimuth +
# offset of the channel, clockwise.
GOLDEN = {
    # 4 m, E 15.210 (cos 0.964971, sin 0.262358), A = 31.04 - 1.042 = 29.998 (cos 0.866043, sin
    # 0.499970) 10 m, E -0.009, A = 266.88 + 3.125 = 270.005, to the left; 100 m, E -24.569
    # (0.909461, -0.415789), A = 134.998
    "pandar40p": [
        (0, 3104, 0, 1000, (3.342824, -1.929825, 1.049430)),
        (4, 26688, 12, 2500, (0.000873, 10.0, -0.001571)),
        (9, 13604, 39, 25000, (-64.306374, -64.310863, -41.578879)),
    ],
    # E whole degrees, A as on the wire: 4 m ahead; 2 m at 15 degrees up to the right (cos 0.965926,
    # sin 0.258819); 65535 * 4 mm = 262.14 m behind, 16 degrees down (0.961262, -0.275637)
    "xt32": [
        (0, 0, 15, 1000, (4.0, 0.0, 0.0)),
        (3, 9000, 0, 500, (0.0, -1.931852, 0.517638)),
        (7, 18000, 31, 65535, (-251.985141, 0.0, -72.255576)),
    ],
    # every second degree from 15 down: channel 7 is at +1 (0.999848, 0.017452), 15 at -15
    "xt16": [
        (0, 0, 7, 1000, (3.999391, 0.0, 0.069810)),
        (3, 9000, 0, 500, (0.0, -1.931852, 0.517638)),
        (7, 27000, 15, 500, (0.0, 1.931852, -0.517638)),
    ],
    # 2 m, E -52.121 (0.613996, -0.789309), A = 81.26 + 8.736 = 89.996; 8 m, E -0.725, A = 184.88 -
    # 4.881 = 179.999; 5 m, E 52.133 (0.613831, 0.789438), A = 307.89 - 7.892 = 299.998 (0.499970,
    # -0.866043)
    "qt64": [
        (0, 8126, 0, 500, (0.000086, -1.227992, -1.578618)),
        (2, 18488, 31, 2000, (-7.999360, -0.000140, -0.101226)),
        (3, 30789, 63, 1250, (1.534484, 2.658018, 3.947189)),
    ],
}

# Microseconds from the packet's time to a channel of a block, single and dual return: offset of the
# shot + offset of the channel.
TIMES = {
    # -28.58 - 55.56 * 9 - 42.22, -28.58 - 3.62; dual: the first pair is 4 shots before the last
    "pandar40p": [(0, 0, -570.84, -293.04), (9, 39, -32.20, -32.20), (8, 39, -87.76, -32.20)],
    "xt32": [(0, 0, -344.0, -144.0), (7, 31, 52.872, 52.872), (6, 1, -42.488, 7.512)],
    "xt16": [(0, 0, -344.0, -144.0), (7, 15, 51.36, 51.36)],
    # 25.71 + 2.31; 25.71 + 166.67 + 136.45, as a pair with block 0 without the 166.67; 25.71 + 500
    # or 166.67 + 2.31
    "qt64": [(0, 0, 28.02, 28.02), (1, 63, 328.83, 162.16), (3, 0, 528.02, 194.69)],
}


def packet(
    name: str,
    azimuths: dict[int, int] | None = None,
    raw: dict[tuple[int, int], int] | None = None,
    **more: Any,
) -> bytes:
    """Return a packet of a model with these azimuths and distances.

    All other fields are as in the simulation.

    Args:
        azimuths: raw azimuth by block, otherwise 0.
        raw: raw distance by (block, channel).
    """
    sensor, (blocks, channels) = SENSORS[name], FORM[name]
    parsed = sensor.parse(simulate(sensor, 1)[0], "data")
    for block in range(blocks):
        parsed.blocks[block].azimuth = (azimuths or {}).get(block, 0)
        for channel in range(channels):
            parsed.blocks[block].channels[channel].distance = (raw or {}).get((block, channel), 0)
    return sensor.build("data", parsed, **more)


@pytest.mark.parametrize("name", VECTORS)
def test_a_captured_packet_has_the_fields_and_points_of_its_vector(
    name: str, tmp_path: Path
) -> None:
    data, expected, params = (
        vector_bytes(FILE, name),
        vectors(FILE)[name]["expected"],
        vectors(FILE)[name]["params"],
    )
    angles = zip(params["elevation_deg"], params["azimuth_offset_deg"], strict=True)
    file = tmp_path / "angles.csv"
    file.write_text(
        "Channel,Elevation,Azimuth\n"
        + "".join(f"{i},{e},{a}\n" for i, (e, a) in enumerate(angles, start=1))
    )
    sensor = VECTORS[name].configure(calibration=file, frame="vendor")
    parsed, packets = sensor.parse(data), decode(sensor, [data])
    assert len(data) == expected["length"]
    assert sensor.build(packets.frame, parsed) == data
    body = packets.raw["body"] if sensor.id == "hesai-qt128" else packets.raw
    assert body["blocks"]["azimuth"][0].tolist() == expected["azimuths"]
    assert all(parsed[HEADER[key]] == value for key, value in expected.items() if key in HEADER)
    assert int(packets.points().valid.sum()) == expected["n_nonzero"]
    tail = expected["tail"]
    assert all(parsed[NAMES[key]] == value for key, value in tail.items() if key in NAMES)
    moment = datetime.datetime(*tail["utc"]).replace(tzinfo=datetime.UTC)
    assert int(packets.time_ns[0]) == int(moment.timestamp()) * 10**9 + tail["us"] * 1000
    cloud, channels = packets.points(), len(params["elevation_deg"])
    for point in expected["points"]:
        index = point["block"] * channels + point["ch"]
        assert cloud.range[index] == pytest.approx(point["dist_m"])
        assert cloud.intensity is not None
        assert cloud.intensity[index] == point["reflectivity"]
        np.testing.assert_allclose(cloud.xyz[index], point["xyz"], atol=0.0006)
    assert not cloud.nominal


@pytest.mark.parametrize("name", SENSORS)
def test_points_by_hand(name: str) -> None:
    golden, channels = GOLDEN[name], FORM[name][1]
    azimuths, raw = (
        {block: azimuth for block, azimuth, *_ in golden},
        {(block, channel): raw for block, _, channel, raw, _ in golden},
    )
    cloud = decode(SENSORS[name], [packet(name, azimuths, raw)]).points()
    places = [block * channels + channel for block, _, channel, *_ in golden]
    assert np.flatnonzero(cloud.valid).tolist() == places
    assert_points(
        cloud, [(place, xyz) for place, (*_, xyz) in zip(places, golden, strict=True)], atol=3e-5
    )
    assert cloud.ring is not None
    assert cloud.ring[places].tolist() == [channel for _, _, channel, *_ in golden]
    assert cloud.nominal
    assert np.isinf(cloud.range[~cloud.valid]).all()
    vendor = SENSORS[name].configure(frame="vendor").decode([packet(name, azimuths, raw)]).points()
    np.testing.assert_array_equal(
        vendor.xyz[places], np.stack([-cloud.y, cloud.x, cloud.z], axis=1)[places]
    )


@pytest.mark.parametrize("name", SENSORS)
def test_firing_times_and_echoes(name: str) -> None:
    channels = FORM[name][1]
    dual: dict[str, Any] = (
        {"return_mode": 0x39} if name == "pandar40p" else {"return_mode": 0x39, "return_count": 2}
    )
    # `return_count` is only a maximum, which a packet with one return may also state.
    alone: dict[str, Any] = {name: value for name, value in dual.items() if name == "return_count"}
    single, double = (
        decode(SENSORS[name], [packet(name, **more)]).points() for more in (alone, dual)
    )
    for block, channel, one, two in TIMES[name]:
        place = block * channels + channel
        assert (single.time[place] * 1e6, double.time[place] * 1e6) == (
            pytest.approx(one, abs=1e-3),
            pytest.approx(two, abs=1e-3),
        )
    assert single.return_index is not None
    assert double.return_index is not None
    assert set(single.return_index) == {0}
    assert double.return_index[::channels].tolist() == [0, 1] * (FORM[name][0] // 2)


@pytest.mark.parametrize("name", ["xt32", "xt16", "qt64"])
def test_the_header_gives_blocks_unit_and_counter(name: str) -> None:
    sensor, channels = SENSORS[name], FORM[name][1]
    parsed = sensor.parse(packet(name, raw={(1, 2): 1000}))
    fewer = sensor.build(
        "data",
        parsed,
        blocks=parsed.blocks[:2],
        block_count=2,
        dis_unit=2,
        flags={"reserved": 0, "sequence": 0},
        sequence=None,
    )
    assert len(fewer) == 12 + 2 * (2 + 4 * channels) + 24
    packets = decode(sensor, [fewer, packet(name, raw={(1, 2): 1000}), fewer])
    cloud = packets.points()
    assert cloud.range[cloud.valid].tolist() == pytest.approx([2.0, 4.0, 2.0])
    assert len(cloud) == channels * (2 + FORM[name][0] + 2)
    assert (packets.stats.lost, packets.stats.duplicates) == (0, 0)
    assert np.isnan(packets["sequence"][[0, 2]]).all()


@pytest.mark.parametrize(
    ("year", "date"),
    [
        (17, 2017),
        (0x75, 2017),
        (69, 2069),
        (70, 1970),
        (99, 1999),
        (100, 2000),
        (24, 2024),
        (200, 2100),
        (255, 2155),
    ],
)
def test_the_clock_is_exact_to_the_microsecond(year: int, date: int) -> None:
    days = [(2, 28), (3, 1), (12, 31), (1, 1)] + [(2, 29)] * (date % 4 == 0 and date != 2100)
    for month, day in days:
        utc = dict(zip(UTC, (year, month, day, 23, 59, 58), strict=True))
        time = SENSORS["xt32"].decode([packet("xt32", utc=utc, timestamp=999_999)]).time_ns[0]
        moment = datetime.datetime(date, month, day, 23, 59, 58, tzinfo=datetime.UTC)
        assert int(time) == int(moment.timestamp()) * 10**9 + 999_999_000


def test_a_year_of_0_is_followed_by_unix_seconds() -> None:
    utc = dict(zip(UTC, b"\0" + (1_700_000_001).to_bytes(5, "big"), strict=True))
    for name, sensor in SENSORS.items():
        assert sensor.decode([packet(name, utc=utc, timestamp=7)]).time_ns.tolist() == [
            1_700_000_001_000_007_000
        ]


def angles(
    path: Path,
    channels: int,
    rows: str = "",
    head: str = "Channel,Elevation,Azimuth\n",
    tail: str = "",
) -> Path:
    path.write_text(
        head
        + (rows or "".join(f"{i},{i / 2 - 5},{i / 4}\n" for i in range(1, channels + 1)))
        + tail
    )
    return path


@pytest.mark.parametrize("name", SENSORS)
def test_correction_files_of_the_unit(name: str, tmp_path: Path) -> None:
    channels, data = FORM[name][1], [packet(name, {1: 9000}, {(1, 4): 1000})]
    marked = angles(
        tmp_path / "marked.csv",
        channels,
        head="EEFF,1,1\nLaser id,Elevation,Azimuth\n",
        tail="a1b2c3d4e5f6\n",
    )
    times = angles(
        tmp_path / "times.csv",
        channels,
        rows="".join(f"{i},{-i}\n" for i in range(channels, 0, -1)),
        head="Channel,fire time(μs)\n",
    )
    own = SENSORS[name].configure(calibration=marked)
    both = own.configure(firing_times=times)
    clouds = [
        sensor.decode(data).points()
        for sensor in (SENSORS[name], own, both, pickle.loads(pickle.dumps(both)))
    ]
    place = channels + 4
    assert [bool(cloud.nominal) for cloud in clouds] == [True, False, False, False]
    assert np.rad2deg(clouds[1].elevation[place]) == pytest.approx(-2.5)
    assert np.rad2deg(clouds[1].azimuth[place]) == pytest.approx(-91.25)
    assert clouds[2].time[place] - clouds[2].time[place - 4] == pytest.approx(-4e-6)
    assert_same_points(clouds[2], clouds[3])


@pytest.mark.parametrize("rows", ["1,0,0\n2,0,0\n", "1,x,0\n", "", "1,0,0\n" * 40])
def test_a_file_of_another_model_is_refused(rows: str, tmp_path: Path) -> None:
    with pytest.raises(ls.UsageError, match=r"angles\.csv"):
        P40.configure(calibration=angles(tmp_path / "angles.csv", 32, rows=rows))


def test_a_file_that_is_missing_or_has_no_numbers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ls.UsageError, match=r"none\.csv"):
        P40.configure(calibration=tmp_path / "none.csv")
    with pytest.raises(ls.UsageError, match="line 2, column 2: elevation nan is outside"):
        XT16.configure(
            calibration=angles(
                tmp_path / "nan.csv", 16, rows="".join(f"{i},nan,0\n" for i in range(1, 17))
            )
        )
    with pytest.raises(ls.UsageError):
        P40.configure(angles=tmp_path / "none.csv")


HEAD, ROWS = "Channel,Elevation,Azimuth", [f"{i},{2 * i - 17},{i / 4}" for i in range(1, 17)]
RADIANS = [f"{i},{np.deg2rad(2 * i - 17)},0" for i in range(1, 17)]
FAULTY = {
    "a channel twice": (
        [HEAD, *ROWS, ROWS[4]],
        "line 18, column 1: channel 5 is already in line 6",
    ),
    "a channel of others": (
        [HEAD, *ROWS, "17,1,1"],
        "line 18, column 1: channel 17 is out of range: this model has channels 1 to 16",
    ),
    "half a channel": ([HEAD, "1.5,1,1"], "line 2, column 1: channel 1.5 is out"),
    "a channel missing": (
        [HEAD, *ROWS[1:]],
        "expected all channels from 1 to 16, got 15 channels; the first missing channel is 1",
    ),
    "radians": (
        [HEAD, *RADIANS],
        (
            "line 2, column 2: the elevations have a spread of 0.523599, but for this"
            " model a spread of about 30 degrees is expected"
        ),
    ),
    "radians said": (
        ["Channel,Elevation(rad),Azimuth", *RADIANS],
        r"line 1, column 2: 'Elevation\(rad\)' must be in degrees",
    ),
    "too high": (
        [HEAD, ROWS[0], "2,414,0"],
        "line 3, column 2: elevation 414 is outside -90 .. 90 degrees",
    ),
    "too far around": ([HEAD, ROWS[0], "2,1,-414"], "line 3, column 3: azimuth -414 is outside"),
    "zeros": (
        [HEAD, *(f"{i},0,0" for i in range(1, 17))],
        "line 2, column 2: the elevations are all 0, but for this model",
    ),
    "no number": ([HEAD, "1,x,0"], "line 2, column 2: elevation must be a number, got 'x'"),
    "a cell short": ([HEAD, "1,2"], "line 2, column 3: azimuth must be a number, got ''"),
    "no headings": (ROWS, "line 1: no column is named 'channel'; the names are '1, -15, 0.25'"),
    "another kind": (
        ["Channel,fire time(us)", "1,2"],
        "line 1: no column is named 'elevation'; the names are 'Channel, fire time",
    ),
    "a picture": (["\x89PNG\r\n\x1a\n\0\0\0"], "no column is named 'channel'"),
    "empty": ([], "it is empty"),
    "huge": ([HEAD, *ROWS, " " * 1_000_000], "it is larger than 1 MB"),
}


@pytest.mark.parametrize("what", FAULTY)
def test_a_faulty_correction_file_is_refused_with_its_place(what: str, tmp_path: Path) -> None:
    file, (lines, message) = tmp_path / "angles.csv", FAULTY[what]
    file.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    with pytest.raises(ls.UsageError, match=rf"angles\.csv: .*{message}"):
        XT16.configure(calibration=file)


def test_columns_are_found_by_their_headings(tmp_path: Path) -> None:
    file, data = tmp_path / "angles.csv", [packet("xt16", {}, {(0, 4): 1000})]
    lines = [
        "Azimuth (deg),note,Elevation(°),Laser ID",
        *(f"{i / 4},?,{2 * i - 17},{i}" for i in range(1, 17)),
    ]
    file.write_text("\ufeff" + "\n".join(lines), encoding="utf-8")
    cloud = XT16.configure(calibration=file).decode(data).points()
    assert np.rad2deg((cloud.elevation[4], cloud.azimuth[4])) == pytest.approx((-7, -1.25))


def test_firing_times_are_microseconds(tmp_path: Path) -> None:
    file = tmp_path / "times.csv"
    file.write_text(
        "Channel,fire time(μs)\n" + "".join(f"{i},{i * 1e-6}\n" for i in range(1, 17)),
        encoding="utf-8",
    )
    with pytest.raises(
        ls.UsageError,
        match=(
            r"column 2: the fire times have a spread of 1\.5e-05, but for this model"
            r" a spread of about 45\.36 microseconds is expected"
        ),
    ):
        XT16.configure(firing_times=file)


@pytest.mark.parametrize("name", SENSORS)
def test_a_simulated_turn_is_one_whole_scan(name: str) -> None:
    blocks, channels = FORM[name]
    turn = {"pandar40p": 180, "xt32": 250, "xt16": 250, "qt64": 150}[name]
    scans = list(SENSORS[name].scans(simulate(SENSORS[name], 2 * turn + 20)))
    assert [(len(scan), scan.complete) for scan in scans[:2]] == [
        (turn * blocks * channels, False),
        (turn * blocks * channels, True),
    ]
    assert scans[1].rate_hz == pytest.approx(10, rel=1e-3)
    assert scans[1].points.shape == (turn * blocks, channels)
    assert scans[1].points.valid.all()


def test_the_nominal_tables_are_those_of_the_vendor() -> None:
    path = PROTOCOLS / "tables_udp3d.json"
    if not path.exists():
        pytest.skip(
            f"{path.name} is not here: set LIDARSPEC_CAPTURES to the folder of captures, with"
            " protocols beside it"
        )
    tables = json.loads(path.read_text(encoding="utf-8"))["hesai"]
    for name, model in {
        "pandar40p": "Pandar40P",
        "xt32": "PandarXT-32",
        "xt16": "PandarXT-16",
        "qt64": "PandarQT64",
    }.items():
        cloud, channels = SENSORS[name].decode([packet(name)]).points(), FORM[name][1]
        table = tables[model]
        np.testing.assert_allclose(
            np.rad2deg(cloud.elevation[:channels]), table["elevation_deg"], atol=1e-5
        )
        np.testing.assert_allclose(
            np.rad2deg(-cloud.azimuth[:channels]), table["azimuth_offset_deg"], atol=1e-5
        )
        np.testing.assert_allclose(
            np.diff(cloud.time[:channels]) * 1e6, np.diff(table["firetime_us"]), atol=1e-6
        )


def test_points_and_times_of_a_pandar64_by_hand() -> None:
    parsed = P64.parse(simulate(P64, 1)[0], "data")
    for block in range(6):
        parsed.blocks[block].azimuth = 8896 if block == 4 else 0
        for channel in range(64):
            parsed.blocks[block].channels[channel].distance = (
                2500 if (block, channel) == (4, 6) else 0
            )
    single, dual = (
        decode(P64, [P64.build("data", parsed, return_mode=mode)]).points() for mode in (0x37, 0x39)
    )
    # channel 6: E 1.686 (cos .999567, sin .029422), 1.042 to the right: A = 88.96 + 1.042 = 90.002;
    # 10 m
    assert_points(single, [(4 * 64 + 6, (-0.000349, -9.995671, 0.294223))])
    # -42.58 - 55.56 - 11.444; of a pair with the last block, the last shot
    assert [cloud.time[4 * 64 + 6] * 1e6 for cloud in (single, dual)] == [
        pytest.approx(-109.584),
        pytest.approx(-54.024),
    ]


def test_the_echoes_of_an_xt32m_are_as_many_as_its_return_mode_says() -> None:
    parsed = XT32M.parse(simulate(XT32M, 1)[0])
    echoes = {
        mode: (
            decode(XT32M, [XT32M.build("data", parsed, return_mode=mode, return_count=3)]).points()
        )
        for mode in (0x37, 0x3C, 0x3D)
    }
    found = {
        mode: cloud.return_index.reshape(6, 32)[:, 0].tolist()
        for mode, cloud in echoes.items()
        if cloud.return_index is not None
    }
    assert found == {0x37: [0] * 6, 0x3C: [0, 1] * 3, 0x3D: [0, 1, 2] * 2}


@pytest.mark.parametrize("place", [20, 1050, 1062])
def test_each_crc_of_a_qt128_is_held(place: int) -> None:
    data = bytearray(vector_bytes(FILE, "hesai_qt128_real"))
    assert len(QT128.decode([bytes(data)])) == 1
    data[place] ^= 1
    assert len(decode(QT128, [bytes(data)], "data")) == 0


def test_the_loops_of_a_qt128_take_turns() -> None:
    parsed = QT128.parse(simulate(QT128, 1)[0])
    single = decode(QT128, [QT128.build("data", parsed, return_count=2)]).points()
    values = {"return_mode": 0x39, "mode_flag.loop": 1}
    odd = decode(QT128, [QT128.build("data", parsed, **values)]).points()
    # channel 65 fires 1.456 us after the shot in the first loop, and 0.6 in the second; shots are
    # 111.11 us apart, the first at 9
    assert [single.time[block * 128 + 64] * 1e6 for block in (0, 1)] == [
        pytest.approx(10.456),
        pytest.approx(120.71),
    ]
    assert [odd.time[block * 128 + 64] * 1e6 for block in (0, 1)] == [
        pytest.approx(9.6),
        pytest.approx(9.6),
    ]


def test_commands_are_those_of_the_protocol() -> None:
    for name, command, arguments in (
        ("hesai_ptc_get_calibration", "get_calibration", {}),
        ("hesai_ptc_get_status", "get_status", {}),
        ("hesai_ptc_set_return_dual", "return_mode", {"mode": 2}),
        ("hesai_ptc_standby", "standby", {"standby": 1}),
    ):
        assert XT32.command(command, **arguments) == vector_bytes(FILE, name)
    assert (
        XT32.command("send_to", host="192.168.1.100", port=2368, gps_port=10110).hex()
        == "4774200000000008c0a801640940277e"
    )


def on_free_ports(sensor: ls.Sensor, said: bytes, timeout: float = SLACK) -> ls.Sensor:
    """Return the sensor on free ports, with this reply to `get_calibration`."""
    answers = {"get_calibration": [("answer", {"payload": said})]}
    links = {"data": Udp(free_port()), "control": Tcp(free_port())}
    patient = {
        name: dataclasses.replace(command, timeout=timeout)
        for name, command in sensor.commands.items()
    }
    return dataclasses.replace(
        sensor,
        links=links,
        commands=patient,
        simulation=dataclasses.replace(sensor.simulation, answers=answers),
    )


@pytest.mark.slow
def test_angles_are_requested_on_opening(tmp_path: Path) -> None:
    said = "Laser id,Elevation,Azimuth\n" + "".join(f"{i},{16.5 - i},0.25\n" for i in range(1, 33))
    unit, file = on_free_ports(XT32, said.encode(), TIMEOUT_S), angles(tmp_path / "own.csv", 32)
    data = f"udp://127.0.0.1:{unit.links['data'].ports[0]}"
    with virtual_port(unit, to=data) as port:
        with ls.open(port.path, unit) as device:
            cloud = device.latest(TIMEOUT_S).points
            assert device.send("speed", rate=600).values.code == 0x17
        port.wait_for_commands(["get_calibration", "speed"])
        assert (cloud.nominal, device.warnings) == (False, [])
        assert np.rad2deg(cloud.elevation[:2]) == pytest.approx([15.5, 14.5])
        # The file has the angles, so they are not requested.
        with ls.open(port.path, unit.configure(calibration=file)) as device:
            assert np.rad2deg(device.latest(TIMEOUT_S).points.elevation[:2]) == pytest.approx(
                [-4.5, -4.0]
            )
        assert port.device.commands_received == ["get_calibration", "speed"]
        # Nothing answers at this address.
        with ls.open(f"{data}?control=127.0.0.1:{free_port()}", unit) as device:
            assert device.latest(TIMEOUT_S).points.nominal
            assert any(
                "refuses connections" in said and "reading continues without the values" in said
                for said in device.warnings
            )


@pytest.mark.slow
def test_a_unit_that_does_not_report_angles_is_read() -> None:
    unit = on_free_ports(XT16, b"")
    refusing = {"get_calibration": [("answer", {"result": 5, "payload": b""})]}
    unit = dataclasses.replace(
        unit, simulation=dataclasses.replace(unit.simulation, answers=refusing)
    )
    with (
        virtual_port(unit, to=f"udp://127.0.0.1:{unit.links['data'].ports[0]}") as port,
        ls.open(port.path, unit) as device,
    ):
        assert device.latest(TIMEOUT_S).points.nominal
        assert any(
            "result not_supported (5) instead of done (0)" in said for said in device.warnings
        )


# Of a packet of two blocks: (azimuth on the wire, block, channel, raw distance in 4 mm, x y z,
# microseconds from the packet's time).
STATED = {
    # E 14.436 (cos 0.968427, sin 0.249298), A = 86.74 + 3.257 = 89.997; 3.148 - 27.778 + 4.436
    # E -25.01577 (0.906191, -0.422868), A = 183.45 - 3.448749 = 180.001251; 3.148 + 0.776 in state
    # 1, in which channel 126 does not fire
    "pandar128": [
        (8674, 0, 0, 2500, (0.000507, -9.684267, 2.492984), -20.194),
        (18345, 1, 125, 0, (0.0, 0.0, 0.0), 3.148),
        (18345, 1, 127, 2500, (-9.061914, 0.000198, -4.228677), 3.924),
    ],
    # E -3.001 (0.998629, -0.052353), A = 88.68 + 1.324 = 90.004; in all states alike
    "ot128": [
        (8868, 0, 64, 2500, (-0.000697, -9.986286, -0.523534), -13.547),
        (8868, 1, 64, 2500, (-0.000697, -9.986286, -0.523534), 14.231),
    ],
    # E -4.965 (0.996248, -0.086547), A = 100.04 + 169.963 = 270.003; -1888 - 111 + 95.18
    "jt128": [(10004, 0, 0, 2500, (0.000522, 9.962478, -0.865472), -1903.82)],
}


@pytest.mark.parametrize("name", STATED)
def test_points_and_times_by_hand_of_models_named_in_the_status(name: str) -> None:
    sensor = ls.sensor(f"hesai-{name}")
    parsed = sensor.parse(simulate(sensor, 1)[0], "data")
    for block in parsed.body.blocks:
        for channel in block.channels:
            channel.distance = 0
    for azimuth, block, channel, raw, _, _ in STATED[name]:
        parsed.body.blocks[block].azimuth, parsed.body.blocks[block].channels[channel].distance = (
            azimuth,
            raw,
        )
    cloud = decode(sensor, [sensor.build("data", parsed, operational_state=0)]).points()
    for _, block, channel, raw, xyz, fired in STATED[name]:
        place = block * 128 + channel
        assert cloud.valid[place] == (raw > 0)
        assert_points(cloud, [(place, xyz)] if raw else [], atol=3e-5)
        assert cloud.time[place] * 1e6 == pytest.approx(fired, abs=1e-3)
    dual = sensor.decode(
        [sensor.build("data", parsed, return_mode=0x39, operational_state=1)]
    ).points()
    assert dual.return_index is not None
    assert dual.return_index[::128].tolist() == [0, 1]
    # Each block of a Pandar128 has its own operating state.
    assert dual.time[0] == dual.time[128] or name == "pandar128"


@pytest.mark.slow
@pytest.mark.parametrize("name", STATED)
def test_models_named_in_the_status_are_identified(name: str) -> None:
    sensor = ls.sensor(f"hesai-{name}")
    assert (
        identify_sample(SampleBytes("", tuple(simulate(sensor, 20)), datagrams=True)).sensor
        is sensor
    )


def test_channels_have_the_further_bytes_that_the_header_says() -> None:
    sensor = ls.sensor("hesai-ot128")
    parsed = sensor.parse(simulate(sensor, 1)[0], "data")
    parsed.flags.confidence = parsed.flags.environment = 1
    for block in parsed.body.blocks:
        for channel in block.channels:
            channel.confidence, channel.environment = 7, 9
    data = sensor.build("data", parsed)
    assert len(data) == 861 + 2 * 2 * 128
    packets = decode(sensor, [data, simulate(sensor, 1)[0]])
    assert len(packets) == 2
    np.testing.assert_array_equal(packets.points().range[:256], packets.points().range[256:])


@pytest.mark.slow
def test_reported_angles_survive_a_bad_network() -> None:
    unit = on_free_ports(XT32, TABLE_32.to_file())
    data = f"udp://127.0.0.1:{unit.links['data'].ports[0]}"
    with (
        virtual_port(unit, to=data, faults=Faults(loss=0.5, reorder=3)) as port,
        ls.open(port.path, unit) as device,
    ):
        assert device.learned == {"calibration": TABLE_32.to_file()}


AT128 = ls.sensor("hesai-at128")


def make_at128_packet(azimuth: float, raw: dict[tuple[int, int], int], **more: Any) -> bytes:
    """Return a packet of an AT128 with this azimuth of the mirror."""
    parsed = AT128.parse(simulate(AT128, 1)[0], "data")
    for number, block in enumerate(parsed.body.blocks):
        block.azimuth, block.fine_azimuth = int(azimuth * 100), round(azimuth * 25600) % 256
        for index, channel in enumerate(block.channels):
            channel.distance = raw.get((number, index), 0)
    return AT128.build("data", parsed, **more)


def test_points_and_times_of_an_at128_by_hand() -> None:
    # 10 m. The face behind begins at 143.44 degrees: 173.445 is 30.005 after it, the beam 60.01 +
    # 2.4 = 62.41 clockwise from the left, with E 12.883 (cos 0.974827, sin 0.222964); sin 62.41 =
    # 0.886285, cos 62.41 = 0.463141
    first = make_at128_packet(173.445, {(0, 0): 2500, (1, 0): 2500})
    # across 0: 20 is 116.867 after the face at 263.133, the beam 233.734 + 0.65 = 234.384
    across = make_at128_packet(20.0, {(1, 17): 2500})
    cloud = decode(AT128, [first, across]).points()
    assert_points(
        cloud,
        [(0, (8.639747, 4.514825, 2.229640)), (128, (8.639747, 4.514825, 2.229640))],
        atol=3e-4,
    )
    assert np.rad2deg(cloud.azimuth[256 + 128 + 17]) == pytest.approx(90 - 234.384, abs=1e-3)
    assert cloud.nominal
    # -9.249 - 2 * 41.666, and - 41.666; channel 2 fires 8.24 us later; of a pair both are of the
    # last shot
    assert (cloud.time[[0, 2, 128]] * 1e6).tolist() == pytest.approx(
        [-92.581, -84.341, -50.915], abs=1e-3
    )
    dual = decode(AT128, [make_at128_packet(173.445, {}, return_mode=0x39)]).points()
    assert (dual.time[[0, 128]] * 1e6).tolist() == pytest.approx([-50.915, -50.915], abs=1e-3)
    assert dual.return_index is not None
    assert dual.return_index[[0, 128]].tolist() == [0, 1]
    assert len(first) == 1086


def make_mirror_file(**values: Any) -> bytes:
    """Return the mirror file of a unit with these values and their hash."""
    data = at128.FILE.build({**at128.FILE.parse(AT128_FILE), **values})[:-32]
    return data + hashlib.sha256(data).digest()


AT128_FILE = at128.TABLE.to_file()


def test_an_at128_has_the_angles_of_its_file(tmp_path: Path) -> None:
    """The corrections at 173.5 degrees are interpolated from those at 172 and 174."""
    adjust = bytearray(128 * 180)
    adjust[0 * 180 + 86], adjust[0 * 180 + 87] = 10, 0xFC  # 0.2 and -0.08 degrees of channel 0
    start = [295_360, 1_836_032, 3_368_102]  # 23.075, 143.44 and 263.133 degrees
    told = make_mirror_file(
        resolution=2, start=start, azimuth_adjust=bytes(adjust), elevation_adjust=bytes(adjust)
    )
    file = tmp_path / "unit.dat"
    file.write_bytes(told)
    data = [make_at128_packet(173.5, {(0, 0): 2500})]
    for source in (file, Learned(told)):
        cloud = decode(AT128.configure(calibration=source), data).points()
        # 30.06 degrees after the face, 60.12 + 4.8 of the channel; a quarter of 0.2 and three of
        # -0.08 degrees: -0.01
        assert np.rad2deg(cloud.azimuth[0]) == pytest.approx(90 - (60.12 + 4.8 - 0.01), abs=2e-4)
        assert np.rad2deg(cloud.elevation[0]) == pytest.approx(2 * 12.883 - 0.01, abs=2e-4)
        assert not cloud.nominal


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"Channel,Elevation,Azimuth\n",
            r"unit\.dat: not a correction file of an AT128, version 1\.5 \(\.dat\)",
        ),
        (AT128_FILE[:-40], "not a correction file of an AT128"),
        (
            AT128_FILE[:100] + b"x" + AT128_FILE[101:],
            "is corrupt: its SHA-256",
        ),
        (AT128_FILE + b"x", "is corrupt: its SHA-256"),
    ],
    ids=["text", "short", "changed", "longer"],
)
def test_an_invalid_at128_file_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    file = tmp_path / "unit.dat"
    file.write_bytes(content)
    with pytest.raises(ls.UsageError, match=message):
        AT128.configure(calibration=file)


def test_an_at128_scan_is_one_mirror_face() -> None:
    scans = list(AT128.scans(simulate(AT128, 1300)))
    assert [(len(scan), scan.complete) for scan in scans[:2]] == [
        (600 * 256, False),
        (600 * 256, True),
    ]
    assert np.rad2deg(scans[1].points.azimuth).min() == pytest.approx(-62.3, abs=0.1)
    assert scans[1].points.x.min() > 0


def test_a_jt16_is_read_from_its_line_and_a_broken_byte_costs_one_packet(tmp_path: Path) -> None:
    """JT16 sends packets of 80 bytes and IMU samples of 34 bytes in one stream.

    The CRC of the samples covers two additional zero bytes.
    """
    sensor = ls.sensor("hesai-jt16")
    own = json.loads((Path(at128.__file__).parent / "vectors.json").read_text(encoding="utf-8"))
    data, felt = (
        bytes.fromhex(vector["hex"]) for vector in own if vector.get("sensor") == "hesai-jt16"
    )
    broken = felt[:20] + bytes([felt[20] ^ 1]) + felt[21:]
    packets = decode(sensor, data + felt + broken + b"\xee\xff" + data)
    assert (len(data), len(felt), dict(packets.stats.frames)) == (80, 34, {"data": 2, "imu": 1})
    assert packets.stats.bad_checksum == 1
    assert packets.points().nominal
    moment = datetime.datetime(2024, 1, 2, 3, 4, 5, 123456, datetime.UTC)
    assert packets.time_ns[0] == int(moment.timestamp()) * 10**9 + 123_456_000
    file = angles(
        tmp_path / "own.csv", 16, rows="".join(f"{i},{2 * i},{180 + i}\n" for i in range(1, 17))
    )
    cloud = sensor.configure(calibration=file).decode(data).points()
    assert np.rad2deg((cloud.elevation[15], cloud.azimuth[15])).tolist() == pytest.approx([32, 84])
    assert [
        len(scan) for scan in sensor.scans(b"".join(simulate(sensor, 1300))) if scan.complete
    ] == [9600]
