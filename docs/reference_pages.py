"""Makes the page and the packet diagram of every installed sensor in docs/reference/sensors, and the list of them.

    python docs/reference_pages.py [FOLDER]

`make reference` runs it; tests/docs/test_reference_pages.py holds that the pages are up to date.
"""

from __future__ import annotations

import sys
from pathlib import Path

import lidarspec as ls
from lidarspec.exports import export, narrowed
from lidarspec.exports.reference import page

HERE = Path(__file__).parent / "reference" / "sensors"


def pages() -> dict[str, str]:
    """The text of every file, by name."""
    found = {}
    rows = ["# Sensors", "", "One page each, made from the spec by `make reference`.", "", "| sensor | id | proven |", "|---|---|---|"]
    for name, sensor in ls.sensors().items():
        data = [frame for frame, value in sensor.frames.items() if value.data]
        pictures = {frame: f"{name}.svg" if len(data) == 1 else f"{name}-{frame}.svg" for frame in data}
        found |= {picture: export(narrowed(sensor, frame), "svg") for frame, picture in pictures.items()}
        found[f"{name}.md"] = page(sensor, pictures)
        rows.append(f"| [{sensor.vendor} {sensor.model}]({name}.md) | `{name}` | {sensor.status} |")
    return found | {"index.md": "\n".join(rows) + "\n"}


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE
    folder.mkdir(parents=True, exist_ok=True)
    made = pages()
    for old in folder.iterdir():
        if old.name not in made and old.suffix in (".md", ".svg"):
            old.unlink()
    for name, text in made.items():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
