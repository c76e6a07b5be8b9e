"""Run every verb in an environment with the core, one sensor and no extras.

    PYTHON_OF_THE_ENVIRONMENT -I tests/bare.py

`--help` of every verb must run. The main job of every verb must run, or end with exit code 2 and
name the extra or distribution that it needs. Uses the standard library only, because the
environment has no pytest.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

SENSOR = "ldrobot-stl27l"
FRAME = (
    "542c6808ab7ee000e4dc00e2d900e5d500e3d300e4d000e9cd00e4ca00e2c700e9c500e5c200e5c000e5be823a1a50"
)
FIELDS = (
    "speed=2152 start_angle=32427 points[*].distance=1m points[*].intensity=7 end_angle=33470"
    " timestamp=6714"
)
TIMEOUT_S = 120
#: the expectation for a job that needs no extra.
RUNS = ""
#: verb, arguments, and `RUNS` or the extra or distribution that the job must name. Jobs run in this
#: order in one folder.
JOBS = (
    ("sensors", "", RUNS),
    ("show", SENSOR, RUNS),
    ("ports", "", RUNS),
    ("plugins", "", RUNS),
    ("help", "show", RUNS),
    ("demo", f"-s {SENSOR}", RUNS),
    ("sim", f"{SENSOR} --to room.lsr -t 2s", RUNS),
    ("sim", f"{SENSOR} --to room.pcap -t 2s", RUNS),
    ("sim", f"{SENSOR} --to room.bin -t 2s", RUNS),
    ("detect", "room.bin", RUNS),
    ("doctor", f"sim:{SENSOR}", RUNS),
    ("trust", "own", RUNS),
    ("read", "room.lsr -n 1", RUNS),
    ("view", f"sim:{SENSOR} --once", RUNS),
    ("view", f"sim:{SENSOR} --web -t 1s", "lidarspec-web"),
    ("view", f"sim:{SENSOR} --rerun -o room.rrd -t 1s", "rerun"),
    ("record", f"sim:{SENSOR} -o live.lsr -t 1s", RUNS),
    ("replay", "room.lsr --to again.pcap", RUNS),
    ("send", "sim:ldrobot-ld14p stop", RUNS),
    ("stats", "room.lsr", RUNS),
    ("clock", "room.lsr", RUNS),
    ("info", "room.pcap", RUNS),
    ("convert", "room.lsr room.csv", RUNS),
    ("convert", "room.lsr room.npz", RUNS),
    ("convert", "room.lsr room.pcd", RUNS),
    ("convert", "room.lsr room.ply", RUNS),
    ("convert", "room.lsr room.parquet", "arrow"),
    ("convert", "room.lsr room.las", "las"),
    ("convert", "room.lsr room.e57", "e57"),
    ("convert", "room.lsr room.mcap", "ros"),
    ("convert", "room.lsr room.zarr", "zarr"),
    ("convert", "room.lsr room.rrd", "rerun"),
    ("plot", "room.lsr -o room.svg", RUNS),
    ("plot", "room.lsr -o room.png", "plot"),
    ("parse", f"-s {SENSOR} {FRAME}", RUNS),
    ("explain", f"-s {SENSOR} {FRAME}", RUNS),
    ("build", f"{SENSOR} data {FIELDS}", RUNS),
    ("crc", "room.bin", RUNS),
    ("new", "acme-x1 --into .", RUNS),
    ("export", f"c {SENSOR}", RUNS),
    ("export", f"wireshark {SENSOR}", RUNS),
    ("check", SENSOR, "testing"),
)


def main() -> int:
    """Run everything, print the failures, and return the exit code."""
    from lidarspec.cli.root import VERBS

    failures: list[str] = []
    for verb in sorted(set(VERBS) - {verb for verb, _, _ in JOBS}):
        failures.append(f"{verb}: tests/bare.py has no job for it")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "own").mkdir(mode=0o700)  # the folder that `trust` allows
        for verb in VERBS:
            failures += check(folder, [verb, "--help"], RUNS)
        for verb, arguments, extra in JOBS:
            failures += check(folder, [verb, *arguments.split()], extra)
    print("\n\n".join(failures) or f"{len(VERBS)} verbs: --help and {len(JOBS)} jobs as expected")
    return 1 if failures else 0


def check(folder: Path, words: list[str], extra: str) -> list[str]:
    """Run a command and return a description of its failure, or nothing."""
    command = [sys.executable, "-I", "-m", "lidarspec", *words]
    environment = {
        **os.environ,
        "XDG_CONFIG_HOME": str(folder / "settings"),
        "LIDARSPEC_CACHE": str(folder / "cache"),
    }
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return [f"lidarspec {' '.join(words)}: still running after {TIMEOUT_S} s"]
    output = done.stdout + done.stderr
    if extra:
        # Several extras may provide the library: `lidarspec[foxglove,ros]`.
        named = re.search(rf"pip install '(lidarspec\[[^]]*\b)?{extra}\b", output)
        is_expected = done.returncode == 2 and named is not None
    else:
        is_expected = done.returncode == 0
    if is_expected and "a bug in lidarspec" not in output:
        return []
    wanted = f"exit code 2 and {extra}" if extra else "exit code 0"
    return [
        f"lidarspec {' '.join(words)}: expected {wanted}, got exit code"
        f" {done.returncode}\n{output[-1500:]}"
    ]


if __name__ == "__main__":
    sys.exit(main())
