"""Write a page and packet diagrams for every installed sensor, and an index of the pages.

    python docs/reference_pages.py

`make reference` and `make docs` run this. The files go to docs/reference/sensors, which git
ignores.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from manual_coverage import make_coverage_page, read_coverages

import lidarspec as ls
from lidarspec.exports import export, select_frame
from lidarspec.exports.reference import make_page

FOLDER = Path(__file__).parent / "reference" / "sensors"
INTRODUCTION = """\
Each sensor has a page with its packets, generated from its spec. It was verified with captures of a
real unit (`capture`), with bytes that the vendor or others printed (`vectors`), or from documents
alone (`manual`). `lidarspec sensors` prints this list."""


def make_sensor_files(sensor: ls.Sensor) -> dict[str, str]:
    """Return the text of a sensor's page and packet diagrams, by file name."""
    data_frames = [name for name, frame in sensor.frames.items() if frame.data]
    if len(data_frames) == 1:
        diagrams = {data_frames[0]: f"{sensor.id}.svg"}
    else:
        diagrams = {name: f"{sensor.id}-{name}.svg" for name in data_frames}
    files = {file: export(select_frame(sensor, name), "svg") for name, file in diagrams.items()}
    files[f"{sensor.id}.md"] = make_page(sensor, diagrams)
    return files


def make_coverage_files(sensors: list[ls.Sensor]) -> dict[str, str]:
    """Return the pages that compare manuals with lidarspec, by file name."""
    titles = {sensor.id: f"{sensor.vendor} {sensor.model}" for sensor in sensors}
    return {
        f"{coverage.sensor}-manual.md": make_coverage_page(coverage, titles[coverage.sensor])
        for coverage in read_coverages()
        if coverage.sensor in titles
    }


def make_index(sensors: list[ls.Sensor]) -> str:
    """Return a page with a link to the page of each sensor."""
    lines = ["# Sensors", "", INTRODUCTION, "", "| sensor | id | verified |", "|---|---|---|"]
    for sensor in sensors:
        name = f"{sensor.vendor} {sensor.model}"
        lines.append(f"| [{name}]({sensor.id}.md) | `{sensor.id}` | {sensor.status} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    sensors = list(ls.sensors().values())
    files = {"index.md": make_index(sensors), **make_coverage_files(sensors)}
    for sensor in sensors:
        files |= make_sensor_files(sensor)
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    for name, text in files.items():
        (FOLDER / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
