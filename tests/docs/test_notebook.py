"""Tests that the documentation's notebook runs in a new kernel with its outputs."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import DOCS
from tests.libraries import Library, needs

pytestmark = [
    pytest.mark.slow,
    needs("nbclient", "nbformat", "ipykernel", "matplotlib", "pandas", "pyarrow"),
]
nbclient = Library("nbclient")
nbformat = Library("nbformat")
PAGE = DOCS / "how-to" / "notebook.ipynb"


def list_outputs(cell: Any) -> dict[str, str]:
    """Return the outputs of a cell, by kind."""
    outputs = {
        "text": "".join(output.text for output in cell.outputs if output.output_type == "stream")
    }
    for output in cell.outputs:
        outputs |= dict(output.get("data", {}))
    return outputs


@pytest.mark.skipif(os.name == "nt", reason="some cells are for a shell")
def test_the_notebook_runs_and_shows_its_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(PAGE, as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    cells = [list_outputs(cell) for cell in notebook.cells if cell.cell_type == "code"]
    assert len([cell for cell in cells if cell.get("image/svg+xml", "").startswith("<svg")]) == 3
    tables = [cell["text/html"] for cell in cells if "text/html" in cell]
    assert [
        word in table
        for word, table in zip(
            ("50%", "blocks.azimuth [deg]", "expected 0x", "<svg"), tables, strict=True
        )
    ] == [True] * 4
    assert any("image/png" in cell for cell in cells)
    texts = "".join(cell["text"] for cell in cells)
    assert re.search(r"\(2160, 3\) 1\.\d+ 5\.\d+", texts)
    assert re.search(r"sensor +velodyne-vlp16", texts)
    assert re.search(r"^19 whole scans", texts, re.MULTILINE)
    assert "'stamp'" in cells[-1]["text/plain"]
    assert [path.name for path in tmp_path.iterdir() if path.name != "ipython"] == []


def test_the_tracked_notebook_has_no_outputs() -> None:
    notebook = nbformat.read(PAGE, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}


def test_links_of_the_notebook_lead_somewhere_and_it_is_in_the_contents() -> None:
    text = "".join(
        cell.source
        for cell in nbformat.read(PAGE, as_version=4).cells
        if cell.cell_type == "markdown"
    )
    # The links are those of the built site, because links in notebooks are not converted.
    links = re.findall(r"\]\(\.\./([^)#:]+)/\)", text)
    assert len(links) == text.count("](")
    assert all((PAGE.parent / f"{link}.md").is_file() for link in links)
    assert ": how-to/notebook.ipynb" in (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
