"""Tests of Hokuyo scanners: the manual's examples, partial scans and simulation."""

from __future__ import annotations

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.simulation.device import SimulatedDevice
from tests.evidence import decode, vector_bytes

URG, UST, UTM = (
    ls.sensor("hokuyo-urg04lx"),
    ls.sensor("hokuyo-ust10lx"),
    ls.sensor("hokuyo-utm30lxew"),
)
LINES = ("pp_dmin", "pp_dmax", "pp_ares", "pp_amin", "pp_amax", "pp_afrt", "pp_scan")
LOOK_ALIKE = {"hokuyo-ust10lx", "hokuyo-ust20lx", "hokuyo-utm30lx", "hokuyo-utm30lxew"}


def hokuyo(name: str) -> bytes:
    return vector_bytes("vectors_serial2d.json", f"scip_{name}")


def test_the_examples_of_the_manual_are_read() -> None:
    lines = b"".join(hokuyo(line) + b"\n" for line in LINES)
    parameters = URG.parse(
        b"PP\n" + hokuyo("status_00") + b"\nMODL:URG-04LX;9\n" + lines + b"\n", frame="parameters"
    )
    assert [
        int(parameters[name].text)
        for name in ("shortest", "longest", "division", "first", "last", "ahead", "speed")
    ] == [
        20,
        5600,
        1024,
        44,
        725,
        384,
        600,
    ]
    scan = (
        b"MD0384038401000\n"
        + hokuyo("status_99")
        + b"\n"
        + hokuyo("4char")
        + b"?\n"
        + hokuyo("3char")
        + b"M\n\n"
    )
    values = URG.parse(scan, frame="distances")
    assert (values.time, values.points[0].distance) == (16_000_000, 5432)
    refused = URG.parse(b"MD0384038401000\n" + hokuyo("status_0E") + b"\n\n")
    assert refused.status == b"0E"
    short = URG.parse(
        b"GS0384038401\n00P\n" + hokuyo("4char") + b"?\n" + hokuyo("2char") + b"5\n\n",
        frame="one_short",
    )
    assert short.points[0].distance == 1234


def test_a_wrong_check_character_anywhere_is_a_wrong_checksum() -> None:
    scan = next(iter(ls.simulate(UST, 1)))
    for place in (scan.index(b"99b") + 2, scan.index(b"99b") + 8, len(scan) - 3):
        damaged = bytearray(scan)
        damaged[place] = ord("0") if damaged[place] != ord("0") else ord("1")
        stats = UST.decode(bytes(damaged) + scan).stats
        assert (stats.frames["distances"], stats.bad_checksum) == (1, 1)


def test_partial_and_clustered_scans_have_the_requested_directions() -> None:
    asked = URG.configure(first=128, last=640, cluster=4, content="short")
    assert asked.command("start") == b"MS0128064004000\n"
    cloud = asked.decode(b"".join(ls.simulate(asked, 2))).points()
    assert len(cloud) == 2 * 129
    np.testing.assert_allclose(
        cloud.azimuth[:2], np.deg2rad(np.array([129.5, 133.5]) - 384) * 360 / 1024, atol=1e-6
    )
    with pytest.raises(ls.UsageError, match="the steps must be from 0 to 768"):
        URG.configure(last=1080)
    with pytest.raises(ls.UsageError, match="content must be one of distances, short"):
        URG.configure(content="intensities")


def test_a_step_with_several_echoes_has_a_point_for_each() -> None:
    asked = UTM.configure(content="echoes", first=539, last=541)
    assert asked.command("start") == b"ND0539054101000\n"
    assert asked.command("get_scan") == b"HD0539054101\n"
    scan = (
        b"ND0539054101000\n"
        + hokuyo("status_99")
        + b"\n"
        + hokuyo("4char")
        + b"?\n1Dh1Dh&0Vh&0CB1Dh6\n\n"
    )
    for sensor in (asked, UTM):
        cloud = decode(sensor, scan).points()
        assert cloud.return_index.tolist() == [0, 1, 2] * 3
        np.testing.assert_allclose(
            cloud.range[cloud.valid], [5.432, 5.432, 2.488, 1.234, 5.432], rtol=1e-6
        )
        np.testing.assert_allclose(
            cloud.azimuth, np.deg2rad(np.repeat([-0.25, 0, 0.25], 3)), atol=1e-6
        )
    with pytest.raises(
        ls.UsageError, match="content must be one of distances, intensities, short, not 'echoes'"
    ):
        UST.configure(content="echoes")


def test_a_cluster_of_00_is_one_step_and_the_numbers_of_errors_are_no_points() -> None:
    values = UST.parse(next(iter(ls.simulate(UST, 1))))
    values.cluster.ones = 0
    values.points[3].distance = 5
    cloud = decode(UST, UST.build("distances", values)).points()
    assert (len(cloud), cloud.valid[2:5].tolist()) == (1081, [True, False, True])


def test_models_are_identified_by_steps_and_replies() -> None:
    scans = b"".join(ls.simulate(UST, 3))
    assert not URG.decode(scans).stats.frames
    assert {one.sensor.id for one in identify_sample(SampleBytes("", (scans,))).candidates} | {
        "hokuyo-ust10lx"
    } == LOOK_ALIKE
    device = SimulatedDevice(UTM)
    device.start(0)
    device.receive(UTM.command("get_parameters"), 0)
    told = b"".join(data for _, data in device.outgoing(10**6))
    assert told.startswith(b"PP\n00P\nMODL:UTM-30LX-EW;I\nDMIN:23;7\nDMAX:60000;J\n")
    device.receive(UTM.command("start"), 10**6)
    data = b"".join(data for _, data in device.outgoing(10**8))
    assert data.startswith(b"MD0000108001000\n00P\n\nMD0000108001000\n99b\n")
    assert {
        one.sensor.id for one in identify_sample(SampleBytes("", (told + data,))).candidates
    } == {"hokuyo-utm30lxew"}
