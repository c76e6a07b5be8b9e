"""The pages say what is true: blocks run, and every hook, error and verb has its heading."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec import errors, hookspecs
from lidarspec.cli.root import VERBS

DOCS = Path(__file__).parents[1] / "docs"
MANUAL = bytes.fromhex(
    "542c6808ab7ee000e4dc00e2d900e5d500e3d300e4d000e9cd00e4ca00e2c700e9c500e5c200e5c000e5be823a1a50"
)  # STL-27L development manual, section 3.3


def blocks(page: str, language: str = "python") -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def headings(page: str) -> set[str]:
    return set(re.findall(r"^## (\S+)$", (DOCS / page).read_text(encoding="utf-8"), flags=re.MULTILINE))


@pytest.fixture
def tutorial(tmp_path: Path) -> Path:
    (tmp_path / "stl27l.py").write_text(blocks("tutorial/first-sensor.md")[0], encoding="utf-8")
    return tmp_path


def test_the_plugin_of_the_tutorial_decodes_the_manuals_frame(tutorial: Path) -> None:
    sensor = ls.sensor(tutorial / "stl27l.py")
    packets = sensor.decode(MANUAL)
    assert packets["start_angle"].tolist() == [pytest.approx(324.27)]
    assert packets.raw["points"]["distance"][0].tolist() == [224, 220, 217, 213, 211, 208, 205, 202, 199, 197, 194, 192]
    cloud = packets.points()
    assert cloud.x[0] == pytest.approx(0.224 * 0.81186, abs=1e-4)  # cos 324.27 deg
    assert cloud.y[0] == pytest.approx(0.224 * 0.58384, abs=1e-4)  # 35.73 deg to the left


def test_the_tutorials_session_runs_as_it_stands(tutorial: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", blocks("tutorial/first-sensor.md")[1]], cwd=tutorial, capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("PointCloud(36 points")


def test_the_tutorials_test_class_passes(tutorial: Path) -> None:
    (tutorial / "test_mine.py").write_text(blocks("tutorial/first-sensor.md")[2], encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."], cwd=tutorial, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("block", [0, 1])
def test_the_programs_on_live_sources_run_as_they_stand(block: int) -> None:
    done = subprocess.run([sys.executable, "-c", blocks("how-to/live.md")[block]], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("Scan(2160 points, 10.0 Hz")


def test_every_hook_has_its_heading() -> None:
    assert {name for name in vars(hookspecs) if name.startswith("lidarspec_")} <= headings("reference/hooks.md")


def test_every_public_error_has_its_heading() -> None:
    public = {name for name in dir(ls) if isinstance(getattr(errors, name, None), type)} - {"LidarSpecError"}
    assert public == headings("reference/errors.md")


def test_every_verb_has_its_heading() -> None:
    assert set(VERBS) <= headings("reference/command-line.md")


@pytest.mark.parametrize("page", sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")))
def test_links_between_pages_lead_somewhere(page: str) -> None:
    path = DOCS / page
    for target in re.findall(r"\]\(([^)#:]+\.md)", path.read_text(encoding="utf-8")):
        assert (path.parent / target).is_file(), target
