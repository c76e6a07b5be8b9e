"""Tests that each collected published vector is used by a test of its plugin."""

from __future__ import annotations

from pathlib import Path

from tests.evidence import vectors

#: vectors of the collection that no test can use, and why.
LEFT_OUT = {
    "rs_ucwp_bpearl": (
        "settings are not sent: the layout is that of a tool of others, no manual has it"
    ),
    "wt53r_read": "a request to a single-point sensor over Modbus, of which there is no plugin",
}


def test_no_vector_is_left_unused() -> None:
    """A test uses a vector if it contains the name, with or without the family."""
    files = Path(__file__).parents[2].glob("plugins/*/tests/*.py")
    texts = "".join(file.read_text(encoding="utf-8") for file in files)
    names = [
        name for file in ("vectors_serial2d.json", "vectors_udp3d.json") for name in vectors(file)
    ]
    unused = {
        name for name in names if name not in texts and f'"{name.partition("_")[2]}"' not in texts
    }
    assert unused == LEFT_OUT.keys()
