"""Tests of detection in captures and on live ports.

They include related models that differ only in their clock or name, and bytes of no known sensor.
"""

from __future__ import annotations

import gzip
import random
import socket
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec import CommandError, SourceError, UsageError, WireError, simulate
from lidarspec.detect import identification, listen
from lidarspec.detect.identification import (
    detect,
    find_fitting_sensors,
    identify_sample,
    identify_senders,
    rate_sensors,
)
from lidarspec.detect.listen import (
    SampleBytes,
    list_bauds,
    list_start_required,
    list_udp_ports,
    probe,
    read_samples,
)
from lidarspec.drafting.crc_search import DIVISION_WORK, QUICK_WORK, iter_crc_matches, remainder
from lidarspec.drafting.periods import find_structure
from lidarspec.drafting.samples import SampleFrames
from lidarspec.spec import Crc
from lidarspec.testing.fixtures import virtual_port
from tests.evidence import capture
from tests.lines import TIMEOUT_S, Port, port, until, working
from tests.representatives import REPRESENTATIVES

CAPTURED = {
    "cspc/coin_d4_ludovatech_issue2_partial.bin": "cspc-coin-d4",
    "ldrobot/ld06_3_consecutive_frames.bin": "ldrobot-ld06",
    "hesai/40p/packets.derived.pcap": "hesai-pandar40p",
    "hesai/40p_20hz/lidar_20Hz.pcapng": "hesai-pandar40p",
    "hesai/xt32/packets.derived.pcap": "hesai-xt32",
    "hesai/qt64/packets.derived.pcap": "hesai-qt64",
    "robosense/helios16p/packets.derived.pcap": "robosense-helios5515",
    "velodyne/hdl32e/sample_velodyne_hdl32.pcap": "velodyne-hdl32e",
    "velodyne/vlp16_dual/packets.derived.pcap": "velodyne-vlp16",
    "velodyne/vlp16_old_firmware/vlp-16-test-90deg-1-50-frames.pcap": "velodyne-vlp16",
    "velodyne/vlp16_raw/recording.bin": "velodyne-vlp16",
    "velodyne/vlp16_raw/packet.bin": "velodyne-vlp16",
}
RPLIDARS = {
    f"slamtec-rplidar-{model}" for model in ("a1", "a2", "a3", "c1", "s1", "s2", "s2l", "s3", "t1")
}
TMINIS = {"ydlidar-tmini", "ydlidar-tmini-plus", "ydlidar-tmini-pro"}
OUSTERS = {"ouster-os0", "ouster-os1", "ouster-os2", "ouster-osdome"}
TIMS = {"sick-tim561", "sick-tim571", "sick-tim781", "sick-tim781s", "sick-tim871s"}
#: capture -> those that send the same.
ALIKE = {
    "sick/20210113_tim871s_elephant.tcpstream.bin": TIMS,
    "sick/multiscan_compact_test01_udp_scandata.telegrams.bin": {
        "sick-multiscan136",
        "sick-picoscan150",
    },
    "ydlidar/packets_checksum_ok_concat.bin": TMINIS,
    "ouster/OS-0-32-U1_v2.2.0_1024x10.pcap": OUSTERS,
    "ouster/OS-1-128_v2.3.0_1024x10_lb_n3.pcap": OUSTERS,
    "ouster/OS-2-32-U0_v2.0.0_1024x10.pcap": OUSTERS,
    "ouster/fragments/same_ports.pcap": OUSTERS,
}


#: the representatives, and related models that only a checksum, clock or name tells apart.
FEW = (
    *REPRESENTATIVES,
    *(f"ldrobot-{name}" for name in ("ld06", "ld14", "ld14p", "ld20", "stl06p")),
    "velodyne-hdl32e",
    "hesai-xt32",
)


@pytest.fixture
def few_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let detection load only few sensors, because each of them takes time."""
    few = {name: ls.sensor(name) for name in sorted(FEW)}
    for module in (identification, listen):
        monkeypatch.setattr(module, "sensors", lambda: few)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Listen until enough data has arrived, however slow the machine is."""
    monkeypatch.setitem(identification.identify_senders.__kwdefaults__, "seconds", TIMEOUT_S)


