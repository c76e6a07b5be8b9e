"""Build hook of the wheel: add the manual pages if they have been generated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ManualPages(BuildHookInterface):
    """Install the files in docs/man, which `make wheels` generates, as manual pages."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if (Path(self.root) / "docs" / "man").is_dir():
            build_data["shared_data"]["docs/man"] = "share/man/man1"
