"""Tests of the soak: broken promises are found, and the table is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.soak import __main__ as soak
from tests.soak.figures import ROOT, Figure
from tests.soak.promises import EVERY, Promise

#: measured with a small effort in the slow tier; the other tests hold the promises.
QUICK = ("P4", "P6", "P20", "P23")
BY_NAME = {promise.name: promise for promise in EVERY}


def test_each_promise_names_an_existing_test() -> None:
    assert [name for name in BY_NAME if name] == [f"P{number}" for number in range(1, 25)]
    for promise in EVERY:
        assert promise.tests or promise.measured
        assert all((ROOT / test.partition("::")[0]).exists() for test in promise.tests)


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_every_promise_is_measured(name: str) -> None:
    figure = soak.measure_promise(BY_NAME[name], 0.01, tests=False)
    assert "could not be measured" not in figure.words
    assert any(letter.isdigit() for letter in figure.words)


@pytest.mark.slow
def test_a_broken_promise_is_reported(tmp_path: Path) -> None:
    (tmp_path / "test_promised.py").write_text(
        "def test_kept(): pass\ndef test_broken(): assert False\n"
    )
    figure = soak.measure_promise(
        Promise("P0", "", (str(tmp_path / "test_promised.py"),), "all is well"), 0.01
    )
    assert figure == Figure("1 of 2 tests fail: test_broken", False)

    def failing(share: float) -> Figure:
        raise OSError("no line")

    assert soak.measure_promise(Promise("P0", "", (), "", failing), 0.01) == Figure(
        "could not be measured: OSError: no line", False
    )


def test_the_table_is_written_between_its_marks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (
        soak.PAGE.read_text(encoding="utf-8").count(soak.BEGIN)
        == soak.PAGE.read_text(encoding="utf-8").count(soak.END)
        == 1
    )
    page = tmp_path / "page.md"
    page.write_text(f"before\n{soak.BEGIN}\nold\n{soak.END}\nbehind\n")
    monkeypatch.setattr(soak, "PAGE", page)
    monkeypatch.setattr(soak, "ROOT", tmp_path)
    promise = BY_NAME["P1"]
    for figure in (Figure("3 | 4 differ", False), Figure("0 differ", True)):
        soak.write_table(soak.table({promise: figure}, 60.0))
    text = page.read_text()
    assert f"| P1 | {promise.words} | 0 differ | yes |" in text
    assert (
        "| P1 | any split of a stream gives the same result | 3 / 4 differ | **no** |"
        in soak.table({promise: Figure("3 | 4 differ", False)}, 60.0)
    )
    assert text.startswith("before\n")
    assert text.endswith("behind\n")
    assert "old" not in text
