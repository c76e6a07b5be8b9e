"""Properties of a sensor's streams: no lost frame, repeatable results, equal scans in batches.

The properties find frames that are mistaken for another type, and functions of the sensor whose
result depends on more than their arguments.
"""

from __future__ import annotations

from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Found, pack_found
from lidarspec.packets.stream import PacketStream
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import iter_scans
from lidarspec.sensor_operations import Sensor
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.cloud_assertions import assert_same_places, assert_well_formed
from lidarspec.testing.findings import ViolationError, require
from lidarspec.testing.sensor_under_test import SensorUnderTest

#: Number of rounds of a conversation if a shorter conversation has no scan, because few random
#: frames of some sensors have points.
MORE_ROUNDS = 12
#: Numbers of packets in a batch, for the comparison with scans from a single batch.
BATCH_SIZES = (1, 3)


def a_clean_input_loses_nothing(subject: SensorUnderTest) -> None:
    """Check that all frames of a clean input are found, and that no byte is left over."""
    sent = subject.conversation()
    data = material.make_input(subject.sensor, sent)
    received = [(item.frame, item.data) for item in subject.sensor.split(data)]
    if received != sent:
        raise _make_loss_violation(sent, received)
    stats = subject.sensor.decode(data, subject.sensor.main_frames[0]).stats
    require(not stats.plugin_errors, "LS414", str(stats.failure("")))
    require(
        (stats.bytes_skipped, stats.pending) == (0, 0),
        "LS401",
        f"{stats.bytes_skipped} bytes were skipped, and {stats.pending} are still pending",
    )


def _make_loss_violation(
    sent: list[tuple[str, bytes]], received: list[tuple[str, bytes]]
) -> ViolationError:
    """Return the violation for the first frame that is lost or changed."""
    equal = 0
    for sent_frame, received_frame in zip(sent, received, strict=False):
        if sent_frame != received_frame:
            break
        equal += 1
    name = sent[min(equal, len(sent) - 1)][0]
    text = f"frame {equal} of {len(sent)} is not found"
    if equal < len(received) and received[equal][0] != name:
        return ViolationError(
            "LS306", f"{text}; a {received[equal][0]!r} frame is found instead", name
        )
    return ViolationError("LS401", text, name)


def the_same_bytes_give_the_same_points(subject: SensorUnderTest) -> None:
    """Check that decoding the same bytes twice gives the same points."""
    data = material.make_input(subject.sensor, subject.conversation(rounds=1))
    first = evaluate_plainly(subject.sensor.decode(data).with_points).cloud
    second = evaluate_plainly(subject.sensor.decode(data).with_points).cloud
    require(
        len(first) == len(second),
        "LS415",
        "decoding the same bytes again gives another number of points",
    )
    for name, column in first.columns.items():
        require(
            column.tobytes() == second.columns[name].tobytes(),
            "LS415",
            f"decoding the same bytes again gives other values of {name}",
            f"{subject.sensor.data_frame}.points",
        )


def scans_do_not_depend_on_batches(subject: SensorUnderTest) -> None:
    """Check that scans do not depend on how many packets arrive in one batch."""
    for rounds in (None, MORE_ROUNDS):
        data = material.make_input(subject.sensor, subject.conversation(rounds=rounds))
        frames = subject.sensor.split(data)
        whole = _scans_in_batches(subject.sensor, frames, len(frames))
        if whole:
            break
    require(whole, "LS404", "no scan was found")
    for size in BATCH_SIZES:
        parts = _scans_in_batches(subject.sensor, frames, size)
        require(
            [_summarize_scan(scan) for scan in parts] == [_summarize_scan(scan) for scan in whole],
            "LS404",
            f"batches of {size} packets give different scans than a single batch",
        )
        for part, other in zip(parts, whole, strict=True):
            assert_well_formed(part.points)
            assert_same_places(part.points, other.points)


def _scans_in_batches(sensor: Sensor, frames: list[Found], size: int) -> list[Scan]:
    """Return the scans of frames that arrive in batches of `size` frames."""
    stats = Decoder(sensor, stream=True).stats
    stream = PacketStream(sensor, sensor.data_frame, stats)
    starts = range(0, len(frames), size)
    batches = [stream.add([pack_found(frames[start : start + size])]) for start in starts]
    scans = list(iter_scans(sensor, batches))
    require(not stats.plugin_errors, "LS414", str(stats.failure("")))
    return scans


def _summarize_scan(scan: Scan) -> tuple[int, bool, bool]:
    """Return the number of points of a scan, and its `whole` and `complete`."""
    return len(scan), scan.whole, scan.complete
