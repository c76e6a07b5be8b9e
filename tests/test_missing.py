"""Tests of the list of missing tools at the end of a test run."""

from __future__ import annotations

from tests.missing import describe_missing

HESAI = "plugins/lidarspec-hesai/tests/test_hesai.py"


def test_each_missing_tool_is_named_once_with_its_files_and_its_remedy() -> None:
    skipped = [
        ("tests/exports/test_opens.py::test_a", "Skipped: tshark is not installed"),
        ("tests/exports/test_wireshark.py::test_b[x]", "Skipped: tshark is not installed"),
        ("tests/exports/test_wireshark.py::test_b[y]", "Skipped: tshark is not installed"),
        (
            f"{HESAI}::test_c",
            "Skipped: a.pcap is not here: set LIDARSPEC_CAPTURES to the folder of captures",
        ),
        (
            "tests/testing/test_conformance.py::Test_x::test_vectors_hold",
            "Skipped: there is no file with golden vectors",
        ),
    ]
    tools, captures = describe_missing(skipped)
    files = "exports/test_opens.py, exports/test_wireshark.py"
    assert (
        tools == f"not run without tshark: 3 tests ({files}); to have them: apt-get install tshark"
    )
    start = (
        f"not run without captures and vectors: 1 tests ({HESAI}); to have them:"
        " LIDARSPEC_CAPTURES="
    )
    assert captures.startswith(start)


def test_of_many_files_a_few_are_named() -> None:
    skipped = [
        (f"tests/exports/test_{name}.py::test", "Skipped: tshark is not installed")
        for name in "abcde"
    ]
    (line,) = describe_missing(skipped)
    assert (
        "5 tests (exports/test_a.py, exports/test_b.py, exports/test_c.py and 2 more files);"
        in line
    )
