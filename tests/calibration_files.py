"""Calibration files as written by vendors' tools, for the tests of several packages."""

from __future__ import annotations

from pathlib import Path

#: corrections of a laser by name, and how far they differ from one laser to the next: degrees, or
#: centimetres.
_STEPS = {
    "rotCorrection_": 0.1,
    "vertCorrection_": -0.2,
    "distCorrection_": 2,
    "vertOffsetCorrection_": 0.3,
    "horizOffsetCorrection_": 0.05,
}
_HEAD = (
    "<?xml version='1.0'?><!DOCTYPE"
    " boost_serialization><boost_serialization><DB><distLSB_>0.2</distLSB_>"
)


def write_velodyne_xml(path: Path, lasers: int = 64, **values: str) -> Path:
    """Write the `db.xml` of a unit with corrections that depend on the laser's number.

    Args:
        values: corrections, by name, that are the same for all lasers.
    """
    items = []
    for laser in range(lasers):
        corrections = ""
        for name, step in _STEPS.items():
            corrections += f"<{name}>{values.get(name, laser * step)}</{name}>"
        items.append(f"<item><px><id_>{laser}</id_>{corrections}</px></item>")
    points = f"<points_><count>{lasers}</count>{''.join(items)}</points_>"
    path.write_text(f"{_HEAD}{points}</DB></boost_serialization>")
    return path
