"""Compute points with NumPy alone.

`compile` returns an object that computes columns of a `points.plan.Plan` by NumPy calls on small
arrays that fit in the cache of the processor. Modules in reading order:

* `program`: runs NumPy calls on registers, chunk by chunk.
* `compiler`: compiles expressions to the steps of a program.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from lidarspec.points.numpy_plan.compiler import Compiler
from lidarspec.points.plan import ColumnMaker, Plan


def compile(plan: Plan, names: tuple[str, ...]) -> ColumnMaker:
    """Return the program that computes columns of a plan; the plan caches it."""
    if names not in plan.programs:
        plan.programs[names] = _compile(plan, names, plan.tables).program
    return plan.programs[names]


def _compile(plan: Plan, names: tuple[str, ...], tables: dict[Any, NDArray[Any]]) -> Compiler:
    compiler = Compiler(plan, tables)
    for name in names:
        if name in plan.raw_fields:
            compiler.add_integers(name, plan.raw_fields[name])
            continue
        kind = "double" if name == "azimuth" else "single"
        compiler.add_column(name, plan.expressions[name], kind, exact=plan.is_exact(name))
    return compiler


def describe(plan: Plan) -> list[str]:
    """Return a description of a plan as lines of text."""
    names = tuple(
        name
        for name in ("x", "y", "z", "intensity")
        if name in plan.expressions and not (name == "z" and plan.is_level)
    )
    tables: dict[Any, NDArray[Any]] = {}
    compiler = _compile(plan, names, tables)
    program = compiler.program
    axes = " x ".join(
        f"{axis} {length}" for axis, length in zip(plan.axes, plan.shape, strict=True)
    )
    lines = [f"{plan.width} points per packet{': ' if axes else ''}{axes}"]
    plainly = [node for node in plan.tape.nodes if node in compiler.low or node in plan.eager_nodes]
    lines.append(f"{len(plainly)} values per packet or block, computed by the reference evaluator:")
    lines += [f"  {node.kind} {node.path}".rstrip() for node in plainly if node.kind != "call"]
    lines.append(f"steps for each chunk of {program.chunk} packets (lookup tables: {len(tables)}):")
    outputs = {register: name for name, register in program.outputs.items()}
    for step in program.steps:
        if step.output in outputs:
            output = f"  -> {outputs[step.output]}"
        else:
            output = ""
        lines.append(f"  r{step.output:<3} {program.kinds[step.output]:<7} {step.text}{output}")
    return lines
