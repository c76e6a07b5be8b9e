"""Tests of C headers: they compile with strict warnings and read frames as we do."""

from __future__ import annotations

import contextlib
import functools
import random
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import lidarspec
from lidarspec import Sensor, WireError
from lidarspec.exports import ExportError, export, make_prefix
from lidarspec.frames.schema import Schema
from lidarspec.framing.frame_engine import get_codec
from lidarspec.testing import sensor_under_test as material
from tests.exports.trees import (
    NULL_TERMINATED,
    SHAPED,
    distinct_frames,
    distinct_sensors,
    find_recoded,
    list_byte_frames,
    parse_wire_fields,
    values,
)
from tests.shapes import SHAPES

GCC = shutil.which("gcc")
needs_gcc = pytest.mark.skipif(GCC is None, reason="gcc is not installed")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
#: fields of these names get an underscore, since functions of the whole frame have them.
OWN = ("frame_length", "is_frame")
#: the reason of the refusal of parts that C cannot say.
_PARTS = "the export to C does not support parts with an offset that depends"
#: the shapes that C cannot say, with the reason.
REFUSED = {
    "shape-text": "Decimal is Python code",
    "shape-names": "bytes whose size depends on their content",
    "shape-segments": f"segments: {_PARTS}",
    "shape-tags": f"tags: {_PARTS}",
    "shape-channels": f"channels: {_PARTS}",
    **find_recoded(SHAPED.values()),
}
#: the installed sensors that C cannot say, with the reason.
REFUSED_INSTALLED = {
    **NULL_TERMINATED,
    **dict.fromkeys(("livox-mid360", "livox-hap"), f"parameters: {_PARTS}"),
    "ti-iwr6843": f"tlvs: {_PARTS}",
    **dict.fromkeys(("sick-multiscan136", "sick-picoscan150"), f"modules: {_PARTS}"),
}

_MAIN = """\
#include <stdio.h>
#include <stdlib.h>
%s
static void whole(const char *path, double value) { printf("%%s %%.17g\\n", path, value); }
static void wide(const char *path, uint64_t value) { printf("%%s %%llu\\n", path, (unsigned long long)value); }
static void negative(const char *path, int64_t value) { printf("%%s %%lld\\n", path, (long long)value); }
static void bytes(const char *path, const uint8_t *p, size_t n)
{
    printf("%%s ", path);
    for (size_t i = 0; i < n; ++i) printf("%%02x", p[i]);
    printf("\\n");
}
%s
int main(void)
{
    static char name[256], hex[200000];
    while (scanf("%%255s =%%199999[0-9a-f]", name, hex) >= 1) {
        const size_t n = strlen(hex) / 2;
        uint8_t *p = (uint8_t *)malloc(n + !n);
        for (size_t i = 0; i < n; ++i) { unsigned byte = 0; sscanf(hex + 2 * i, "%%2x", &byte); p[i] = (uint8_t)byte; }
%s        printf("end\\n");
        free(p);
        hex[0] = 0;
    }
    return 0;
}
"""


@functools.cache
def subjects() -> dict[str, Sensor]:
    """Return every sensor that C supports, one for each set of frames, by id."""
    sensors = distinct_sensors()
    refused = {*REFUSED, *REFUSED_INSTALLED, *find_recoded(sensors.values())}
    return {name: sensor for name, sensor in sensors.items() if name not in refused}


def list_frames() -> list[tuple[Sensor, str]]:
    """Return the frame types of these sensors that C can read, each once."""
    return [
        (sensor, name)
        for sensor, name in distinct_frames(subjects().values())
        if name in list_byte_frames(sensor)
    ]


@pytest.mark.parametrize("name", [name for name in SHAPED if name not in REFUSED])
def test_a_header_has_a_function_for_every_field(name: str) -> None:
    sensor = SHAPED[name]
    text = export(sensor, "c")
    for frame in sensor.frames:
        prefix = f"{_word(make_prefix(sensor))}_{frame}"
        assert f" {prefix}_is_frame(" in text
        for path in get_codec(sensor.frames[frame]).schema.fields:
            assert re.search(rf"\b{prefix}_{_word(path)}{'_' * (path in OWN)}\(", text), path


def test_python_conditions_are_refused_with_the_reason() -> None:
    for name, reason in REFUSED.items():
        with pytest.raises(ExportError, match=reason):
            export(SHAPED[name], "c")


@pytest.mark.slow
def test_sensors_that_c_cannot_express_are_refused() -> None:
    for name, reason in REFUSED_INSTALLED.items():
        with pytest.raises(ExportError, match=reason):
            export(lidarspec.sensor(name), "c")


