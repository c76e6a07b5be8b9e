"""A new distribution: the files that make a sensor known, from the templates inside the package.

A line of a template that ends in ``#if serial`` or ``#if udp`` is for sensors with that link alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Literal

from lidarspec.discovery.draft import Draft, drafted
from lidarspec.errors import SourceError, UsageError

Link = Literal["serial", "udp"]
#: what the modules of the templates call something else.
TAKEN = {"ACK", "COMMAND", "DATA", "RATE", "SAMPLES", "TURNS"}
#: frames of a capture that are kept as vectors.
VECTORS = 3
_ID = re.compile(r"([a-z0-9]+)-([a-z0-9]+(?:-[a-z0-9]+)*)")
_CONDITION = re.compile(r"^(.*?) *#if (\w+)\n", re.MULTILINE)


@dataclass(frozen=True)
class Names:
    """What is called after a sensor, by its id.

    Raises:
        UsageError: for what is no id.
    """

    id: str

    def __post_init__(self) -> None:
        if not _ID.fullmatch(self.id):
            raise UsageError(f"{self.id!r} is no id: it is vendor-model in lower case with hyphens, such as acme-x1")

    @property
    def vendor(self) -> str:
        """The part of the id before the first hyphen, as a name."""
        return self.id.partition("-")[0].capitalize()

    @property
    def model(self) -> str:
        """The rest of it."""
        return self.id.partition("-")[2].upper()

    @property
    def constant(self) -> str:
        """The sensor's name in its module."""
        name = self.model.replace("-", "_")
        return name if name.isidentifier() and name not in TAKEN else f"SENSOR_{name}"

    @property
    def distribution(self) -> str:
        """What is installed."""
        return f"lidarspec-{self.id}"

    @property
    def module(self) -> str:
        """What is imported."""
        return self.distribution.replace("-", "_")

    def values(self) -> dict[str, str]:
        """Everything for the templates."""
        return {
            "id": self.id,
            "vendor": self.vendor,
            "model": self.model,
            "constant": self.constant,
            "distribution": self.distribution,
            "module": self.module,
        }


def invented(names: Names, link: Link) -> dict[str, str]:
    """The files of a distribution with an invented sensor that has everything, by path."""
    values = {
        **names.values(),
        "speed_remark": ", with code 3; else 0" if link == "serial" else "",
    }
    return {
        "pyproject.toml": filled("pyproject.toml", values, link),
        "README.md": filled("README.md", values, link),
        "vectors.json": filled("vectors.json", values, link),
        f"{names.module}/__init__.py": filled("module.py", values, link),
        f"{names.module}/py.typed": "",
        f"tests/test_{names.id.replace('-', '_')}.py": filled("test_module.py", values, link),
    }


def captured(names: Names, link: Link, draft: Draft, *, origin: str, port: int | None) -> dict[str, str]:
    """The files of a distribution with the sensor that a capture was drafted to, by path.

    Args:
        origin: the capture in words.
        port: the UDP port that the datagrams were sent to, where that is known.
    """
    serial = "Serial(115_200)},  # the baud rate: a capture does not tell it"
    udp = f"Udp({port})}},  # where the capture's datagrams went" if port else "Udp(2368)},  # the port: this capture does not tell it"
    values = {**names.values(), **drafted(draft, origin=origin, link=serial if link == "serial" else udp)}
    frames = [
        {"frame": "data", "hex": data.hex(" "), "values": {}, "source": f"{origin}, at byte {at}"} for at, data in draft.frames[:VECTORS]
    ]
    return {
        "pyproject.toml": filled("pyproject.toml", values, link),
        "README.md": filled("README_draft.md", values, link),
        "vectors.json": json.dumps(frames, indent=2) + "\n",
        f"{names.module}/__init__.py": filled("draft.py", values, link),
        f"{names.module}/py.typed": "",
        f"tests/test_{names.id.replace('-', '_')}.py": filled("test_draft.py", values, link),
    }


def filled(template: str, values: Mapping[str, str], link: Link) -> str:
    """The text of a template."""
    text = (files("lidarspec") / "templates" / f"{template}.in").read_text(encoding="utf-8")
    chosen = _CONDITION.sub(lambda line: f"{line[1]}\n" if line[2] == link else "", text)
    return Template(chosen).substitute(values)


def write(folder: Path, texts: Mapping[str, str]) -> None:
    """Put files into a folder that is not there yet.

    Raises:
        UsageError: where it is there.
        SourceError: where it cannot be written.
    """
    if folder.exists():
        raise UsageError(f"{folder} exists already: nothing was written")
    try:
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SourceError(f"{error.filename or folder}: {error.strerror or error}") from None
