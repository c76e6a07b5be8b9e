"""Tests that a server's temporary folder is removed at exit or by the next server."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidarspec_web.temporary_folder import PREFIX, TemporaryFolder, remove_stale_folders

pytestmark = pytest.mark.skipif(os.name != "posix", reason="folders are locked on POSIX only")

#: Makes a folder, and is killed.
KILLED = """import os, signal
from lidarspec_web.temporary_folder import TemporaryFolder
(TemporaryFolder().path / "scan.csv").write_text("x")
os.kill(os.getpid(), signal.SIGKILL)"""


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def test_a_folder_is_made_when_it_is_needed_and_removed(tmp_path: Path) -> None:
    folder = TemporaryFolder()
    assert not list(tmp_path.iterdir())
    assert folder.path == folder.path
    assert folder.path.stat().st_mode & 0o777 == 0o700
    (folder.path / "scan.csv").write_text("x")
    folder.remove()
    folder.remove()
    assert not list(tmp_path.iterdir())


def test_the_folder_of_a_killed_server_is_removed_and_that_of_another_stays(tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", KILLED], env=environment, check=False)
    assert len(list(tmp_path.glob(f"{PREFIX}*/scan.csv"))) == 1
    running = TemporaryFolder()
    (running.path / "scan.csv").write_text("x")
    remove_stale_folders()
    assert list(tmp_path.iterdir()) == [running.path]
    assert (running.path / "scan.csv").exists()
    running.remove()


def test_links_and_files_with_such_a_name_stay(tmp_path: Path) -> None:
    """Another user may have created them, so that something else would be removed."""
    target = tmp_path / "target"
    target.mkdir()
    (target / "kept").write_text("x")
    (tmp_path / f"{PREFIX}link").symlink_to(target)
    (tmp_path / f"{PREFIX}file").write_text("x")
    remove_stale_folders()
    assert (target / "kept").exists()
    assert len(list(tmp_path.iterdir())) == 3
