"""MkDocs hook that lists the page of every sensor in the navigation, by vendor.

The pages are generated from the installed sensors (`reference_pages.py`), so `mkdocs.yml` cannot
name them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import lidarspec as ls

FOLDER = "reference/sensors"


def on_config(config: Any) -> Any:
    """Replace the entry "Sensors" of the navigation."""
    for entry in config["nav"]:
        if "Sensors" in entry:
            entry["Sensors"] = make_entries(ls.sensors().values())
    return config


def make_entries(sensors: Iterable[ls.Sensor]) -> list[dict[str, Any]]:
    """Return navigation entries: the list of all sensors, then a group for each vendor."""
    pages = defaultdict[str, list[dict[str, str]]](list)
    for sensor in sensors:
        pages[sensor.vendor].append({sensor.model: f"{FOLDER}/{sensor.id}.md"})
    vendors = sorted(pages, key=str.lower)
    return [{"All sensors": f"{FOLDER}/index.md"}, *({vendor: pages[vendor]} for vendor in vendors)]
