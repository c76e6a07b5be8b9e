"""Measure a figure of a promise.

Each function returns the figure as text, and whether the promise is kept.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import tracemalloc
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import lidarspec as ls
from lidarspec import Scan, Sensor
from lidarspec.recording.format import DATAGRAM, HEADER, MAGIC, RECEIVED, Header, pack_record
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Serial
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests import made_captures as made
from tests.engine.oracle import Oracle
from tests.engine.streams import (
    Books,
    clean,
    cut_randomly,
    damage,
    decode_chunks,
    hostile_streams,
    worst,
)
from tests.engine.test_limits import feed, garbage, peak
from tests.engine.test_linear_time import seconds
from tests.every_sensor import distinct_frames, every_sensor, stream_sensors
from tests.lines import free_port
from tests.packets.test_reorder import LAST_BIT, disturb

ROOT = Path(__file__).parents[2]
#: byte error rates, and lengths of bursts.
RATES, BURSTS = (0.0, 1e-5, 1e-4, 1e-3, 5e-3), (1, 8, 16, 64)


@dataclass(frozen=True)
class Figure:
    """A measured figure as text, and whether the promise is kept."""

    words: str
    kept: bool


def streams() -> dict[str, Sensor]:
    """Return the sensors and shapes that send a stream of bytes, each set of frames once, by id."""
    return {sensor.id: sensor for sensor in stream_sensors(every_sensor().values())}


def exclude_shapes(sensors: dict[str, Sensor]) -> dict[str, Sensor]:
    """Return the sensors without the invented shapes."""
    return {name: sensor for name, sensor in sensors.items() if name in ls.sensors()}


def splits(share: float) -> Figure:
    """P1: compare splits at every byte, and random ones, with the whole stream."""
    tried = differing = 0
    for sensor in streams().values():
        subject = SensorUnderTest(sensor)
        data, source = (
            clean(subject, length=max(int(1000 * share), 300)),
            subject.make_random("soak"),
        )
        books = Books(sensor).feed(data)
        whole, stats = books.finish(), books.decoder.stats
        cuts = [[data[:spot], data[spot:]] for spot in range(0, len(data), 1 if share == 1 else 7)]
        for parts in [*cuts, *(list(cut_randomly(data, source)) for _ in range(50))]:
            books = Books(sensor)
            for part in parts:
                books.feed(part)
            tried += 1
            differing += books.finish() != whole or books.decoder.stats != stats
    return Figure(
        f"{tried:,} splits of streams of {len(streams())} real and invented sensors: {differing}"
        " results differ",
        not differing,
    )


def measure_recovery(share: float) -> Figure:
    """P2: compare the engine's frames of damaged streams with the oracle's."""
    frames = missed = extra = 0
    for sensor, seed in itertools.product(streams().values(), range(max(int(3 * share), 1))):
        data = clean(SensorUnderTest(sensor), seed=seed, length=int(2000 * share) + 200)[:4000]
        for rate, burst in itertools.product(RATES, BURSTS) if share == 1 else [(1e-3, 1)]:
            noisy = damage(data, rate, seed, burst=burst)
            found, wanted = set(decode_chunks(sensor, noisy)), set(Oracle(sensor, noisy).frames())
            frames, missed, extra = (
                frames + len(wanted),
                missed + len(wanted - found),
                extra + len(found - wanted),
            )
    return Figure(
        f"{frames:,} frames found by brute force: {missed} missed, {extra} extra",
        not missed + extra,
    )


def measure_errors(share: float) -> Figure:
    """P3: read hostile inputs with everything that reads."""
    number = int(400_000 * share) + 300
    only = [] if share >= 0.1 else ["--only", "hex", "--only", "recording"]
    with tempfile.TemporaryDirectory() as folder:
        words = [
            sys.executable,
            "-m",
            "tests.fuzz",
            "--engine",
            "seeded",
            "--inputs",
            str(number),
            "--folder",
            folder,
            *only,
        ]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    found = next(
        (line.split() for line in done.stdout.splitlines() if line.startswith("all ")),
        ["all", "0", "0", "0", "1"],
    )
    names = sorted(
        {
            place.partition(":")[0]
            for place in re.findall(
                r"^(?!make)\w[^:\n]*: \S+:\d+$", done.stdout.rpartition("\nall ")[2], re.MULTILINE
            )
        }
    )
    where = f" ({', '.join(names)})" if names else ""
    return Figure(
        f"{int(found[1]):,} hostile inputs of `make fuzz`: {found[-1]} findings{where}",
        done.returncode == 0,
    )


def measure_memory(share: float) -> Figure:
    """P4: measure the memory of a decoder that reads garbage, beyond the input."""
    size = int(50 * share) + 1
    data, held = garbage(1 << 20), {}
    for name, sensor in few(exclude_shapes(streams()), share):
        feed(sensor, data, chunk=1 << 16)  # what is made once, and for all decoders
        held[name] = peak(lambda sensor=sensor: feed(sensor, data, size, 1 << 16))
    most = max(held, key=lambda name: held[name])
    return Figure(
        f"{size} MB of garbage: at most {held[most] / 1e3:,.0f} kB held ({most})",
        held[most] < 1 << 20,
    )


def linear(share: float) -> Figure:
    """P5: compare the time of twice the input with that of the input."""
    length, ratios = int(400_000 * share) + 20_000, {}
    for name, sensor in few(exclude_shapes(streams()), share):
        for what, data in (("garbage", garbage(length)), ("worst stream", worst(sensor, length))):
            half, whole = (
                min(seconds(sensor, data[:size]) for _ in range(5))
                for size in (length // 2, length)
            )
            ratios[f"{name}, {what}"] = whole / max(half, 1e-3)
    most = max(ratios, key=lambda name: ratios[name])
    return Figure(
        f"twice the bytes take at most {ratios[most]:.2f} times as long ({most})",
        ratios[most] <= 2.5,
    )


def delay(share: float) -> Figure:
    """P6: count the bytes after a frame until it is returned, for the longest frame."""
    worst_share = 0.0
    for _, sensor in few(streams(), share):
        data = SensorUnderTest(sensor).stream(rounds=3)[: int(20_000 * share) + 3000]
        bound = max(
            frame.max_length * frame.confirm
            for frame in sensor.frames.values()
            if frame.direction == "in"
        )
        decoder = sensor.decoder()
        for spot in range(len(data)):
            for found in decoder.feed(data[spot : spot + 1]):
                worst_share = max(worst_share, (spot + 1 - found.offset - len(found.data)) / bound)
    return Figure(
        f"at most {worst_share:.2f} times as many bytes as the longest frame has",
        worst_share < 1,
    )


def round_trips(share: float) -> Figure:
    """P7: parse frames and build them again."""
    tried = lost = 0
    frames = distinct_frames(every_sensor().values())
    for sensor, kind in frames:
        until_then = time.monotonic() + 3 * share + 0.01
        for seed in range(10_000):
            data = sensor.example(kind, seed=seed)
            tried, lost = (
                tried + 1,
                lost + (sensor.build(kind, sensor.parse(data, frame=kind)) != data),
            )
            if time.monotonic() > until_then:
                break
    return Figure(
        f"{tried:,} frames of {len(frames)} types: {lost} come back as other bytes", not lost
    )


def in_any_order(share: float) -> Figure:
    """P17: compare duplicate and reordered packets with the same packets in order."""
    differing = []
    sensors = {name: sensor for name, sensor in ls.sensors().items() if sensor.datagrams}
    for name, sensor in few(sensors, share):
        frames = simulate(sensor, 1000)
        expected = whole(sensor, frames)
        scans = whole(sensor, disturb(frames, name))
        is_same = len(scans) == len(expected) and all(
            np.allclose(scan.points.x, same.points.x, rtol=LAST_BIT, atol=LAST_BIT, equal_nan=True)
            for scan, same in zip(scans, expected, strict=True)
        )
        if not is_same:
            differing.append(name)
    words = (
        f"{len(few(sensors, share))} sensors, 1,000 packets each, 10 % duplicated,"
        " moved by up to 3 places: "
    )
    return Figure(
        words
        + (f"other scans of {', '.join(differing)}" if differing else "the scans are the same"),
        not differing,
    )


def whole(sensor: Sensor, frames: Sequence[bytes]) -> list[Scan]:
    """Return the complete scans of some frames."""
    with warnings.catch_warnings(action="ignore"):
        return [
            scan
            for scan in sensor.scans(frames if sensor.datagrams else b"".join(frames))
            if scan.complete
        ]


def measure_blocked_rotors(share: float) -> Figure:
    """P19: decode sensors with a constant angle."""
    told, kept = [], True
    cases: list[tuple[str, Callable[[Any], object]]] = [
        ("ldrobot-ld06", lambda frame: frame.update({"start_angle": 9000, "end_angle": 9000})),
        (
            "velodyne-vlp16",
            lambda frame: [block.update({"azimuth": 9000}) for block in frame.blocks],
        ),
    ]
    for name, stop in cases:
        sensor, frames = ls.sensor(name), []
        for data in simulate(sensor, int(2000 * share) + 600):
            parsed = sensor.parse(data)
            stop(parsed)
            frames.append(sensor.build(sensor.data_frame, parsed))
        with warnings.catch_warnings(action="ignore"):
            scans = list(sensor.scans(frames if sensor.datagrams else b"".join(frames)))
        packets = len(frames) / max(len(scans), 1)
        told.append(
            f"{name}: {len(scans)} scans from {len(frames)} packets,"
            f" {sum(scan.complete for scan in scans)} complete"
        )
        kept &= len(scans) > 1 and packets < 500 and not any(scan.complete for scan in scans)
    return Figure("blocked rotor, " + "; ".join(told), kept)


#: Bytes of a stream that are decoded together, about as many as a serial port holds.
PIECE_BYTES = 4096
#: CPU seconds after which a stream is not measured any longer.
MAX_STREAM_SECONDS = 0.5
#: Runs of each stream; the best one counts, since others include a collection of all garbage.
RATE_RUNS = 3
#: Bytes a second of a link that is no serial port.
OTHER_LINE_RATE = 1e6


def slowest(share: float) -> Figure:
    """P20: compare the worst of many hostile streams with the rate of the connection.

    Also measure the memory per byte of frames.
    """
    rates = {}
    held = {}
    fastest = line_rates()
    for name, sensor in few(exclude_shapes(streams()), share):
        subject = SensorUnderTest(sensor)
        line = fastest[_frames_key(sensor)]
        for what, data in hostile_streams(subject, int(16_000 * share) + 4000):
            sensor.decoder().feed(data)  # what is made once, and for all decoders
            best = max(decoding_rate(sensor, data) for _ in range(RATE_RUNS))
            rates[f"{name}, {what}"] = best / line
        data = (subject.stream(rounds=2) * 200)[:16_000]
        sensor.decoder().feed(data)  # as above: layouts that are new to the sensor
        tracemalloc.start()
        found = sensor.decoder().feed(data)
        held[name] = tracemalloc.get_traced_memory()[0] / len(data)
        tracemalloc.stop()
        del found
    slow = min(rates, key=lambda name: rates[name])
    fat = max(held, key=lambda name: held[name])
    words = (
        f"{len(rates)} hostile streams: at least {rates[slow]:.2g} times as fast as the line"
        f" ({slow}), at most {held[fat]:.0f} bytes of memory for each byte ({fat})"
    )
    return Figure(words, rates[slow] >= 10 and held[fat] < 64)


def decoding_rate(sensor: Sensor, data: bytes) -> float:
    """Return how many bytes of a stream are decoded in a CPU second, as a device does."""
    decoder = sensor.decoder()
    start = time.process_time()
    size = 0
    while size < len(data) and time.process_time() - start < MAX_STREAM_SECONDS:
        decoder.frames(data[size : size + PIECE_BYTES])
        size += PIECE_BYTES
    return min(size, len(data)) / (time.process_time() - start)


def line_rates() -> dict[Hashable, float]:
    """Return the bytes per second of the fastest line, for each set of frames.

    Sensors with the same frames share one entry.
    """
    found: dict[Hashable, float] = {}
    for sensor in every_sensor().values():
        key = _frames_key(sensor)
        bauds = [max(link.bauds) for link in sensor.links.values() if isinstance(link, Serial)]
        found[key] = max(found.get(key, 0.0), *(baud / 10 for baud in bauds), 0.0)
    return {key: rate or OTHER_LINE_RATE for key, rate in found.items()}


def _frames_key(sensor: Sensor) -> Hashable:
    """Return a key that is the same for sensors with the very same frames."""
    return tuple(map(id, sensor.frames.values()))


def strangers(share: float) -> Figure:
    """P21: send valid frames from another address during a recording."""
    sensor, number = ls.sensor("robosense-helios16p"), int(300 * share) + 50
    frames, port = simulate(sensor, number), free_port()
    others = [frames[0], sensor.example("difop", seed=9)]
    with contextlib.ExitStack() as stack:
        path = Path(stack.enter_context(tempfile.TemporaryDirectory()), "all.lsr")
        own, other = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
        )
        own.bind(("127.0.0.1", 0))
        other.bind(("127.0.0.2", 0))
        device = stack.enter_context(ls.open(f"udp://127.0.0.1:{port}", sensor, record=path))
        points, batches = 0, device.packets(wait=0.05)
        for index, frame in enumerate(frames):
            own.sendto(frame, ("127.0.0.1", port))
            if index:
                other.sendto(others[index % 2], ("127.0.0.1", port))
            time.sleep(0.001)
        try:
            quiet = 0
            while quiet < 10:
                batch = next(batches)
                points, quiet = points + len(batch), 0 if len(batch) else quiet + 1
        except ls.LidarSpecError as error:
            return Figure(f"the session ended: {error}"[:160], False)
        foreign = device.stats.foreign
    return Figure(
        f"{number} frames and {number - 1} of another sender: {points} read, {foreign} foreign",
        (points, foreign) == (number, number - 1),
    )


def nothing_runs(share: float) -> Figure:
    """P22: read a settings file that names Python code, and hostile recordings.

    The settings file is in a parent folder. The headers of the recordings name a descriptor or a
    file.
    """
    with tempfile.TemporaryDirectory() as place:
        folder, home = Path(place, "project", "below"), Path(place, "home")
        folder.mkdir(parents=True)
        home.mkdir()
        (folder.parent / "evil.py").write_text(f"open({str(Path(place, 'ran'))!r}, 'w').close()\n")
        (folder.parent / "lidarspec.toml").write_text(
            '[device.front]\nsource = "x.bin"\nsensor = "./evil.py"\n'
        )
        frame = ls.sensor("hesai-xt16").example("data")
        for index, value in enumerate((0, "angles.csv", "/etc/passwd", "../x")):
            header = Header("hesai-xt16", {"calibration": value}, datagrams=True).to_json()
            parts = [
                MAGIC,
                pack_record(HEADER, header, 1),
                pack_record(RECEIVED, frame, 2, flags=DATAGRAM),
            ]
            (folder / f"{index}.lsr").write_bytes(b"".join(parts))
        ran = opened = 0
        for source in ("front", "0.lsr", "1.lsr", "2.lsr", "3.lsr"):
            words = [sys.executable, "-c", TRIED, source]
            environment = {**os.environ, "XDG_CONFIG_HOME": str(home), "PYTHONPATH": str(ROOT)}
            done = subprocess.run(
                words,
                input="of the terminal",
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            opened += (
                json.loads(done.stdout.splitlines()[-1])["left"] != "of the terminal"
                if done.stdout
                else 1
            )
        ran = Path(place, "ran").exists()
    words = (
        f"5 untrusted files: {'Python code ran' if ran else 'no Python code ran'}; {opened} files"
        " made lidarspec read a file descriptor or crash"
    )
    return Figure(words, not ran and not opened)


#: opens a source, and says what is left on standard input.
TRIED = """
import json, sys, lidarspec as ls
try:
    with ls.open(sys.argv[1]) as device:
        list(device.packets())