@pytest.mark.usefixtures("few_installed")
@pytest.mark.parametrize(
    "name", ["ldrobot/ld06_3_consecutive_frames.bin", "velodyne/hdl32e/sample_velodyne_hdl32.pcap"]
)
def test_a_capture_is_its_sensors_among_a_few(name: str) -> None:
    assert detect(capture(name)).id == CAPTURED[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", CAPTURED)
def test_every_capture_is_its_sensors(name: str) -> None:
    assert detect(capture(name)).id == CAPTURED[name]


def test_no_capture_is_left_out() -> None:
    folder = capture(next(iter(CAPTURED))).parents[1]
    there = {
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.suffix in (".pcap", ".pcapng", ".bin")
    }
    assert there == {*CAPTURED, *ALIKE}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ALIKE if name.startswith("sick/")])
def test_captures_of_other_devices_fit_no_sensor(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = {sensor.vendor for sensor in map(ls.sensor, ALIKE[name])}
    rest = {other: sensor for other, sensor in ls.sensors().items() if sensor.vendor not in theirs}
    monkeypatch.setattr("lidarspec.detect.identification.sensors", lambda: rest)
    with pytest.raises(WireError, match="no frame of an installed sensor"):
        detect(capture(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", ALIKE)
def test_identical_frames_are_reported_as_ambiguous(name: str) -> None:
    # An IMU sends on a port of its own.
    for found in (one for one in identify_senders(capture(name)) if one.scores):
        assert found.sensor is None
        assert {score.sensor.id for score in found.candidates} == ALIKE[name]
    with pytest.raises(UsageError, match="send the same frames"):
        detect(capture(name))


@pytest.mark.usefixtures("few_installed")
@pytest.mark.parametrize(
    "name", ["ldrobot-stl27l", "ldrobot-ld06", "velodyne-vlp16", "velodyne-hdl32e"]
)
def test_clocks_tell_twins_apart(name: str) -> None:
    sensor = ls.sensor(name)
    data = simulate(sensor, 60, start=7)
    found = identify_sample(SampleBytes("", tuple(data), datagrams=sensor.datagrams))
    assert found.sensor is sensor
    assert "the clock advances by" in found.candidates[0].evidence


def old_firmware(
    number: int, *, period: float = 12 * 110.592e-6, mode: int = 0x37, product: int = 0x21
) -> list[bytes]:
    """Return Velodyne packets with a product byte that two models share.

    Both an HDL-32E and a VLP-16 with old firmware send it.
    """
    data = simulate(ls.sensor("velodyne-vlp16"), number)
    tails = (
        round(i * period * 1e6).to_bytes(4, "little") + bytes([mode, product])
        for i in range(number)
    )
    return [packet[:1200] + tail for packet, tail in zip(data, tails, strict=True)]


def swap_pairs(data: list[bytes]) -> list[bytes]:
    return [data[i ^ 1] for i in range(len(data) & ~1)]


@pytest.mark.slow
@pytest.mark.usefixtures("few_installed")
@pytest.mark.parametrize(
    "as_it_comes",
    [
        lambda data: [packet for packet in data if random.Random(packet[1200:1204]).random() > 0.1],
        lambda data: [packet for packet in data for _ in range(2)],
        swap_pairs,
    ],
    ids=["a tenth lost", "doubled", "swapped"],
)
def test_the_clock_identifies_a_model_on_a_bad_network(
    as_it_comes: Callable[[list[bytes]], list[bytes]],
) -> None:
    found = identify_sample(SampleBytes("", tuple(as_it_comes(old_firmware(200))), datagrams=True))
    assert (found.sensor and found.sensor.id, found.candidates[0].evidence) == (
        "velodyne-vlp16",
        "the clock advances by 1.33 ms per packet",
    )


@pytest.mark.usefixtures("few_installed")
def test_the_pace_of_a_clock_is_that_of_the_mode_that_the_packets_name() -> None:
    dual = old_firmware(60, period=6 * 110.592e-6, mode=0x39)
    assert (
        found := identify_sample(SampleBytes("", tuple(dual), datagrams=True)).sensor
    ) is not None
    assert found.id == "velodyne-vlp16"


@pytest.mark.slow
def test_an_unreliable_name_is_not_used() -> None:
    found = identify_sample(SampleBytes("", tuple(old_firmware(2)), datagrams=True))
    assert (found.sensor, {score.sensor.id for score in found.candidates}) == (
        None,
        {"velodyne-hdl32e", "velodyne-vlp16"},
    )


@pytest.mark.slow
def test_uninstalled_related_models_are_recognized(tmp_path: Path) -> None:
    xt32 = ls.sensor("hesai-xt32")
    xt32m = [
        xt32.build("data", xt32.parse(packet), block_count=6, blocks=xt32.parse(packet).blocks[:6])
        for packet in simulate(xt32, 5)
    ]
    assert identify_sample(SampleBytes("", tuple(xt32m), datagrams=True)).sensor is ls.sensor(
        "hesai-xt32m"
    )
    data, name = old_firmware(60, period=6 * 110.592e-6, product=0x23), "velodyne-vlp32a"
    found = identify_sample(SampleBytes("", tuple(data), datagrams=True))
    assert (found.candidates, [*found.others]) == ((), [name])
    (tmp_path / "one.bin").write_bytes(data[0])
    with pytest.raises(
        WireError, match=f"these are frames of {name} .*, which no installed plugin supports"
    ):
        detect(tmp_path / "one.bin")


@pytest.mark.slow
def test_a_relative_that_only_its_start_would_tell_leaves_a_doubt() -> None:
    sensor = ls.sensor("cspc-coin-d4")
    data = b"".join(simulate(sensor, 60))
    at_its_baud_rate = identify_sample(SampleBytes("", (data,), baud=230_400))
    left = {score.sensor.id for score in at_its_baud_rate.candidates}
    assert left == {"cspc-coin-d4", "cspc-coin-d4a", "cspc-coin-d6", "ydlidar-g2", *TMINIS}
    named = sensor.build(
        "info",
        model=b"COIN-D4".ljust(12, b"\0"),
        zero_angle=0,
        direction=0,
        correction=0,
        reserved=bytes(3),
        revision=1,
    )
    assert identify_sample(SampleBytes("", (named + data,))).sensor is sensor


@pytest.mark.slow
def test_the_baud_rate_decides_between_equal_candidates() -> None:
    sensor = ls.sensor("slamtec-rplidar-s2")
    data = (sensor.build("scan_descriptor"), *simulate(sensor, 300))
    assert {
        score.sensor.id for score in identify_sample(SampleBytes("", data)).candidates
    } == RPLIDARS
    found = identify_sample(SampleBytes("", data, baud=1_000_000))
    assert {score.sensor.id for score in found.candidates} == {
        f"slamtec-rplidar-{name}" for name in ("s2", "s2l", "s3")
    }
    assert found.candidates[0].evidence == "the sensor sends at 1000000 baud"
    named = sensor.build(
        "info", model=0x81, firmware_minor=1, firmware_major=1, hardware=1, serial=bytes(16)
    )
    found = identify_sample(SampleBytes("", (named, *data), baud=1_000_000))
    assert (found.sensor and found.sensor.id, found.candidates[0].evidence) == (
        "slamtec-rplidar-s3",
        "info.model is RPLIDAR S3, S3M1",
    )


@pytest.mark.usefixtures("few_installed")
def test_a_scan_is_recognized_from_its_middle() -> None:
    sensor = ls.sensor("slamtec-rplidar-a1")
    assert "slamtec-rplidar-a1" in {
        score.sensor.id
        for score in rate_sensors([b"".join(simulate(sensor, 300))], datagrams=False)
    }


@pytest.mark.slow
def test_the_middle_of_a_scan_is_read_with_the_answer_that_began_it() -> None:
    data = b"".join(simulate(ls.sensor("slamtec-rplidar-a1"), 300))
    found = identify_sample(SampleBytes("", (data,)))
    assert {(score.sensor.id, score.sensor.options["answer"]) for score in found.candidates} == {
        (name, "node") for name in RPLIDARS
    }
    assert len(found.candidates[0].sensor.decode(data)) == 300


@pytest.mark.usefixtures("few_installed")
def test_scores_and_fitting_sensors_agree() -> None:
    packed = gzip.compress(b"".join(b"%d\n" % number for number in range(40_000)))
    assert rate_sensors([packed], datagrams=False)
    assert identify_sample(SampleBytes("", (packed,))).scores == ()
    assert find_fitting_sensors([packed], datagrams=False) == []


def firmware_bug(number: int) -> list[bytes]:
    """Return frames of an STL-27L with a checksum that omits the first byte."""
    crc = Crc(width=8, poly=0x4D)
    return [
        frame[:46] + bytes([crc(frame[1:46])])
        for frame in simulate(ls.sensor("ldrobot-stl27l"), number)
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("few_installed")
def test_frames_with_only_wrong_checksums_are_reported(tmp_path: Path) -> None:
    data, path = b"".join(firmware_bug(60)), tmp_path / "bug.bin"
    found = identify_sample(SampleBytes("", (data,)))
    assert (found.scores, found.sensor) == ((), None)
    alike = " or ".join(
        f"ldrobot-{name}" for name in ("ld06", "ld14", "ld14p", "ld20", "stl06p", "stl27l")
    )
    assert found.fault.startswith(f"60 data frames have the constants and lengths of {alike}, ")
    assert (
        "In 60 of 60 frames, the checksum field (the last byte) contains CRC-8 poly 0x4d, computed"
        " over 45 of 47 bytes" in found.fault
    )
    path.write_bytes(data)
    with pytest.raises(WireError, match="all have wrong checksums") as error:
        detect(path)
    assert error.value.__notes__ == [f"next: lidarspec crc {path}"]
    noise = random.Random(2)
    right_by_chance = [frame[:46] + noise.randbytes(1) for frame in firmware_bug(60)]
    assert (
        "no other checksum algorithm was found"
        in identify_sample(SampleBytes("", (b"".join(right_by_chance[:12]),))).fault
    )


@pytest.mark.usefixtures("few_installed")
def test_a_wrong_checksum_now_and_then_is_damage_and_no_bug() -> None:
    good, bad = simulate(ls.sensor("ldrobot-stl27l"), 60), firmware_bug(60)
    assert identify_sample(SampleBytes("", (b"".join(bad[:58] + good[58:]),))).fault == ""


@pytest.mark.usefixtures("few_installed")
def test_chance_frames_in_much_noise_are_no_fit() -> None:
    noise = random.Random(4).randbytes(40_000)
    data = noise[:20_000] + simulate(ls.sensor("ldrobot-stl27l"), 1)[0] + noise[20_000:]
    assert rate_sensors([data], datagrams=False)
    assert identify_sample(SampleBytes("", (data,))).scores == ()


@pytest.mark.usefixtures("few_installed")
def test_damage_does_not_hide_a_sensor() -> None:
    source, data = random.Random(5), bytearray(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 300)))
    for _ in range(len(data) // 100):
        data[source.randrange(len(data))] ^= 0xFF
    found = identify_sample(SampleBytes("", (bytes(data),)))
    assert found.sensor is not None
    assert found.sensor.id == "ldrobot-stl27l"
    assert 0.4 < found.scores[0].share < 0.8


@pytest.mark.usefixtures("few_installed", "patient")
@pytest.mark.parametrize(
    "name", ["ldrobot-stl27l", pytest.param("ldrobot-ld06", marks=pytest.mark.slow)]
)
def test_a_simulated_port_is_its_sensors(name: str) -> None:
    with virtual_port(name) as made:
        assert detect(made.path).id == name
        assert detect(f"serial://{made.path}?baud=230400").id == name


@pytest.mark.slow
@pytest.mark.usefixtures("few_installed")
def test_a_sensor_that_has_to_be_started_first() -> None:
    assert {"cspc-m1c1-mini", "slamtec-rplidar-a1"} <= {
        sensor.id for sensor in list_start_required()
    }
    with virtual_port("cspc-m1c1-mini") as made:
        with pytest.raises(CommandError, match="no data received") as error:
            detect(made.path)
        assert error.value.__notes__ == [f"next: lidarspec doctor {made.path}"]
        assert made.device.commands_received == []
        heard = next(heard for heard in probe(made.path) if heard.size)
        found = identify_sample(heard)
        assert (found.sensor and found.sensor.id, found.candidates[0].evidence) == (
            "cspc-m1c1-mini",
            "info.model is M1C1_Mini",
        )
        until(lambda: made.device.commands_received[-1] == "stop")


@pytest.mark.usefixtures("few_installed", "patient")
def test_udp_datagrams_of_two_senders_are_separated() -> None:
    vlp, xt = simulate(ls.sensor("velodyne-vlp16"), 40), simulate(ls.sensor("hesai-xt32"), 40)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second,
    ):
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.2", 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe_socket:
            probe_socket.bind(("127.0.0.1", 0))
            target = probe_socket.getsockname()[1]

        def send(stop: threading.Event) -> None:
            while not stop.is_set():
                for one, other in zip(vlp, xt, strict=True):
                    first.sendto(one, ("127.0.0.1", target))
                    second.sendto(other, ("127.0.0.1", target))
                    time.sleep(0.002)

        with working(send):
            found = {
                one.sample.sender: one.sensor and one.sensor.id
                for one in identify_senders(f"udp://127.0.0.1:{target}")
            }
            with pytest.raises(UsageError, match="data from several sensors"):
                detect(f"udp://127.0.0.1:{target}")
            assert detect(f"udp://127.0.0.1:{target}?src=127.0.0.2").id == "hesai-xt32"
    assert found == {"127.0.0.1": "velodyne-vlp16", "127.0.0.2": "hesai-xt32"}


@pytest.mark.slow
@pytest.mark.usefixtures("few_installed", "patient")
def test_bytes_at_a_wrong_baud_rate_fit_no_sensor(tmp_path: Path) -> None:
    source = random.Random(6)
    with port(tmp_path) as made, working(lambda stop: _noise(made, source, stop)) as stop:
        with pytest.raises(WireError, match="no frame of an installed sensor"):
            detect(made.name)
        stop.set()
        made.discard()


def _noise(made: Port, source: random.Random, stop: threading.Event) -> None:
    while not stop.wait(0.005):
        made.send(source.randbytes(100))


def test_a_source_that_cannot_be_opened_is_a_source_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such port"):
        detect("/dev/ttyNONE7")
    with pytest.raises(UsageError, match="standard input"):
        detect("-")
    (tmp_path / "empty.bin").write_bytes(b"")
    with pytest.raises(WireError, match="no bytes"):
        detect(tmp_path / "empty.bin")


def test_declared_bauds_and_ports_are_tried() -> None:
    assert {115_200, 150_000, 230_400, 921_600} <= set(list_bauds())
    assert {2368, 6699, 7788} <= set(list_udp_ports())


def test_a_pseudo_terminal_is_listened_to_once() -> None:
    with virtual_port("ldrobot-stl27l") as made:
        (heard,) = read_samples(made.path, seconds=0.3)
    assert heard.baud is None
    assert heard.size > 47


def test_without_sensors_the_rate_or_port_has_to_be_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listen, "sensors", dict)
    with port(tmp_path) as made:
        assert list(read_samples(made.name, seconds=0.1))
    with pytest.raises(SourceError, match=r"serial:///dev/ttyUSB0\?baud="):
        next(read_samples("serial:///dev/ttyUSB0"))
    with pytest.raises(SourceError, match=r"udp://\?port="):
        next(read_samples("udp://"))


def test_of_sensors_with_the_same_frames_those_of_the_vendor_with_most_of_them_come_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = {name: ls.sensor(name) for name in ("cspc-coin-d4", "ydlidar-s4b", "ydlidar-tmini")}
    monkeypatch.setattr(identification, "sensors", lambda: few)
    found = identify_sample(SampleBytes("", tuple(simulate(few["cspc-coin-d4"], 30))))
    assert [score.sensor.id for score in found.candidates] == [
        "ydlidar-s4b",
        "ydlidar-tmini",
        "cspc-coin-d4",
    ]


@pytest.mark.parametrize(("sends", "listened"), [(False, 3), (True, None)])
def test_a_line_that_is_silent_at_three_rates_is_not_listened_to_at_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sends: bool, listened: int | None
) -> None:
    # A real port has a baud rate.
    monkeypatch.setattr("lidarspec.detect.listen.has_no_baud", lambda port: False)
    told: list[str] = []
    with (
        port(tmp_path) as made,
        working(lambda stop: _noise(made, random.Random(4), stop) if sends else None) as stop,
    ):
        heard = list(read_samples(made.name, seconds=0.1, on_progress=told.append))
        stop.set()
        made.discard()
    assert len(heard) == len(told) == (listened or len(list_bauds()))
    assert {one.baud for one in heard} >= {list_bauds()[0], min(list_bauds()), max(list_bauds())}
    assert told[0] == f"{made.name} at {list_bauds()[0]} baud"


