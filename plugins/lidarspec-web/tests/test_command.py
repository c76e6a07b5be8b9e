"""Tests of `view --web` in a separate process: its link, exit and error messages."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.cli.running import process, ran

from .pages import DEADLINE, FLAT, Page, write_recording

#: The command line with a page that replaces the built one.
MAIN = """import pathlib, sys
from lidarspec.cli import main
from lidarspec_web import server
server.PAGE = pathlib.Path(sys.argv.pop(1))
sys.exit(main())"""


@contextlib.contextmanager
def run_verb(
    folder: Path, *words: object, **variables: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the verb with environment variables, and yield the process and the link."""
    (folder / "page").mkdir(exist_ok=True)
    (folder / "page" / "index.html").write_text("<!doctype html><title>page</title>")
    command = [sys.executable, "-c", MAIN, str(folder / "page"), "view", *map(str, words), "--web"]
    names = {**os.environ, "TMPDIR": str(folder), "PYTHONUNBUFFERED": "1", **variables}
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, env=names
    )
    try:
        assert running.stdout is not None
        yield running, running.stdout.readline().strip()
    finally:
        running.kill()
        running.communicate()


def wait_until_end(
    running: subprocess.Popen[str], by: signal.Signals | None = None
) -> tuple[int, str, list[str]]:
    """Return the exit code, further standard output, and the lines on standard error."""
    if by is not None:
        running.send_signal(by)
    out, err = running.communicate(timeout=DEADLINE)
    assert "Traceback" not in err, err
    return running.returncode, out, err.splitlines()


@pytest.mark.parametrize(
    "by", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_it_prints_its_link_and_ends_on_a_signal(tmp_path: Path, by: signal.Signals) -> None:
    with run_verb(tmp_path, f"sim:{FLAT}") as (running, link), Page(link) as page:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{32}", link)
        page.scan()
        code, out, lines = wait_until_end(running, by)
    assert (code, out) == (130, "")
    assert lines == [
        "page 1 was opened by 127.0.0.1; open pages: 1",
        "page 1 was closed; open pages: 0",
        "interrupted",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["page"]
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", urlsplit(link).port), 1)


@pytest.mark.slow
def test_it_ends_after_its_time(tmp_path: Path) -> None:
    with run_verb(tmp_path, f"sim:{FLAT}", "-t", "1s") as (running, _):
        assert wait_until_end(running) == (0, "", [])


@pytest.mark.slow
def test_a_file_that_has_ended_is_still_shown(tmp_path: Path) -> None:
    with (
        run_verb(tmp_path, write_recording(tmp_path, seconds=1)) as (running, link),
        Page(link) as page,
    ):
        page.until("ended")
        assert page.scan()[1]["x"].size
        assert running.poll() is None


@pytest.mark.slow
def test_recordings_are_listed_at_the_end(tmp_path: Path) -> None:
    with run_verb(tmp_path, f"sim:{FLAT}") as (running, link), Page(link) as page:
        page.say("record")
        name = page.state(lambda state: state["recording"] and state["recording"]["bytes"])[
            "recording"
        ]["name"]
        _, _, lines = wait_until_end(running, signal.SIGINT)
    assert any(
        line.startswith("recorded ") and line.endswith(f"next: lidarspec view {name}")
        for line in lines
    ), lines
    assert "bytes" in ran("info", tmp_path / name).stdout


@pytest.mark.slow
def test_a_port_that_is_taken_is_one_clear_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with run_verb(tmp_path, f"sim:{FLAT}", "--address", f"127.0.0.1:{port}") as (running, link):
            code, out, lines = wait_until_end(running)
    assert (code, link, out) == (3, "", "")
    assert lines[0] == f"cannot serve the page at 127.0.0.1:{port}: Address already in use"


@pytest.mark.slow
def test_another_address_is_reached_from_here(tmp_path: Path) -> None:
    with run_verb(tmp_path, f"sim:{FLAT}", "--address", "0.0.0.0") as (_, link):
        local = f"http://127.0.0.1:{link.rpartition(':')[2]}"
        with Page(local) as page:
            assert page.scan()[1]["x"].size


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="the browser is a script of a shell")
def test_the_browser_is_led_to_the_link(tmp_path: Path) -> None:
    """The command that starts it has no token; the file that it opens has."""
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/words\n')
    browser.chmod(0o700)
    with (
        run_verb(tmp_path, f"sim:{FLAT}", "--open", BROWSER=f"{browser} %s") as (_, link),
        Page(link) as page,
    ):
        page.scan()
        words = (tmp_path / "words").read_text().strip()
        assert link.partition("?token=")[2] not in words
        assert f"url={link}" in Path(words.removeprefix("file://")).read_text()


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux", reason="the limit of another process is set on Linux alone"
)
def test_more_idle_connections_than_files_can_be_open(tmp_path: Path) -> None:
    """1,100 connections of another user, without the token, do not block the page.

    No traceback is printed.
    """
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 2048), hard))
    try:
        with run_verb(tmp_path, f"sim:{FLAT}") as (running, link), contextlib.ExitStack() as stack:
            resource.prlimit(running.pid, resource.RLIMIT_NOFILE, (256, hard))
            for _ in range(1100):
                stack.enter_context(
                    socket.create_connection(("127.0.0.1", urlsplit(link).port), DEADLINE)
                )
            with Page(link) as page:
                assert page.scan()[1]["x"].size
            _, _, lines = wait_until_end(running, signal.SIGINT)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert sum("connections; for each new connection" in line for line in lines) == 1
    assert len(lines) < 8


@pytest.mark.slow
def test_a_source_that_fails_ends_it_with_its_code(tmp_path: Path) -> None:
    with run_verb(tmp_path, write_recording(tmp_path), "--slice", "100:200") as (running, _):
        code, _, lines = wait_until_end(running)
    assert code == 2
    assert "the selection is outside" in lines[0]


@pytest.mark.slow
def test_reading_continues_when_a_port_returns(tmp_path: Path) -> None:
    """The simulator on a pty is stopped and started again, behind the same link."""
    port = tmp_path / "port"
    command = [sys.executable, "-m", "lidarspec", "sim", FLAT, "--to", "pty", "--link", str(port)]

    def begin() -> subprocess.Popen[bytes]:
        sim = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end = time.monotonic() + DEADLINE
        while not port.exists() and time.monotonic() < end:
            time.sleep(0.05)
        return sim

    sim = begin()
    try:
        with run_verb(tmp_path, port, "-s", FLAT) as (running, link), Page(link) as page:
            page.scan()
            sim.terminate()
            sim.wait(DEADLINE)
            gone = page.state(lambda state: state["state"] == "disconnected" and state["warnings"])
            assert "the device is disconnected" in gone["warnings"][0]
            sim = begin()
            back = page.state(
                lambda state: state["state"] == "streaming" and state["figures"]["disconnects"]
            )
            assert back["figures"]["disconnects"] == 1
            page.scan()
            assert page.scan()[1]["x"].size
            assert wait_until_end(running, signal.SIGINT)[0] == 130
    finally:
        sim.terminate()
        sim.wait(DEADLINE)


@pytest.mark.slow
def test_the_terminal_window_is_as_it_was() -> None:
    assert b"colours" in process("view", f"sim:{FLAT}", "--once").stdout
