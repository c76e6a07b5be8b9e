"""What holds for many frames together: nothing is lost, both engines agree, and batches do not matter."""

from __future__ import annotations

from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import packed
from lidarspec.packets.packets import joined
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.scans import Scan, scans_of
from lidarspec.testing import subject as material
from lidarspec.testing.comparisons import assert_backends_agree, assert_same_packets, assert_same_places, assert_well_formed
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.frames import acceptable, free
from lidarspec.testing.subject import MANY, Subject


def a_clean_input_loses_nothing(subject: Subject) -> None:
    """Frames one after another are found as they are, and every byte of them."""
    frames = subject.conversation()
    data = material.delivery(subject.sensor, frames)
    found = [(found.frame, found.data) for found in subject.sensor.split(data)]
    wrong = next((index for index, pair in enumerate(zip(found, frames, strict=False)) if pair[0] != pair[1]), min(len(found), len(frames)))
    if found != frames:
        name = frames[min(wrong, len(frames) - 1)][0]
        took = f"; a {found[wrong][0]!r} frame is found there" if wrong < len(found) and found[wrong][0] != name else ""
        raise Violation("LS306" if took else "LS401", f"of {len(frames)} frames, number {wrong} is not found{took}", name)
    stats = subject.sensor.decode(data).stats
    require(not stats.plugin_errors, "LS414", stats.tracebacks[0].strip().splitlines()[-1] if stats.tracebacks else "")
    require((stats.bytes_skipped, stats.pending) == (0, 0), "LS401", f"{stats.bytes_skipped} bytes skipped, {stats.pending} pending")
    require(stats.bytes_in == sum(len(part) for _, part in frames), "LS412", f"{stats.bytes_in} bytes counted")


def compiled_and_interpreted_agree(subject: Subject) -> None:
    """Clean and damaged input gives the same frames, packets, points and counters on both engines."""
    few, source = len(subject.sensor.frames) <= MANY, subject.source("agree")
    frames = subject.conversation(rounds=3 if few else 1)
    assert_backends_agree(subject.sensor, material.delivery(subject.sensor, frames))
    for _ in range(6 if few else 2):
        noisy = [(name, material.mutated(data, source) if source.random() < 0.4 else data) for name, data in frames]
        assert_backends_agree(subject.sensor, material.delivery(subject.sensor, noisy))


def values_at_the_edges_read_alike(subject: Subject, name: str) -> None:
    """Frames with values at the edges of their fields' ranges read alike on both engines."""
    fields, source = codec(subject.sensor.frames[name]).schema.fields, subject.source(f"edges {name}")
    if subject.sensor.frames[name].direction == "out" or subject.sensor.frames[name].max_length > material.SHORT:
        return
    built = []
    for seed in range(8):
        parsed = subject.sensor.parse(subject.example(name, seed=seed), frame=name)
        for holder, key, path in list(material.integers(parsed)):
            if free(fields.get(path)) and path not in subject.drawers(name) and source.random() < 0.3:
                holder[key] = source.choice(fields[path].limits)
        made = acceptable(subject, name, parsed)
        built += [(name, made)] if made is not None else []
    assert_backends_agree(subject.sensor, material.delivery(subject.sensor, built))


def single_packets_equal_a_batch(subject: Subject) -> None:
    """Packets that come one by one are those of one batch."""
    found = subject.sensor.split(material.delivery(subject.sensor, subject.conversation()))
    for name in material.incoming(subject.sensor):
        stats = [Decoder(subject.sensor, stream=True).stats for _ in range(2)]
        single, batch = (PacketStream(subject.sensor, name, each) for each in stats)
        assert_same_packets(joined([single.add([packed([item])]) for item in found]), batch.add([packed(found)]))


def scans_do_not_depend_on_batches(subject: Subject) -> None:
    """Scans are cut alike, with the same points, however many packets come at a time."""
    found = subject.sensor.split(material.delivery(subject.sensor, subject.conversation(rounds=5)))

    def scans(size: int) -> list[Scan]:
        stats = Decoder(subject.sensor, stream=True).stats
        stream = PacketStream(subject.sensor, subject.sensor.data_frame, stats)
        batches = [stream.add([packed(found[start : start + size])]) for start in range(0, len(found), size)]
        scans = list(scans_of(subject.sensor, batches))
        require(not stats.plugin_errors, "LS414", stats.tracebacks[0] if stats.tracebacks else "")
        return scans

    whole = scans(len(found))
    require(whole, "LS404", "there is no scan")
    for size in (1, 2, 5):
        parts = scans(size)
        same = [(len(scan), scan.complete) for scan in parts] == [(len(scan), scan.complete) for scan in whole]
        require(same, "LS404", f"{size} packets at a time give other scans than all at once")
        for one, other in zip(parts, whole, strict=True):
            assert_well_formed(one.points)
            assert_same_places(one.points, other.points)


def the_same_bytes_give_the_same_points(subject: Subject) -> None:
    """Decoding twice gives the same, by the plan of the points and plainly."""
    data = material.delivery(subject.sensor, subject.conversation(rounds=1))
    for backend in ("auto", "construct"):
        one, other = (subject.sensor.decode(data, backend=backend).points() for _ in range(2))
        require(len(one) == len(other), "LS415", "two runs give different numbers of points")
        for name, column in one.columns.items():
            equal = column.tobytes() == other.columns[name].tobytes()
            require(equal, "LS415", f"two runs give another {name}", f"{subject.sensor.data_frame}.points")
