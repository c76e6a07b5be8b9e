"""Tests that cached compiled code runs only from a folder that others cannot write."""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lidarspec.points.numba_kernels import cache
from lidarspec.points.numba_kernels.kernels import (
    _make_module_name,
    compile_source,
    is_code_available,
)
from lidarspec.points.numba_kernels.source import HEAD
from tests.points.backends import COMPILED

pytestmark = [
    COMPILED,
    pytest.mark.skipif(
        sys.platform == "win32", reason="folders of a user are the user's alone there"
    ),
]

SOURCE = HEAD + "@compile_kernel(STORED, (INTEGER,))\ndef kernel(number):\n    return number + 1\n"
ROOT = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away"
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv(cache.CACHE, str(tmp_path / "kernels"))
    cache._warn.cache_clear()
    yield tmp_path / "kernels"
    _forget()


def _forget() -> None:
    compile_source.cache_clear()
    sys.modules.pop(_make_module_name(SOURCE), None)


def _is_read() -> bool:
    """Return whether a new process would read the kernel from the folder.

    Fail unless the kernel is correct.
    """
    _forget()
    kernel = compile_source(SOURCE)
    assert kernel(41) == 42
    return bool(kernel.stats.cache_hits)


def _file(folder: Path) -> Path:
    return next(path for path in folder.iterdir() if path.name != "key")


def test_a_kernel_is_read_in_the_next_run(folder: Path) -> None:
    assert not is_code_available(SOURCE)
    assert [_is_read(), _is_read()] == [False, True]
    _forget()
    assert is_code_available(SOURCE)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o600}


@pytest.mark.slow
def test_names_are_hashed_with_the_key(folder: Path) -> None:
    _is_read()
    name = _file(folder).name
    assert _make_module_name(SOURCE).removeprefix("lidarspec_kernel_") not in name
    shutil.rmtree(folder)
    _is_read()
    assert _file(folder).name.partition("-")[0] != name.partition("-")[0]


class Bomb:
    """A pickle that runs something."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return pytest.fail, ("what lay in the folder was run",)


def _bomb(path: Path) -> None:
    data = pickle.dumps(Bomb())
    path.write_bytes(hashlib.sha256(data).digest() + data)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "cut short": lambda path: os.truncate(path, path.stat().st_size - 1),
    "empty": lambda path: os.truncate(path, 0),
    "not the user's bytes": _bomb,
    "writable for others": lambda path: path.chmod(0o666),
    "a link": lambda path: path.rename(path.parent / "moved") and path.symlink_to("moved"),
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
}


#: the damage that would run code of others is tried in the quick tier.
QUICK = ("not the user's bytes", "kernel")
CASES = [
    pytest.param(
        what, name, marks=() if (what, name) == QUICK else pytest.mark.slow, id=f"{name} {what}"
    )
    for what in DAMAGE
    for name in ("kernel", "key")
]


@pytest.mark.parametrize(("what", "name"), CASES)
def test_a_damaged_file_is_replaced(folder: Path, what: str, name: str) -> None:
    _is_read()
    DAMAGE[what](folder / "key" if name == "key" else _file(folder))
    assert [_is_read(), _is_read()] == [False, True]


@pytest.mark.slow
@ROOT
def test_a_file_of_another_user_is_not_read(folder: Path) -> None:
    _is_read()
    os.chown(_file(folder), 1234, 1234)
    assert [_is_read(), _is_read()] == [False, True]


@pytest.mark.slow
def test_a_shared_cache_folder_is_not_used_with_one_warning(folder: Path) -> None:
    _is_read()
    folder.chmod(0o777)
    with pytest.warns(
        UserWarning, match="kernels is accessible to other users: run chmod 700"
    ) as said:
        assert [_is_read(), _is_read()] == [False, False]
    assert len(said) == 1
    _forget()
    assert not is_code_available(SOURCE)


@pytest.mark.slow
@ROOT
def test_a_folder_of_another_user_is_not_used(folder: Path) -> None:
    _is_read()
    os.chown(folder, 1234, 1234)
    with pytest.warns(UserWarning, match="kernels belongs to user 1234"):
        assert not _is_read()


FULL = """
import resource, signal
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
from lidarspec.points.numba_kernels.kernels import compile_source
print(compile_source({source!r})(41))
"""


@pytest.mark.slow
def test_a_full_disk_stores_no_kernel(folder: Path) -> None:
    command = [
        sys.executable,
        "-B",
        "-c",
        FULL.format(source=SOURCE),
    ]  # or Python itself keeps half a module
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "42\n", done.stderr
    assert "compiled code cannot be stored for later runs: [Errno 27] File too large" in done.stderr
    assert [path.name for path in folder.iterdir()] == ["key"]
