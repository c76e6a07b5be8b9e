"""What one test leaves behind in its process, and what the shell left, is nothing to the next."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator

import pytest

# In the background of a shell Ctrl-C is ignored, and the programs that tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _checksums_by_numpy_again() -> Iterator[None]:
    """A decoder of the back end "jit" has the checksums of its whole process computed by compiled code, with tables of some megabytes."""
    yield
    if layout := sys.modules.get("lidarspec.frames.layout"):
        layout.install_faster(None)
