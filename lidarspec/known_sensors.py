"""The sensors of this project's distributions, installed or not, read from a table.

The table `known_sensors.json` is generated from the plugins by `make known-sensors`, and is the
only place in the core that names sensors. With the table, messages can name the distribution of a
sensor that is not installed, and installed sensors can be listed without loading their plugins.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from lidarspec.entry_points import GROUP, SENSORS, EntryPoint, entry_points
from lidarspec.errors import UnknownSensor, suggest

#: Placeholder for a distribution in an install command.
ANY_DISTRIBUTION = "lidarspec-VENDOR"
_REPOSITORY = "https://github.com/lidarspec/lidarspec"
_PREFIX = "lidarspec-"


class KnownLink(NamedTuple):
    """A link of a sensor.

    Attributes:
        kind: "serial", "udp", "tcp" or another kind.
        numbers: the baud rates or ports, the most likely first.
    """

    kind: str
    numbers: tuple[int, ...] = ()


class Signature(NamedTuple):
    """The constant bytes at the start of a data frame, and the size of the frame.

    Attributes:
        sync: the bytes as hexadecimal text, such as "54 .. 2c"; ".." is a byte that varies.
        size: the size of the frame in bytes; 0 if it varies.
    """

    sync: str
    size: int


class KnownSensor(NamedTuple):
    """A sensor in the table of known sensors.

    Attributes:
        signatures: constant bytes and sizes of its data frames.
    """

    id: str
    vendor: str
    model: str
    status: str
    distribution: str
    version: str
    aliases: tuple[str, ...] = ()
    links: Mapping[str, KnownLink] = {}
    signatures: tuple[Signature, ...] = ()

    @property
    def names(self) -> frozenset[str]:
        """The id and the aliases."""
        return frozenset((self.id, *self.aliases))

    def to_dict(self) -> dict[str, Any]:
        """Return the row as JSON data."""
        return {
            **self._asdict(),
            "aliases": list(self.aliases),
            "links": {name: [link.kind, *link.numbers] for name, link in self.links.items()},
            "signatures": [list(signature) for signature in self.signatures],
        }

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> KnownSensor:
        """Return the row that `to_dict` wrote."""
        links = {
            name: KnownLink(kind, tuple(numbers)) for name, (kind, *numbers) in row["links"].items()
        }
        signatures = tuple(Signature(sync, size) for sync, size in row["signatures"])
        given = {**row, "aliases": tuple(row["aliases"]), "links": links, "signatures": signatures}
        return cls(**given)


@functools.cache
def known_sensors() -> tuple[KnownSensor, ...]:
    """Return the rows of the table, sorted by id."""
    import json

    with open(
        os.path.join(os.path.dirname(__file__), "known_sensors.json"), encoding="utf-8"
    ) as file:
        return tuple(KnownSensor.from_dict(row) for row in json.load(file))


def select_known_sensors(entries: Iterable[EntryPoint]) -> list[KnownSensor]:
    """Return the rows of the table that describe installed sensors.

    A row is returned if its distribution is installed in the version of the row, and if the entry
    points of this distribution for one sensor are exactly the id and the aliases in the row.

    Args:
        entries: the entry points of all installed sensors.
    """
    offered: dict[tuple[str, str], dict[str, set[str]]] = {}
    for entry in entries:
        names = offered.setdefault((entry.distribution, entry.version), {})
        names.setdefault(entry.value, set()).add(entry.name)
    return [
        row
        for row in known_sensors()
        if row.names in offered.get((row.distribution, row.version), {}).values()
    ]


def list_sensors_from_table() -> list[KnownSensor] | None:
    """Return the row of each installed sensor, sorted by id.

    Returns None if the table does not have a row for every installed sensor, or if a module with
    hooks is installed, which may add sensors.
    """
    if entry_points(GROUP):
        return None
    entries = entry_points(SENSORS)
    rows = select_known_sensors(entries)
    described = {name for row in rows for name in row.names}
    if len(described) == len(entries):
        return rows
    return None


def find_known_sensor(name: str) -> KnownSensor | None:
    """Return the row of a sensor in the table of known sensors, or None.

    Args:
        name: an id or alias, in upper or lower case, with or without hyphens.
    """
    letters = _keep_letters(name)
    return next(
        (
            row
            for row in known_sensors()
            if any(_keep_letters(known) == letters for known in row.names)
        ),
        None,
    )


def _keep_letters(name: str) -> str:
    return re.sub(r"[\W_]", "", name).lower()


def install_command(*distributions: str, extra: str = "") -> str:
    """Return the command that installs distributions of this project.

    Args:
        distributions: the names of the distributions.
        extra: the extra that is installed with each distribution; "" for none.
    """
    extras = f"[{extra}]" if extra else ""
    plugins = os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "plugins")
    if os.path.isdir(plugins):
        sources = [os.path.join(plugins, name) + extras for name in distributions]
    else:
        sources = [
            f"{name}{extras} @ git+{_REPOSITORY}#subdirectory=plugins/{name}"
            for name in distributions
        ]
    return " ".join(["pip install", *map(_quote, sources)])


def _quote(word: str) -> str:
    if re.fullmatch(r"[\w./:+-]+", word):
        return word
    return f"'{word}'"


def no_sensors_text() -> str:
    """Return the message for an environment without sensors, with the install command."""
    vendors = sorted({row.distribution.removeprefix(_PREFIX) for row in known_sensors()})
    return (
        f"no sensor is installed: {install_command(ANY_DISTRIBUTION)}\n  vendors:"
        f" {', '.join(vendors)}"
    )


def unknown_sensor_error(
    name: str,
    installed: Iterable[str],
    aliases: Mapping[str, str],
    failures: Mapping[str, str],
) -> UnknownSensor:
    """Return the error for an unknown sensor, with the install command if it is known.

    Args:
        name: an id or alias.
        installed: the ids of the installed sensors.
        aliases: alias -> id of an installed sensor.
        failures: distribution -> the reason why the plugin failed to load.
    """
    row = find_known_sensor(name)
    if row is not None:
        return suggest(
            UnknownSensor(name, distribution=row.distribution), install_command(row.distribution)
        )
    installed = tuple(installed)
    if failures:
        hint = "".join(
            f"; {distribution} failed to load: {reason}"
            for distribution, reason in failures.items()
        )
        return suggest(
            UnknownSensor(name, installed, aliases=aliases, hint=hint), "lidarspec plugins"
        )
    if not installed:
        return suggest(
            UnknownSensor(name, hint="; no sensor plugin is installed"),
            install_command(ANY_DISTRIBUTION),
        )
    return UnknownSensor(name, installed, aliases=aliases)
