"""Tests of plugins' sources with a URL scheme of their own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import lidarspec as ls
from lidarspec.plugins import Registry, hookimpl, use_registry
from lidarspec.transports.open_url import open_live, open_transport
from lidarspec.transports.protocol import Chunk, Transport


class Once(Transport):
    """One chunk, and no more."""

    def chunks(self) -> Iterator[Chunk]:
        yield Chunk(b"once")

    def write(self, data: bytes) -> None:
        raise ls.SourceError("nothing can be sent")

    def close(self) -> None: ...


class Sources:
    @hookimpl
    def lidarspec_source(self, url: str) -> object:
        return {"once:": Once(), "other:": object()}.get(url)


@pytest.fixture(autouse=True)
def registry() -> Iterator[None]:
    own = Registry()
    with use_registry(own):
        own.add(Sources(), name="sources")
        yield


def test_a_minimal_transport_of_a_plugin_has_defaults() -> None:
    opened = open_transport("once:")
    assert [chunk.data for chunk in opened.chunks()] == [b"once"]
    assert (opened.datagrams, opened.baud, list(opened.warnings), opened.foreign) == (
        False,
        None,
        [],
        0,
    )
    with pytest.raises(ls.UsageError, match="is a file"):
        open_live("once:")


def test_anything_else_is_the_fault_of_the_plugin() -> None:
    with pytest.raises(ls.SpecError, match="must return a Transport"):
        open_transport("other:")
    with pytest.raises(ls.UsageError, match="unknown scheme"):
        open_transport("unknown:")


@pytest.mark.parametrize("name", ["a" * 5000, "udp:/" + "a" * 5000, "a" * 5000 + "?src=x", "a\0b"])
def test_a_name_that_no_file_can_have_is_no_file(name: str) -> None:
    with pytest.raises((ls.SourceError, ls.UsageError)):
        open_transport(name)
