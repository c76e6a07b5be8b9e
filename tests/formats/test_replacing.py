"""Tests that an output replaces only files of its own format."""

from __future__ import annotations

from pathlib import Path

import pytest

from lidarspec import UsageError
from lidarspec.formats.common import replace_file

OWN_FILES = {
    "out.zarr": ["zarr.json", "x/zarr.json", "x/c/0", "x/c/1/2"],
    "old.zarr": [".zgroup", ".zattrs", "x/.zarray", "x/0.1"],
    "out.rosbag2": ["metadata.yaml", "out.mcap"],
    "sqlite.rosbag2": ["metadata.yaml", "out_0.db3", "out_0.db3-wal"],
}


def fill(folder: Path, names: list[str]) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"old")


@pytest.mark.parametrize("output", OWN_FILES)
def test_folder_of_the_same_format_is_replaced(tmp_path: Path, output: str) -> None:
    folder = tmp_path / output
    fill(folder, OWN_FILES[output])
    with replace_file(folder) as part:
        part.mkdir()
        (part / "new").write_bytes(b"new")
    assert [path.name for path in folder.iterdir()] == ["new"]


@pytest.mark.parametrize("output", OWN_FILES)
@pytest.mark.parametrize("stranger", ["thesis.tex", "x/notes.txt", "raw/drive.pcap"])
def test_folder_with_another_file_is_not_replaced(
    tmp_path: Path, output: str, stranger: str
) -> None:
    folder = tmp_path / output
    fill(folder, [*OWN_FILES[output], stranger])
    with pytest.raises(UsageError, match=stranger), replace_file(folder) as part:
        part.mkdir()
    assert sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    ) == sorted([*OWN_FILES[output], stranger])
    assert [path.name for path in tmp_path.iterdir()] == [output]


def test_file_added_while_writing_is_not_deleted(tmp_path: Path) -> None:
    folder = tmp_path / "out.zarr"
    fill(folder, OWN_FILES["out.zarr"])

    def write() -> None:
        with replace_file(folder) as part:
            part.mkdir()
            fill(folder, ["late.txt"])

    with pytest.raises(UsageError, match=r"late\.txt"):
        write()
    assert (folder / "late.txt").exists()
