"""Plain data as YAML: mappings, lists, strings, numbers and booleans in block style, short lists of numbers in one line."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

#: a string that means the same without quotes.
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./()<>=+*-]*( [A-Za-z0-9_./()<>=+*;,-]+)*")
_WORDS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}


class Byte(int):
    """A number that is written in hexadecimal."""

    def __repr__(self) -> str:
        return f"0x{int(self):02x}"


def yaml(value: Mapping[str, Any]) -> str:
    """The text of a document."""
    return "\n".join(_lines(value, "")) + "\n"


def _lines(value: Any, indent: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _entry(f"{indent}{_scalar(key)}:", part, indent + "  ")
    else:
        for part in value:
            if isinstance(part, Mapping) and part:
                first, *rest = _lines(part, indent + "  ")
                yield f"{indent}- {first.lstrip()}"
                yield from rest
            else:
                yield from _entry(f"{indent}-", part, indent + "  ")


def _entry(head: str, part: Any, indent: str) -> Iterator[str]:
    if (isinstance(part, Mapping) and part) or (_is_list(part) and any(isinstance(item, Mapping | list) for item in part)):
        yield head
        yield from _lines(part, indent)
    elif isinstance(part, Mapping):
        yield f"{head} {{}}"
    elif _is_list(part):
        yield f"{head} [{', '.join(_scalar(item) for item in part)}]"
    else:
        yield f"{head} {_scalar(part)}"


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _scalar(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value if _PLAIN.fullmatch(value) and value.lower() not in _WORDS else json.dumps(value, ensure_ascii=False)
    return repr(value)
