"""Which plugins are installed: their entry points, read straight from the folders that Python imports from.

importlib.metadata finds the same ones, but importing it takes longer than all else that finding a sensor takes. It is
asked where something could be installed in another way than as a folder: in a zip file or an egg, or by an import hook.
"""

from __future__ import annotations

import functools
import importlib
import os
import re
import sys
from collections.abc import Iterable, Iterator
from importlib.machinery import PathFinder
from typing import Any, NamedTuple

_FOLDERS = (".dist-info", ".egg-info")


class _NotOnlyFolders(Exception):
    """Something that only importlib.metadata knows how to search."""


class EntryPoint(NamedTuple):
    """One entry point: its name, the module or object that it stands for, and the distribution that declares it."""

    name: str
    value: str
    distribution: str
    version: str

    def load(self) -> Any:
        """The module, or the object in it, imported."""
        module, _, attributes = self.value.partition("[")[0].partition(":")
        names = [name for name in attributes.strip().split(".") if name]
        return functools.reduce(getattr, names, importlib.import_module(module.strip()))


class Vendor(NamedTuple):
    """A plugin with a promise in the names of its entry points: all its ids and aliases begin so, and sensors are all it adds.

    So it is loaded when such an id is asked for, and not before.
    """

    entry: EntryPoint
    prefixes: tuple[str, ...]

    def shares(self, names: Iterable[str]) -> bool:
        """Whether one of the names, or an id that begins with one of them, could be its own."""
        return any(name.startswith(prefix) or prefix.startswith(name) for name in names for prefix in self.prefixes)


def vendors(entries: Iterable[EntryPoint]) -> list[Vendor]:
    """The plugins whose entry points end in a hyphen, one for each: a plugin may have several such names."""
    found: dict[tuple[str, str], list[EntryPoint]] = {}
    for entry in entries:
        if entry.name.endswith("-"):
            found.setdefault((entry.distribution, entry.value), []).append(entry)
    return [Vendor(same[0], tuple(entry.name for entry in same)) for same in found.values()]


def entry_points(group: str) -> list[EntryPoint]:
    """Every entry point of a group, sorted by name and value; of several distributions of one name those of the first."""
    try:
        found = [entry for folder in _distributions() for entry in _declared(folder, group)]
    except _NotOnlyFolders:
        found = _by_metadata(group)
    return sorted(found, key=lambda entry: (entry.name, entry.value))


def _distributions() -> Iterator[str]:
    """The folders that describe the installed distributions, the first one of each name."""
    if any(hasattr(finder, "find_distributions") and finder is not PathFinder for finder in sys.meta_path):
        raise _NotOnlyFolders
    seen = set()
    for place in sys.path:
        for name in _listed(place or os.curdir):
            stem, kind = os.path.splitext(name)
            if kind.lower() in _FOLDERS:
                normal = re.sub(r"[-_.]+", "_", stem.partition("-")[0]).lower()
                if normal not in seen:
                    seen.add(normal)
                    yield os.path.join(place, name)


def _listed(place: str) -> list[str]:
    if place.lower().rstrip("/\\").endswith(".egg"):
        raise _NotOnlyFolders
    try:
        return os.listdir(place)
    except NotADirectoryError:
        raise _NotOnlyFolders from None
    except OSError:
        return []


def _declared(folder: str, group: str) -> Iterator[EntryPoint]:
    """The entry points of a group that one distribution declares."""
    section = ""
    for line in map(str.strip, _text(folder, "entry_points.txt").splitlines()):
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1]
        elif section == group and line and not line.startswith("#"):
            name, _, value = line.partition("=")
            yield EntryPoint(name.strip(), value.strip(), *_name_and_version(folder))


def _name_and_version(folder: str) -> tuple[str, str]:
    header = (_text(folder, "METADATA") or _text(folder, "PKG-INFO")).partition("\n\n")[0]
    fields = dict(re.findall(r"^(Name|Version):[ \t]*(.*?)[ \t\r]*$", header, re.MULTILINE))
    return fields.get("Name", "?"), fields.get("Version", "?")


def _text(folder: str, name: str) -> str:
    try:
        with open(os.path.join(folder, name), encoding="utf-8") as file:
            return file.read()
    except OSError:
        return ""


def _by_metadata(group: str) -> list[EntryPoint]:
    import importlib.metadata

    found = importlib.metadata.entry_points(group=group)
    return [EntryPoint(e.name, e.value, e.dist.name if e.dist else "?", e.dist.version if e.dist else "?") for e in found]
