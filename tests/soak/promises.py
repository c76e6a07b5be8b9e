"""The promises with their tests, including slow ones, and additional measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.soak import figures
from tests.soak.figures import Figure


@dataclass(frozen=True)
class Promise:
    """A promise.

    Attributes:
        name: "P1" and so on.
        words: the promise.
        tests: test files, or tests in them, of this promise.
        result: the result of these tests, printed if all of them pass.
        measured: returns a figure, given the share of the full effort, from 0 to 1.
    """

    name: str
    words: str
    tests: tuple[str, ...] = ()
    result: str = ""
    measured: Callable[[float], Figure] | None = None


RULE, LIMITS, PROMISES = (
    "tests/engine/test_framing_rule.py",
    "tests/engine/test_limits.py",
    "tests/engine/test_promises.py",
)
RECORDINGS, DEVICE = "tests/recording/test_recordings.py", "tests/device/test_device.py"
HOSTILE = "tests/captures/test_pcap_hostile.py"
CONTINUITY = "tests/packets/test_continuity.py"
REORDER = "tests/packets/test_reorder.py"
SCANS = "tests/scans/test_scans.py"

EVERY = (
    Promise("P1", "any split of a stream gives the same result", (RULE,), "", figures.splits),
    Promise(
        "P2",
        "every frame that a damaged stream still contains is found",
        (RULE,),
        "",
        figures.measure_recovery,
    ),
    Promise(
        "P3",
        "only documented exceptions",
        ("tests/engine/test_hostile_input.py", "tests/fuzz"),
        "",
        figures.measure_errors,
    ),
    Promise(
        "P4",
        "memory is bounded: under 1 MiB for 50 MB of garbage",
        (LIMITS,),
        "",
        figures.measure_memory,
    ),
    Promise(
        "P5",
        "time is linear: at most 2.5 times for twice the input",
        ("tests/engine/test_linear_time.py",),
        "",
        figures.linear,
    ),
    Promise(
        "P6",
        "a frame is returned before as many further bytes have arrived as the longest frame has",
        (LIMITS,),
        "",
        figures.delay,
    ),
    Promise(
        "P7",
        "round trips are exact",
        ("tests/testing/test_conformance.py",),
        "",
        figures.round_trips,
    ),
    Promise(
        "P8",
        "a recording survives kill -9 at any byte",
        (f"{RECORDINGS}",),
        "killed 100 times, cut at every byte: no acknowledged record lost",
    ),
    Promise(
        "P9",
        "replay is bit-exact",
        (f"{PROMISES}::TestReplay", "tests/recording/test_replay.py"),
        "the same SHA-256 at every speed",
    ),
    Promise(
        "P10",
        "devices survive unplugging",
        (f"{DEVICE}",),
        "unplugged 100 times: no frame joins bytes from before and after unplugging; no descriptor"
        " or thread is left",
    ),
    Promise(
        "P11",
        "UDP at full rate without loss",
        ("tests/device/test_rates.py",),
        "378,000 datagrams in 60 s, with bursts and stalls of 250 ms: 0 lost",
    ),
    Promise(
        "P12",
        "chunks dropped for a slow consumer are counted",
        (f"{PROMISES}::TestQueue",),
        "1,000,000 chunks: produced = consumed + dropped",
    ),
    Promise(
        "P13",
        "a broken plugin is isolated",
        ("tests/plugins/test_plugins.py",),
        "for each kind of fault, an error names the plugin",
    ),
    Promise(
        "P14",
        "hostile captures use little memory and raise only SourceError",
        (HOSTILE, "tests/captures/test_memory.py"),
        "5,000 mutations of each format: 0 findings; less than 200 MB of memory for a capture of"
        " 1 GB",
    ),
    Promise(
        "P15",
        "a full disk gives one error and an intact file",
        (f"{PROMISES}::TestFiles", RECORDINGS),
        "every record before the error can be read",
    ),
    Promise(
        "P16",
        "clocks are unwrapped",
        (f"{PROMISES}::TestClocks", "tests/packets/test_clocks.py"),
        "clocks that wrap at 30 s, an hour or 16 bits, 100 wraps each, with late packets: all times"
        " are exact",
    ),
    Promise(
        "P17",
        "late, duplicate and reordered packets give the same scan",
        (CONTINUITY, REORDER, SCANS),
        "",
        figures.in_any_order,
    ),
    Promise(
        "P18",
        "decoders are independent",
        ("tests/framing/test_framing.py",),
        "decoders that run in turns or in 8 threads give the same results as one alone",
    ),
    Promise(
        "P19",
        "a scan always ends; if the rotor is blocked, the scan is incomplete",
        (SCANS,),
        "",
        figures.measure_blocked_rotors,
    ),
    Promise(
        "P20",
        "decoding is 10 times as fast as the line, even if the stream is hostile, and needs less"
        " than 64 bytes of memory for each byte of input",
        (RULE,),
        "",
        figures.slowest,
    ),
    Promise(
        "P21",
        "other senders do not disturb",
        (DEVICE, "tests/device/test_source_recording.py"),
        "",
        figures.strangers,
    ),
    Promise(
        "P22",
        "untrusted files run no code",
        (
            "tests/device/test_named_devices.py",
            RECORDINGS,
            "tests/points/test_kernel_cache.py",
            "tests/plugins/test_installed.py",
        ),
        "",
        figures.nothing_runs,
    ),
    Promise(
        "P23",
        "complete scans miss nothing, and losses are counted exactly",
        (CONTINUITY, SCANS),
        "",
        figures.complete,
    ),
    Promise(
        "P24",
        "lost data and missing calibrations are reported",
        ("tests/cli/test_captures.py", "tests/cli/test_terminal.py"),
        "",
        figures.not_in_silence,
    ),
    Promise(
        "",
        "exports, engines and points agree on random input",
        (
            "tests/exports",
            "tests/engine/test_random_specs.py",
            "tests/engine/test_agreement.py",
            "tests/framing/test_regular_rows.py",
            "tests/points",
            "tests/scans/test_scan_columns.py",
            "tests/cli/test_new.py",
        ),
        "thousands of specs, 60 points functions",
    ),
)
