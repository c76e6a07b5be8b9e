"""Tests of the list of messages for review, `make messages`."""

from __future__ import annotations

import ast

from tools.list_messages import iter_texts

SOURCE = '''
"""Module docstring, which nobody lists."""

import re

PATTERN = re.compile("a b c")


@click.command()
def verb():
    """Print one scan."""
    raise UsageError(f"{path}: expected " + "one file")


def helper():
    """Return nothing useful."""
    label: "a type" = "wrong id"
    return {"name": "points per second"}
'''


def test_lists_exactly_the_texts_for_users() -> None:
    texts = list(iter_texts(ast.parse(SOURCE)))
    assert texts == [
        (11, "", "Print one scan."),
        (12, "UsageError", "{}: expected one file"),
        (17, "", "wrong id"),
        (18, "", "points per second"),
    ]