def make_bodies(size: int, number: int) -> list[bytes]:
    """Return random bytes, `number` times `size` of them."""
    source = random.Random(size)
    return [source.randbytes(size) for _ in range(number)]


class TestStructure:
    """Tests of the structure of unknown bytes."""

    def test_accidental_similarity_is_no_structure(self) -> None:
        assert find_structure([random.Random(1).randbytes(10_000)], datagrams=False) is None
        few = b"".join(
            b"\xde\xad\xbe\xef" + random.Random(seed).randbytes(996) for seed in range(3)
        )
        found = find_structure([few], datagrams=False)
        assert found is not None
        assert (found.sync, found.period) == (b"\xde\xad\xbe\xef", 1000)

    @pytest.mark.parametrize(("size", "number"), [(60, 40), (200, 8)])
    def test_a_quick_search_divides_no_more_than_a_fixed_number_of_bytes(
        self, monkeypatch: pytest.MonkeyPatch, size: int, number: int
    ) -> None:
        divided = 0

        def count_and_divide(a: int, b: int) -> int:
            nonlocal divided
            divided += max(a.bit_length() - b.bit_length() + 1, 0) // 8
            return remainder(a, b)

        monkeypatch.setattr("lidarspec.drafting.crc_search.remainder", count_and_divide)
        monkeypatch.setattr("lidarspec.drafting.crc_search.QUICK_WORK", QUICK_WORK // 64)
        samples = SampleFrames(make_bodies(size, number))
        assert list(iter_crc_matches(samples, quick=True)) == []
        # The steps of Euclid's algorithm pass over the bytes twice.
        assert 0 < divided <= 2 * QUICK_WORK // 64 // DIVISION_WORK
        quick = divided
        assert list(iter_crc_matches(samples)) == []
        assert divided - quick > 2 * quick

    @pytest.mark.parametrize(("size", "number"), [(60, 40), (600, 8)])
    def test_a_quick_search_finds_a_usual_crc(self, size: int, number: int) -> None:
        checksummed = SampleFrames(
            body + zlib.crc32(body).to_bytes(4, "little") for body in make_bodies(size, number)
        )
        assert next(iter_crc_matches(checksummed, quick=True)).name == "CRC-32"

    @pytest.mark.slow
    def test_frames_of_one_length(self) -> None:
        data = b"".join(simulate(ls.sensor("ldrobot-stl27l"), 60))[13:]
        found = find_structure([data[:1000], data[1000:]], datagrams=False)
        assert found is not None
        assert (found.sync[:2], found.period, len(found.frames)) == (b"\x54\x2c", 47, 59)
        assert (found.checksums[0].source, found.checksums[0].right) == (
            "Crc(width=8, poly=0x4D)",
            59,
        )

    def test_frames_with_a_length_field(self) -> None:
        found = find_structure(
            [b"\xfe" + b"".join(simulate(ls.sensor("cspc-m1c1-mini"), 60))], datagrams=False
        )
        assert found is not None
        assert (found.sync, found.period, str(found.length)) == (
            b"\xaa\x55",
            None,
            "10 + 3 x byte at 3",
        )
        assert found.checksums[0].source == "WordXor(head=8, groups=(1, 2))"

    @pytest.mark.slow
    def test_long_frames_with_shorter_ones_in_them(self) -> None:
        found = find_structure([b"".join(simulate(ls.sensor("robosense-m1"), 60))], datagrams=False)
        assert found is not None
        assert (found.sync[:4].hex(), found.period) == ("55aa5aa5", 1210)

    def test_datagrams(self) -> None:
        found = find_structure(simulate(ls.sensor("robosense-m1"), 20), datagrams=True)
        assert found is not None
        assert (found.sync[:4].hex(), found.period, found.share) == ("55aa5aa5", 1210, 1.0)

    @pytest.mark.parametrize(
        "data",
        [b"", b"\x00" * 5000, random.Random(7).randbytes(20_000), b"a line of some text\n" * 3],
    )
    def test_no_structure_is_found_in_random_bytes(self, data: bytes) -> None:
        assert find_structure([data], datagrams=False) is None
        assert find_structure([data] if data else [], datagrams=True) is None
