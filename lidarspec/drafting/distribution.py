"""Make the files of a new sensor's Python distribution.

`make_draft_files` makes a sensor from a `Draft` of unknown frames in a capture.
`make_example_files` makes an example sensor with all features.

The files are made from templates in the package. A template line that ends in ``#if serial`` or
``#if udp`` is used only for sensors with this link.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Literal

from lidarspec.drafting.draft import Draft
from lidarspec.drafting.draft_code import make_template_values
from lidarspec.errors import UsageError, system_errors

Link = Literal["serial", "udp"]
#: Names that the templates of modules define, so that a sensor cannot have them.
RESERVED_NAMES = {"ACK", "COMMAND", "DATA", "RATE", "SAMPLES", "TURNS"}
#: The maximum number of frames of a capture to write to vectors.json.
MAX_VECTORS = 3
#: The header of the section of pyproject.toml that lists the sensors.
_ENTRY_POINTS = '[project.entry-points."lidarspec.sensors"]\n'
_ID = re.compile(r"([a-z0-9]+)-([a-z0-9]+(?:-[a-z0-9]+)*)")
_CONDITION = re.compile(r"^(.*?) *#if (\w+)\n", re.MULTILINE)


@dataclass(frozen=True)
class DistributionNames:
    """The names in the distribution of a sensor.

    Args:
        distribution: the name of the distribution; "" for "lidarspec-" followed by the id.
        vendor: the vendor's display name; "" to derive it from the id.
        model: the model's display name; "" to derive it from the id.

    Raises:
        UsageError: for an invalid id or distribution name, or for a vendor or model with characters
            that must be escaped in a Python string.
    """

    id: str
    distribution: str = ""
    vendor: str = ""
    model: str = ""

    def __post_init__(self) -> None:
        if not _ID.fullmatch(self.id):
            raise UsageError(
                f"{self.id!r} is not a valid id: expected vendor-model in lower case, such as"
                " acme-x1"
            )
        vendor, _, model = self.id.partition("-")
        defaults = {
            "distribution": f"lidarspec-{self.id}",
            "vendor": vendor.capitalize(),
            "model": model.upper(),
        }
        for name, default in defaults.items():
            object.__setattr__(self, name, getattr(self, name) or default)
        if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", self.distribution):
            raise UsageError(
                f"{self.distribution!r} is not a valid name of a distribution: expected words in"
                " lower case, joined by hyphens, such as lidarspec-acme"
            )
        if invalid := re.search(r'["\\\n]', self.vendor + self.model):
            raise UsageError(f"vendor and model must not contain {invalid[0]!r}")

    @property
    def constant(self) -> str:
        """The name of the variable for the sensor in its module."""
        name = self.id.partition("-")[2].upper().replace("-", "_")
        if name.isidentifier() and name not in RESERVED_NAMES:
            return name
        return f"SENSOR_{name}"

    @property
    def package(self) -> str:
        """The import name of the distribution."""
        return self.distribution.replace("-", "_")

    def values(self) -> dict[str, str]:
        """Return the values for the templates."""
        return {
            name: getattr(self, name)
            for name in ("id", "constant", "distribution", "package", "vendor", "model")
        }


def make_example_files(names: DistributionNames, link: Link) -> dict[str, str]:
    """Return the files of a distribution with an example sensor, as {path: text}."""
    values = names.values()
    return _make_files(
        names,
        link,
        values,
        fill_template("vectors.json", values, link),
        ("README.md", "module.py", "test_module.py"),
    )


def make_draft_files(
    names: DistributionNames, link: Link, draft: Draft, *, origin: str, port: int | None
) -> dict[str, str]:
    """Return the files of a distribution with a drafted sensor, as {path: text}.

    Args:
        origin: a description of the capture.
        port: the UDP port to which the datagrams were sent; None if unknown.
    """
    if link == "serial":
        link_code = "Serial(115_200)"
        link_remark = "replace this baud rate: a capture does not contain it"
    elif port:
        link_code = f"Udp({port})"
        link_remark = "the port to which the captured datagrams were sent"
    else:
        link_code = "Udp(2368)"
        link_remark = "replace this port: the capture does not contain it"
    values = {
        **names.values(),
        **make_template_values(draft, origin=origin, link_code=link_code),
        "link_remark": link_remark,
    }
    frames = [
        {
            "sensor": names.id,
            "frame": "data",
            "hex": data.hex(" "),
            "values": {},
            "source": f"{origin}, at byte {offset}",
        }
        for offset, data in draft.frames[:MAX_VECTORS]
    ]
    return _make_files(
        names,
        link,
        values,
        json.dumps(frames, indent=2) + "\n",
        ("README_draft.md", "draft.py", "test_draft.py"),
    )


def _make_files(
    names: DistributionNames,
    link: Link,
    values: Mapping[str, str],
    vectors: str,
    templates: tuple[str, str, str],
) -> dict[str, str]:
    """Return the files of a distribution, as {path: text}."""
    readme, module, tests = (fill_template(template, values, link) for template in templates)
    return {
        "pyproject.toml": fill_template("pyproject.toml", values, link),
        "README.md": readme,
        # empty if lidarspec is installed without its license file
        "LICENSE": distribution("lidarspec").read_text("licenses/LICENSE") or "",
        f"{names.package}/__init__.py": module,
        f"{names.package}/py.typed": "",
        f"{names.package}/vectors.json": vectors,
        f"tests/test_{names.id.replace('-', '_')}.py": tests,
    }


def fill_template(template: str, values: Mapping[str, str], link: Link) -> str:
    """Return the text of a template for a link, with values inserted."""
    text = (files("lidarspec") / "templates" / f"{template}.in").read_text(encoding="utf-8")
    text_for_link = _CONDITION.sub(lambda match: f"{match[1]}\n" if match[2] == link else "", text)
    return Template(text_for_link).substitute(values)


def make_added_files(
    folder: Path, names: DistributionNames, texts: Mapping[str, str]
) -> dict[str, str]:
    """Return the new and changed files of a distribution to which a sensor is added.

    Args:
        folder: the folder of the existing distribution.
        texts: the files of a distribution with only this sensor: path -> text.

    Raises:
        UsageError: if the folder has another distribution, or already has a file of this sensor.
        SourceError: if the files of the distribution cannot be read.
    """
    vectors_path = f"{names.package}/vectors.json"
    with system_errors(folder):
        project, readme = (
            (folder / name).read_text(encoding="utf-8") for name in ("pyproject.toml", "README.md")
        )
        if (folder / vectors_path).exists():
            vectors = (folder / vectors_path).read_text(encoding="utf-8")
        else:
            vectors = "[]"
    if f'name = "{names.distribution}"\n' not in project or _ENTRY_POINTS not in project:
        raise UsageError(
            f"{folder / 'pyproject.toml'} does not define the distribution"
            f" {names.distribution}, or has no table {_ENTRY_POINTS.strip()}"
        )
    module = names.id.partition("-")[2].replace("-", "_")
    if not module.isidentifier():
        module = f"model_{module}"
    test = f"tests/test_{names.id.replace('-', '_')}.py"
    new_files = {
        f"{names.package}/{module}.py": texts[f"{names.package}/__init__.py"],
        test: texts[test],
    }
    for name in new_files:
        if (folder / name).exists():
            raise UsageError(f"{folder / name} exists already: nothing was written")
    entry = f'{names.id} = "{names.package}.{module}:{names.constant}"\n'
    # Append the new vectors to the existing JSON array as text, so that the existing lines do not
    # change.
    existing_vectors = vectors.rstrip().removesuffix("]").rstrip()
    new_vectors = texts[vectors_path].strip().removeprefix("[")
    comma = "" if existing_vectors == "[" else ","
    return {
        **new_files,
        "pyproject.toml": project.replace(_ENTRY_POINTS, _ENTRY_POINTS + entry),
        vectors_path: f"{existing_vectors}{comma}{new_vectors}\n",
        "README.md": (
            f"{readme.rstrip()}\n\n"
            f"The {names.vendor} {names.model}, `{names.id}`,"
            f" is in `{names.package}/{module}.py`.\n"
        ),
    }


def write_files(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files into a folder.

    Raises:
        SourceError: if a file cannot be written.
    """
    with system_errors(folder):
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
