"""SOURCE, the one noun for where bytes come from: text to transport."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import parse_qs

from lidarspec.errors import UsageError
from lidarspec.files import Transport
from lidarspec.plugins import registry
from lidarspec.transports.files import open_file

_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):")


def transport(source: str | Path) -> Transport:
    """The open transport for a SOURCE.

    Raises:
        UsageError: for a scheme that neither the package nor a plugin knows.
        SourceError: where it cannot be opened.
    """
    text = str(source)
    scheme = _SCHEME.match(text)
    if scheme is not None and not Path(text).exists():
        found: Transport | None = registry().call("lidarspec_source", url=text)
        if found is None:
            raise UsageError(
                f"no transport is installed for {scheme[1]!r} sources; files and '-' (standard input) are read by lidarspec itself"
            )
        return found
    path, mark, query = text.rpartition("?")
    if mark and not Path(text).exists():
        options = parse_qs(query, keep_blank_values=True)
        unknown = set(options) - {"src"}
        if unknown:
            raise UsageError(f"{text}: unknown option {min(unknown)!r}; a file takes src=ADDRESS")
        return open_file(path, sender=options["src"][-1] if "src" in options else None)
    return open_file(text)
