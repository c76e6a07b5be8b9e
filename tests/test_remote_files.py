"""Tests of remote files: the message if a driver gives no reason."""

from __future__ import annotations

import re

import pytest

from lidarspec import SourceError, remote_files


@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (FileNotFoundError("http://10.0.0.1/drive.pcap"), "no such file"),
        (FileNotFoundError("/10.0.0.1/drive.pcap"), "no such file"),
        (TimeoutError(), "TimeoutError"),
        (OSError("403 Forbidden"), "403 Forbidden"),
    ],
)
def test_failure_of_a_store_has_a_reason(
    failure: Exception, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class System:
        def open(self, path: str, mode: str) -> None:
            raise failure

    url = "http://10.0.0.1/drive.pcap"
    monkeypatch.setattr(remote_files, "find_file_system", lambda url: System())
    with pytest.raises(SourceError, match=f"^{re.escape(f'{url}: {reason}')}$"):
        remote_files.open_stored(url)
