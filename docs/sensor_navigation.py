"""MkDocs hook that lists the page of every sensor in the navigation, by vendor.

The pages are generated from the installed sensors (`reference_pages.py`), so `mkdocs.yml` cannot
name them.
"""

from __future__ import annotations

import tomllib
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lidarspec as ls

ROOT = Path(__file__).parents[1]
FOLDER = "reference/sensors"
#: the files of `manual_coverage`.
MANUALS = "plugins/*/tests/manual.toml"


def on_config(config: Any) -> Any:
    """Replace the entry "Sensors" of the navigation."""
    for entry in config["nav"]:
        if "Sensors" in entry:
            entry["Sensors"] = make_entries(ls.sensors().values())
    return config


def make_entries(sensors: Iterable[ls.Sensor]) -> list[dict[str, Any]]:
    """Return navigation entries: the list of all sensors, then a group for each vendor."""
    compared = {
        tomllib.loads(path.read_text(encoding="utf-8"))["sensor"] for path in ROOT.glob(MANUALS)
    }
    pages = defaultdict[str, list[dict[str, str]]](list)
    for sensor in sensors:
        pages[sensor.vendor].append({sensor.model: f"{FOLDER}/{sensor.id}.md"})
        if sensor.id in compared:
            page = {f"{sensor.model}: its manual": f"{FOLDER}/{sensor.id}-manual.md"}
            pages[sensor.vendor].append(page)
    vendors = sorted(pages, key=str.lower)
    return [{"All sensors": f"{FOLDER}/index.md"}, *({vendor: pages[vendor]} for vendor in vendors)]
