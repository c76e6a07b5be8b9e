"""Entry points: what installed distributions declare, by group, found without importing any of
them.

They are read straight from the folders that Python imports from: importlib.metadata finds the same
ones, but importing it takes longer than all else that finding a sensor takes. It is asked where
something could be installed in another way than as a folder: in a zip file or an egg, or by an
import hook.
"""

from __future__ import annotations

import functools
import importlib
import os
import re
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder
from typing import Any, NamedTuple

from lidarspec.errors import SpecError

#: the group of modules with hooks, which are loaded before any sensor is handed out.
GROUP = "lidarspec"
SENSORS = "lidarspec.sensors"
VERBS = "lidarspec.verbs"
#: the group of the module that serves the page of `lidarspec view --web`.
PAGE = "lidarspec.page"
_FOLDERS = (".dist-info", ".egg-info")


class _NonFolderPathError(Exception):
    """Something that only importlib.metadata knows how to search."""


class EntryPoint(NamedTuple):
    """One entry point: its name, the module or object that it stands for, and the distribution that
    declares it.
    """

    name: str
    value: str
    distribution: str
    version: str

    @property
    def module(self) -> str:
        """The module that it stands for, or that holds its object."""
        return self.value.partition("[")[0].partition(":")[0].strip()

    def load(self) -> Any:
        """The module, or the object in it, imported.

        Raises:
            SpecError: where a file of entry points cannot be read.
            Exception: whatever the import fails with.
        """
        if not self.module:
            raise SpecError("its entry_points.txt is not UTF-8, or has an entry without a module")
        attributes = self.value.partition("[")[0].partition(":")[2]
        names = [name for name in attributes.strip().split(".") if name]
        return functools.reduce(getattr, names, importlib.import_module(self.module))


def entry_points(group: str) -> list[EntryPoint]:
    """Every entry point of a group, sorted by name and value; of several distributions of one name
    those of the first.
    """
    try:
        entries = [entry for folder in _distributions() for entry in _iter_declared(folder, group)]
    except _NonFolderPathError:
        entries = _read_by_metadata(group)
    return sorted(entries, key=lambda entry: (entry.name, entry.value))


def _distributions() -> Iterator[str]:
    """The folders that describe the installed distributions, the first one of each name."""
    if any(
        hasattr(finder, "find_distributions") and finder is not PathFinder
        for finder in sys.meta_path
    ):
        raise _NonFolderPathError
    seen = set()
    for place in sys.path:
        for name in _list_names(place or os.curdir):
            stem, kind = os.path.splitext(name)
            if kind.lower() in _FOLDERS:
                distribution = normalise_name(stem.partition("-")[0])
                if distribution not in seen:
                    seen.add(distribution)
                    yield os.path.join(place, name)


def normalise_name(distribution: str) -> str:
    """The name of a distribution, in the one way of the several that people write it in."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def _list_names(place: str) -> list[str]:
    if place.lower().rstrip("/\\").endswith(".egg"):
        raise _NonFolderPathError
    try:
        return os.listdir(place)
    except NotADirectoryError:
        raise _NonFolderPathError from None
    except OSError:
        return []


def _iter_declared(folder: str, group: str) -> Iterator[EntryPoint]:
    """The entry points of a group that one distribution declares; where not all can be read, one
    that says so among the modules.
    """
    text = _text(folder, "entry_points.txt")
    is_damaged = "\ufffd" in text and group == GROUP
    if not is_damaged and f"[{group}]" not in text:
        return
    name_and_version = _name_and_version(folder)
    if is_damaged:
        yield EntryPoint("entry_points.txt", "", *name_and_version)
    section = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1]
        elif section == group and line and not line.startswith("#"):
            name, _, value = line.partition("=")
            yield EntryPoint(name.strip(), value.strip(), *name_and_version)


def _name_and_version(folder: str) -> tuple[str, str]:
    header = (_text(folder, "METADATA") or _text(folder, "PKG-INFO")).partition("\n\n")[0]
    fields = dict(re.findall(r"^(Name|Version):[ \t]*(.*?)[ \t\r]*$", header, re.MULTILINE))
    return fields.get("Name", "?"), fields.get("Version", "?")


def _text(folder: str, name: str) -> str:
    try:
        with open(os.path.join(folder, name), encoding="utf-8", errors="replace") as file:
            return file.read()
    except OSError:
        return ""


def _read_by_metadata(group: str) -> list[EntryPoint]:
    import importlib.metadata

    entries_by_group: dict[str, list[EntryPoint]] = {}
    for distribution in importlib.metadata.distributions():
        name = str(getattr(distribution, "_path", "?"))
        version = "?"
        try:
            name = distribution.name or name
            version = distribution.version
            entries = [
                EntryPoint(e.name, e.value, name, version)
                for e in distribution.entry_points.select(group=group)
            ]
        except UnicodeDecodeError:
            if group == GROUP:
                entries = [EntryPoint("entry_points.txt", "", name, version)]
            else:
                entries = []
        except (
            FileNotFoundError
        ):  # so the finder of the library importlib_metadata says that there is no metadata
            continue
        entries_by_group.setdefault(normalise_name(name), entries)
    return [entry for entries in entries_by_group.values() for entry in entries]
