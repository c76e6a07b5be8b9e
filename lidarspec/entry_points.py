"""Find entry points by group without importing the distributions that declare them.

The folders on `sys.path` are read directly, because importing importlib.metadata is slow.
importlib.metadata is used only if a distribution may be installed in a zip file or an egg, or
through an import hook.
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

#: The group of modules with hooks, which are loaded before any sensor is returned.
GROUP = "lidarspec"
SENSORS = "lidarspec.sensors"
VERBS = "lidarspec.verbs"
#: The group of the module that serves the page of `lidarspec view --web`.
PAGE = "lidarspec.page"
_FOLDERS = (".dist-info", ".egg-info")


class _SearchNeededError(Exception):
    """Only `importlib.metadata` can find all distributions.

    Raised if `sys.path` contains an egg or a file (such as a zip file), or if `sys.meta_path`
    contains a further finder of distributions.
    """


class EntryPoint(NamedTuple):
    """One entry point and the distribution that declares it.

    Attributes:
        value: "module" or "module:object".
        distribution, version: name and version of the distribution; "?" if unknown.
    """

    name: str
    value: str
    distribution: str
    version: str

    @property
    def module(self) -> str:
        """The module, or the module that contains the object."""
        return self.value.partition("[")[0].partition(":")[0].strip()

    def load(self) -> Any:
        """Import and return the module, or the object in it.

        Raises:
            SpecError: if a file of entry points cannot be read.
            Exception: any exception of the import.
        """
        if not self.module:
            raise SpecError("entry_points.txt is not UTF-8, or one of its entries names no module")
        attributes = self.value.partition("[")[0].partition(":")[2]
        names = [name for name in attributes.strip().split(".") if name]
        return functools.reduce(getattr, names, importlib.import_module(self.module))


def entry_points(group: str) -> list[EntryPoint]:
    """Return every entry point of a group, sorted by name and value."""
    try:
        entries = [
            entry for folder in _iter_distributions() for entry in _iter_declared(folder, group)
        ]
    except _SearchNeededError:
        entries = _read_by_metadata(group)
    return sorted(entries, key=lambda entry: (entry.name, entry.value))


def _iter_distributions() -> Iterator[str]:
    """Yield the metadata folder of each installed distribution."""
    if any(
        hasattr(finder, "find_distributions") and finder is not PathFinder
        for finder in sys.meta_path
    ):
        raise _SearchNeededError
    seen = set()
    for path in sys.path:
        for name in _list_names(path or os.curdir):
            stem, kind = os.path.splitext(name)
            if kind.lower() in _FOLDERS:
                distribution = normalise_name(stem.partition("-")[0])
                if distribution not in seen:
                    seen.add(distribution)
                    yield os.path.join(path, name)


def normalise_name(distribution: str) -> str:
    """Return the normalised name of a distribution: lower case, with hyphens."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def _list_names(path: str) -> list[str]:
    if path.lower().rstrip("/\\").endswith(".egg"):
        raise _SearchNeededError
    try:
        return os.listdir(path)
    except NotADirectoryError:
        raise _SearchNeededError from None
    except OSError:
        return []


def _iter_declared(folder: str, group: str) -> Iterator[EntryPoint]:
    """Yield the entry points of a group that one distribution declares."""
    text = _read_text(folder, "entry_points.txt")
    is_damaged = "\ufffd" in text and group == GROUP
    if not is_damaged and f"[{group}]" not in text:
        return
    name_and_version = _read_name_and_version(folder)
    if is_damaged:
        yield EntryPoint("entry_points.txt", "", *name_and_version)
    section = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1]
        elif section == group and line and not line.startswith("#"):
            name, _, value = line.partition("=")
            yield EntryPoint(name.strip(), value.strip(), *name_and_version)


def _read_name_and_version(folder: str) -> tuple[str, str]:
    header = (_read_text(folder, "METADATA") or _read_text(folder, "PKG-INFO")).partition("\n\n")[0]
    fields = dict(re.findall(r"^(Name|Version):[ \t]*(.*?)[ \t\r]*$", header, re.MULTILINE))
    return fields.get("Name", "?"), fields.get("Version", "?")


def _read_text(folder: str, name: str) -> str:
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
        # importlib_metadata's finder raises it if there is no metadata
        except FileNotFoundError:
            continue
        entries_by_group.setdefault(normalise_name(name), entries)
    return [entry for entries in entries_by_group.values() for entry in entries]
