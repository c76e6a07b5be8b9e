"""List the tools, packages and captures that skipped tests need.

They are derived from the reasons of the skips, and printed with the way to get them.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable

#: a pattern in the reason of a skip -> what is missing, and how to get it.
MISSING = (
    (r"tshark", "tshark", "apt-get install tshark"),
    (r"g\+\+ is not", "g++", "apt-get install g++"),
    (r"gcc", "gcc", "apt-get install gcc"),
    (r"no (xxd|hexdump)", "tools that print bytes", "apt-get install xxd bsdextrautils"),
    (
        r"Kaitai compiler",
        "Kaitai's compiler",
        "npm install kaitai-struct-compiler js-yaml, with NODE_PATH as its node_modules",
    ),
    (
        r"kaitaistruct|crccheck|velodyne.decoder|[Nn]umba|rosbags|mcap|foxglove|pyarrow|duckdb|laspy|pandas|polars|pye57|zarr|zstd|rerun|matplotlib|anywidget|nbclient|playwright|starlette|uvicorn|websockets",
        "Python packages",
        "make test-all, which installs them",
    ),
    (r"axe-core", "axe-core", "npm ci in plugins/lidarspec-web/page"),
    (r"Chromium", "Chromium", "apt-get install chromium"),
    (r"open3d", "Open3D", "pip install open3d"),
    (
        r"LIDARSPEC_CAPTURES|protocol vectors",
        "captures and vectors",
        "LIDARSPEC_CAPTURES=FOLDER, with protocols beside it",
    ),
)

#: files that are named for one missing thing.
MAX_FILES = 3


def describe_missing(skipped: Iterable[tuple[str, str]]) -> list[str]:
    """Return a line for each missing tool, package or capture.

    A line has the number of skipped tests, their files, and the way to install what is missing.

    Args:
        skipped: (node id, reason) of each test that was skipped.
    """
    files: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for node, reason in skipped:
        for pattern, what, remedy in MISSING:
            if re.search(pattern, reason):
                files[what, remedy][node.partition("::")[0].removeprefix("tests/")] += 1
                break
    return [
        f"not run without {what}: {count.total()} tests ({_list_files(sorted(count))}); to have"
        f" them: {remedy}"
        for (what, remedy), count in files.items()
    ]


def _list_files(names: list[str]) -> str:
    """Return the names of the first few files, and the number of the others."""
    if len(names) <= MAX_FILES:
        return ", ".join(names)
    return f"{', '.join(names[:MAX_FILES])} and {len(names) - MAX_FILES} more files"
