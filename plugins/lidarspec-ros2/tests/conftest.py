"""Fixtures that start a node in a separate process and a client in this one.

They communicate over the loopback interface, in a ROS domain of their own.
"""

from __future__ import annotations

import contextlib
import os
import random
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

os.environ |= {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "ROS_DOMAIN_ID": str(random.randrange(50, 100)),
}

import rclpy
from client import PATIENCE, Client

Run = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="session", autouse=True)
def _ros() -> Iterator[None]:
    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.fixture
def client() -> Iterator[Client]:
    made = Client()
    yield made
    made.close()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Starts a node, by the words of the verb, and of ROS; which is ended at the end."""
    begun: list[subprocess.Popen[str]] = []

    def started(
        *words: str, ros: Sequence[str] = (), executable: str = "lidarspec"
    ) -> subprocess.Popen[str]:
        verb = ["ros2"] if executable == "lidarspec" else []
        command = [
            str(Path(sys.executable).with_name(executable)),
            *verb,
            *words,
            *(["--ros-args", *ros] if ros else []),
        ]
        process = subprocess.Popen(
            command, cwd=tmp_path, text=True, stderr=subprocess.PIPE, stdout=subprocess.PIPE
        )
        begun.append(process)
        return process

    yield started
    for process in begun:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=PATIENCE)
        process.kill()