@pytest.mark.slow
@needs_gcc
def test_every_header_compiles_without_a_warning(tmp_path: Path) -> None:
    source = tmp_path / "all.c"
    source.write_text(_include_headers(tmp_path) + "int main(void) { return 0; }\n")
    _compile(source, tmp_path / "all", *STRICT, "-fsyntax-only")


@pytest.mark.slow
@needs_gcc
def test_an_id_that_begins_with_a_digit_makes_valid_names(tmp_path: Path) -> None:
    (tmp_path / "it.h").write_text(export(replace(SHAPED["shape-count"], id="3acme-x1"), "c"))
    (tmp_path / "it.c").write_text(
        '#include "it.h"\nint main(void) { return lidar_3acme_x1_data_count((const uint8_t *)"abc")'
        " != 99; }\n"
    )
    subprocess.run([str(GCC), *STRICT, "-o", "it", "it.c"], cwd=tmp_path, check=True)
    subprocess.run([tmp_path / "it"], check=True)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
def test_every_header_is_cplusplus_too(tmp_path: Path) -> None:
    source = tmp_path / "all.cpp"
    source.write_text(_include_headers(tmp_path) + "int main() { return 0; }\n")
    done = subprocess.run(
        ["g++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only", source],
        check=False,
        capture_output=True,
    )
    assert not done.returncode, done.stderr.decode()[:2000]


