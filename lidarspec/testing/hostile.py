"""What damaged frames may do: be a `WireError`, or pass with a bit that no checksum covers, which is measured."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, WireError
from lidarspec.framing.frame_engine import CompiledCodec, codec
from lidarspec.framing.results import VALID
from lidarspec.testing import subject as material
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.subject import MANY, Subject
from lidarspec.wire.layout import Layout

#: frames of which every bit is flipped.
SAMPLES = 3


def a_truncated_frame_is_a_wire_error(subject: Subject, name: str) -> None:
    """A frame that is cut short at any byte is a `WireError` with its place."""
    data = subject.example(name, seed=2)
    for end in material.places(len(data), subject.source("cut")):
        try:
            subject.sensor.parse(data[:end], frame=name)
        except WireError as error:
            require(0 <= error.offset <= end, "LS307", f"cut at byte {end}, and the fault is told at byte {error.offset}", name)
        except Exception as error:
            raise _undocumented(error, f"cut at byte {end} of {len(data)}", name) from error
        else:
            raise Violation("LS307", f"cut at byte {end} of {len(data)}, and it passes", name)


def a_damaged_frame_is_at_worst_a_wire_error(subject: Subject, name: str) -> None:
    """Hostile mutations of a frame parse, or are a `WireError`, whether or not they are verified."""
    sensor, source = subject.sensor, subject.source(f"mutations {name}")
    types = (name, None) if len(sensor.frames) <= MANY else (name,)
    for seed in subject.seeds(sensor.frames[name], share=4):
        data = material.mutated(subject.example(name, seed=seed % 8), source)
        for kind, verify in itertools.product(types, (True, False)):
            try:
                sensor.parse(data, frame=kind, verify=verify)
            except WireError:
                continue
            except Exception as error:
                raise _undocumented(error, f"parsing {data.hex(' ')[:200]}", name) from error


def every_single_bit_error_is_seen(subject: Subject, name: str) -> None:
    """Every flipped bit under a checksum makes the frame invalid; how many of the others pass is measured."""
    engine = codec(subject.sensor.frames[name])
    if not isinstance(engine, CompiledCodec):
        return
    tried = passed = 0
    sealed = False
    for seed in range(SAMPLES):
        data = subject.example(name, seed=seed)
        layout = engine.tree.layout(data)
        assert isinstance(layout, Layout)
        unfilled = any(int(seal.stored(_rows([data]))[0]) in seal.absent for seal in layout.seals)
        if unfilled:
            continue
        sealed = bool(layout.seals)
        bits = _accepted(engine, data)
        tried, passed = tried + 8 * len(data), passed + len(bits)
        covered = {byte for seal in layout.seals if not seal.absent for start, end in seal.spans for byte in range(start, end)}
        for bit in bits:
            place = f"{name}.{_field_at(layout, bit // 8)}".rstrip(".")
            require(bit // 8 not in covered, "LS310", f"bit {bit % 8} of byte {bit // 8} is flipped, and the frame passes", place)
    if tried:
        kind = "under a checksum" if sealed else "without a checksum"
        subject.measured[f"{name}, {kind}: single-bit errors that pass"] = f"{100 * passed / tried:.3g} %"


def _accepted(engine: CompiledCodec, data: bytes) -> list[int]:
    """The bits of a frame that can be flipped, one at a time, without its being refused."""
    bits = np.arange(8 * len(data))
    rows = np.repeat(_rows([data]), len(bits), axis=0)
    rows[bits, bits // 8] ^= (1 << bits % 8).astype(np.uint8)
    for spot, (mask, value) in engine.prefix.items():
        bits = bits[(rows[bits, spot] & mask) == value]
    survey = engine.survey(rows.reshape(-1), bits * len(data))
    return [int(bit) for bit in bits[(survey.status == VALID) & (survey.sizes == len(data))]]


def _rows(frames: list[bytes]) -> NDArray[np.uint8]:
    return np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)


def _field_at(layout: Layout, byte: int) -> str:
    """The name of the part of a frame in which a byte stands."""
    return next((path for path, (start, end) in layout.places.items() if start <= byte < end), "")


def _undocumented(error: Exception, what: str, name: str) -> Violation:
    code = "LS115" if isinstance(error, SpecError) else "LS308"
    return Violation(code, f"{what}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}", name)
