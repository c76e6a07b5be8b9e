"""Write `lidarspec/known_sensors.json` from the plugins in `plugins/`.

`make known-sensors` installs all of them and runs this script.
"""

from __future__ import annotations

import json
from pathlib import Path

from lidarspec.detect.uninstalled_sensors import make_signatures
from lidarspec.plugins import make_row, registry

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "lidarspec" / "known_sensors.json"


def table() -> str:
    """Return the table as JSON, one sensor a line, without sensors of other projects."""
    own = {folder.name for folder in (ROOT / "plugins").iterdir()}
    homes = {
        name: plugin
        for plugin in registry().plugins
        for name in plugin.sensors
        if plugin.distribution in own
    }
    rows = []
    for name, sensor in registry().sensors().items():
        if name in homes:
            row = make_row(sensor, homes[name].distribution, homes[name].version)
            rows.append(
                json.dumps(
                    row._replace(signatures=make_signatures(sensor)).to_dict(), ensure_ascii=False
                )
            )
    return "[\n" + ",\n".join(rows) + "\n]\n"


if __name__ == "__main__":
    TABLE.write_text(table(), encoding="utf-8")