@pytest.fixture(scope="module", params=["plain", pytest.param("checked", marks=pytest.mark.soak)])
def reader(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile a program that prints all fields of frames.

    If checked, it ends at the first byte read outside a frame.
    """
    folder = tmp_path_factory.mktemp("c")
    source, program = folder / "reader.c", folder / "reader"
    frames = list_frames()
    dumps = [_dump(sensor, name) for sensor, name in frames]
    calls = [
        f'        if (!strcmp(name, "{sensor.id}:{name}"))'
        f" dump_{_word(make_prefix(sensor))}_{name}(p, n);\n"
        for sensor, name in frames
    ]
    source.write_text(_MAIN % (_include_headers(folder), "\n".join(dumps), "".join(calls)))
    _compile(source, program, "-std=c99", *SANITIZED * (request.param == "checked"))
    return program


@pytest.mark.slow
@needs_gcc
def test_every_field_reads_as_lidarspec_reads_it(reader: Path) -> None:
    frames = [
        (sensor, name, data) for sensor, name in list_frames() for data in _examples(sensor, name)
    ]
    for (sensor, name, data), (is_frame, length, found) in zip(
        frames, _read(reader, frames), strict=True
    ):
        assert (is_frame, length) == (1, len(data)), f"{sensor.id} {name}"
        wanted = values(parse_wire_fields(sensor, name, data))
        assert found.keys() == wanted.keys()
        for path, numbers in wanted.items():
            assert len(found[path]) == len(numbers), f"{sensor.id} {name} {path}"
            assert all(map(_same, found[path], numbers)), f"{sensor.id} {name} {path}"


@pytest.mark.slow
@needs_gcc
def test_damaged_frames_are_rejected_by_both(reader: Path) -> None:
    source = random.Random(1)
    frames = []
    for sensor, name in list_frames():
        data = sensor.example(name, seed=1)
        frames += [(sensor, name, material.mutate(data, source)) for _ in range(12)]
        frames += [(sensor, name, data[:cut]) for cut in {1, len(data) // 2, len(data) - 1}]
    verdicts = [_is_frame(sensor, name, data) for sensor, name, data in frames]
    assert {True, False} <= set(verdicts)
    for (sensor, name, data), wanted, (is_frame, length, _) in zip(
        frames, verdicts, _read(reader, frames), strict=True
    ):
        assert not is_frame or length <= len(data)
        assert (is_frame == 1 and length == len(data)) == wanted, f"{sensor.id} {name} {data.hex()}"


@pytest.mark.slow
@needs_gcc
def test_scaling(tmp_path: Path) -> None:
    calls = {
        "ldrobot_stl27l_data_points_distance_to_m(1234)": 1.234,
        "ldrobot_stl27l_data_start_angle_to_deg(18000)": 180.0,
        "ldrobot_stl27l_data_start_angle_to_rad(18000)": 3.141592653589793,
        "shape_twins_info_temperature_to_degC(0)": -40.0,
        "shape_twins_info_temperature_to_K(0)": 233.15,
        "shape_bits_data_mirrored_tilt_to_rad(-16)": -0.2792526803190927,
    }
    source, program = tmp_path / "scaled.c", tmp_path / "scaled"
    lines = "".join(f'    printf("%.15g\\n", {call});\n' for call in calls)
    source.write_text(
        f"#include <stdio.h>\n{_include_headers(tmp_path)}int main(void)\n{{\n{lines}    return 0;\n}}\n"
    )
    _compile(source, program, *STRICT)
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    assert [float(number) for number in printed] == pytest.approx(list(calls.values()), rel=1e-12)


def _include_headers(folder: Path) -> str:
    for sensor in subjects().values():
        (folder / f"{sensor.id}.h").write_text(export(sensor, "c"))
    return "".join(f'#include "{name}.h"\n' for name in subjects())


def _compile(source: Path, program: Path, *options: str) -> None:
    assert GCC is not None
    done = subprocess.run(
        [GCC, *options, "-o", program, source], check=False, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr[:2000]


def _word(text: str) -> str:
    return re.sub(r"\W", "_", text.replace("[]", "_inner"))


def _dump(sensor: Sensor, name: str) -> str:
    """Return a C function that prints the fields of one frame type.

    The fields and arrays come from lidarspec's schema.
    """
    table = get_codec(sensor.frames[name]).schema
    prefix = f"{_word(make_prefix(sensor))}_{name}"
    text = export_of(sensor.id)
    lines = [
        f'    printf("%d %zu\\n", {prefix}_is_frame(p, n), {prefix}_frame_length(p, n));',
        f"    if (!{prefix}_is_frame(p, n)) return;",
    ]
    lines += [line for path in table.fields for line in _make_print_code(table, path, prefix, text)]
    return f"static void dump_{prefix}(const uint8_t *p, size_t n)\n{{\n" + "\n".join(lines) + "\n}"


def _make_print_code(table: Schema, path: str, prefix: str, text: str) -> Iterator[str]:
    info = table.fields[path]
    axes = info.axes[:-1] if info.kind == "bytes" else info.axes
    name, indices = (
        f"{prefix}_{_word(path)}" + "_" * (path in OWN),
        "".join(f", i{level}" for level in range(len(axes))),
    )
    kind = {"float": "whole", "bytes": "bytes"}.get(info.kind) or (
        "negative" if info.dtype is not None and info.dtype.kind == "i" else "wide"
    )
    value = (
        f'{kind}("{path}",'
        f" {name}(p{indices}){f', {name}_size(p{indices})' if kind == 'bytes' else ''});"
    )
    loops = ""
    for level, axis in enumerate(axes):
        outer = "".join(f", i{above}" for above in range(level))
        loops += (
            f"for (size_t i{level} = 0; i{level} < {prefix}_{_word(axis)}_count(p{outer});"
            f" ++i{level}) "
        )
    present = f"if ({name}_present(p{indices})) " if f" {name}_present(" in text else ""
    yield f"    {loops}{present}{value}"


@functools.cache
def export_of(name: str) -> str:
    """Return the header of a sensor, from a cache."""
    return export(subjects()[name], "c")


def _examples(sensor: Sensor, name: str) -> list[bytes]:
    return [
        sensor.example(name, seed=seed)
        for seed in range(6 if sensor.frames[name].max_length < 300 else 2)
    ]


def _read(
    program: Path, frames: list[tuple[Sensor, str, bytes]]
) -> Iterator[tuple[int, int, dict[str, list[str]]]]:
    given = "".join(f"{sensor.id}:{name} ={data.hex()}\n" for sensor, name, data in frames)
    done = subprocess.run([program], input=given, check=False, capture_output=True, text=True)
    assert not done.returncode, done.stderr[:2000]
    for block in done.stdout.split("end\n")[:-1]:
        first, *lines = block.splitlines()
        is_frame, length = map(int, first.split())
        found: dict[str, list[str]] = {}
        for line in lines:
            path, _, value = line.partition(" ")
            found.setdefault(path, []).append(value)
        yield is_frame, length, found


def _same(printed: str, value: Any) -> bool:
    if isinstance(value, bytes):
        return printed == value.hex()
    if isinstance(value, float):
        return float(printed) == value or (value != value and "nan" in printed)
    return int(printed) == int(value)


def _is_frame(sensor: Sensor, name: str, data: bytes) -> bool:
    with contextlib.suppress(WireError):
        sensor.parse(data, frame=name)
        return True
    return False


def test_the_functions_of_a_frame_have_the_names_that_the_header_documents() -> None:
    header = str(export(SHAPES["shape-count"], "c"))
    for ending in (
        "frame_length",
        "is_frame",
        "checksum_ok",
        "checksum_computed",
        "checksum_stored",
    ):
        assert f" shape_count_data_{ending}(" in header
    assert "..._computed(p) and ..._stored(p)" in header
