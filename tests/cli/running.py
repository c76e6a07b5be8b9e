"""Run the command line in a separate process, or in this one."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from lidarspec.cli.root import main

LD06, COIN_D4 = (
    "ldrobot/ld06_3_consecutive_frames.bin",
    "cspc/coin_d4_ludovatech_issue2_partial.bin",
)
#: one frame of the STL-27L's format, so that tests need no capture: the example of the vendor's
#: manual.
EXAMPLE = bytes.fromhex(
    "542c6808ab7ee000e4dc00e2d900e5d500e3d300e4d000e9cd00e4ca00e2c700e9c500e5c200e5c000e5be823a1a50"
)


#: what keeps both streams apart, which click 8.1 does where it is told to and later ones always.
APART: dict[str, Any] = (
    {"mix_stderr": False} if "mix_stderr" in inspect.signature(CliRunner).parameters else {}
)


def process(
    *words: object, given: bytes = b"", cwd: Path | None = None
) -> subprocess.CompletedProcess[bytes]:
    """Run ``python -m lidarspec`` with these words; fail if it shows a traceback."""
    command = [sys.executable, "-m", "lidarspec", *map(str, words)]
    done = subprocess.run(
        command, input=given, capture_output=True, cwd=cwd, check=False, timeout=120
    )
    assert b"Traceback" not in done.stderr, done.stderr.decode()
    return done


def ran(*words: object, code: int = 0, given: bytes | None = None) -> Result:
    """Run the command in this process; it must exit with `code`."""
    result = CliRunner(**APART).invoke(main, [str(word) for word in words], input=given)
    assert result.exit_code == code, result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr
    return result


def ran_with_any_code(*words: object) -> int:
    """Run a command in this process, and return its exit code."""
    result = CliRunner(**APART).invoke(main, [str(word) for word in words])
    assert "Traceback" not in result.stdout + result.stderr
    return result.exit_code


def run_json(*words: object) -> Any:
    """Return the parsed output of ``--json``."""
    return json.loads(ran(*words, "--json").stdout)