except (ls.LidarSpecError, OSError):
    pass
print(json.dumps({"left": sys.stdin.read()}))
"""


def complete(share: float) -> Figure:
    """P23: remove packets within a scan, and damage one counter."""
    told, kept = [], True
    for name, number in (("velodyne-vlp16", 50), ("robosense-m1", 315)):
        sensor = ls.sensor(name)
        frames = simulate(sensor, 3000)
        left = frames[:1400] + frames[1400 + number :]
        lost, before, after = (
            sensor.decode(left).stats.lost,
            len(whole(sensor, frames)),
            len(whole(sensor, left)),
        )
        told.append(
            f"{name} without {number} packets: {lost} lost, {before - after} fewer scans complete"
        )
        kept &= abs(lost - number) <= 1 and after < before
    return Figure("; ".join(told), kept)


def not_in_silence(share: float) -> Figure:
    """P24: check messages and exit code for damaged, guessed or truncated data."""
    velodyne = [ls.sensor("velodyne-vlp16").example("data", seed=seed) for seed in range(3)]
    blocks = [made.packet(made.frame(data)) for data in velodyne]
    cases = {
        "cut.pcap": (made.pcap(*map(made.frame, velodyne))[:-40], "velodyne-vlp16", 0),
        "damaged.pcap": (
            made.section()
            + made.interface()
            + b"".join([*blocks[:2], blocks[2][:-4] + bytes(4), *blocks[2:]]),
            "velodyne-vlp16",
            1,
        ),
        "guessed.pcap": (
            made.pcap(*map(made.frame, simulate(ls.sensor("hesai-xt32"), 300))),
            "hesai-xt32",
            0,
        ),
    }
    silent = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (data, sensor, code) in cases.items():
            Path(folder, name).write_bytes(data)
            words = [
                sys.executable,
                "-m",
                "lidarspec",
                "convert",
                name,
                "out.csv",
                "-s",
                sensor,
                "--force",
            ]
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
            silent += (
                []
                if done.returncode == code and done.stderr
                else [f"{name} (exit code {done.returncode})"]
            )
    return Figure(
        "a truncated file, a damaged file, and a file without calibration:"
        f" {', '.join(silent) or 'each is reported'}",
        not silent,
    )


def few(sensors: dict[str, Sensor], share: float) -> list[tuple[str, Sensor]]:
    """Return all of them, or one of them in a very short run."""
    return list(sensors.items())[: None if share >= 0.1 else 1]
