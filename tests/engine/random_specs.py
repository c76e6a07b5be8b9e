"""Random structs as Python text, in combinations that no author may have tried.

A spec that fails is printed as Python code. Its number determines its size, so that the first to
fail is a small one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random
from typing import Any

import construct

from lidarspec import spec as vocabulary

#: Names that the text may use.
NAMES: dict[str, Any] = {
    **vars(construct),
    **{name: getattr(vocabulary, name) for name in ("Scaled", "Checksummed", "Xor", "Sum", "Crc")},
}

#: A rebuilt value that is right in each parsed frame. Other rebuilt values replace the parsed one.
COUNT_OF_ARRAY = "Rebuild(Int8ub, len_(this.v))"
WORDS = (
    "Int8ub",
    "Int8sb",
    "Int16ub",
    "Int16ul",
    "Int16sl",
    "Int24ub",
    "Int24ul",
    "Int24sl",
    "Int32ub",
    "Int32sl",
    "Int64ub",
    "Int64sl",
)
ODD = (
    "BytesInteger(5)",
    "BytesInteger(3, signed=True)",
    "BytesInteger(7, swapped=True)",
    "BytesInteger(2, signed=True, swapped=True)",
)
FLOATS = ("Float16b", "Float32l", "Float32b", "Float64l")
LABELS = "idle=0, busy=1, lost=7"
SCALES = (
    '0.01, "deg"',
    '0.25, "m", offset=3',
    '1 / 64, "rpm"',
    '1e-9, "s"',
    '0.0625, "degC", offset=-40',
)


@dataclass
class Known:
    """A field that expressions may use.

    It has the path from its struct, and whether its values have names.
    """

    path: str
    named: bool = False


@dataclass
class Drawn:
    """A random spec under construction.

    Attributes:
        source: the random generator.
        size: the maximum size.
        levels: the known fields of each enclosing struct, outermost first.
        interpreted: whether to include texts, of which construct alone can read some.
        adapted: whether to include ProcessXor and FocusedSeq.
    """

    source: Random
    size: int
    interpreted: bool
    adapted: bool = False
    levels: list[list[Known]] = field(default_factory=list)
    number: int = 0

    def struct(self, depth: int, *, members: int | None = None) -> str:
        """Return a Struct of some members."""
        self.levels.append([])
        count = members or self.source.randint(1, max(2, self.size - 2 * depth))
        parts = [part for _ in range(count) for part in self.member(depth)]
        self.levels.pop()
        return f"Struct({', '.join(parts)})"

    def member(self, depth: int) -> list[str]:
        """Return a member, or two if the second depends on the first."""
        self.number += 1
        name, kind = f"f{self.number}", self.source.random()
        if kind < 0.4:
            return [f'"{name}" / {self.control(name)}']
        if kind < 0.44:
            return [f"Const({self.source.randbytes(self.source.randint(1, 2))!r})"]
        if kind < 0.52:
            return [f'"{name}" / {self.bits(name)}']
        if kind < 0.58 and depth < 3:
            return [self.draw_struct(name, depth)]
        return [f'"{name}" / {self.part(depth)}']

    def draw_struct(self, name: str, depth: int) -> str:
        """Return a struct whose fields later parts may use, sometimes with a checksum."""
        self.levels.append([])
        parts = [part for _ in range(self.source.randint(1, 3)) for part in self.member(depth + 1)]
        inside = self.levels.pop()
        self.levels[-1] += [Known(f"{name}.{one.path}", one.named) for one in inside]
        if self.source.random() < 0.3:
            algorithm = self.source.choice(("Xor()", "Sum(8)", "Crc(8, 0x4D)"))
            return (
                f'"{name}" / Checksummed(Struct({", ".join(parts)}, "sum" / Int8ub), "sum",'
                f" {algorithm})"
            )
        return f'"{name}" / Struct({", ".join(parts)})'

    def control(self, name: str) -> str:
        """Return an integer that other parts may depend on."""
        word, kind = self.source.choice((*WORDS, *WORDS[:4], *ODD)), self.source.random()
        known = Known(name)
        text = word
        if kind < 0.25:
            known.named, text = True, f"Enum({word}, {LABELS})"
        elif kind < 0.35:
            text = f"Scaled({word}, {self.source.choice(SCALES)})"
        elif kind < 0.4:
            text = f"Default({word}, {self.source.randint(0, 9)})"
        elif kind < 0.46:
            text = f"Const({self.source.randint(0, 100)}, {word})"
        elif kind < 0.5:
            known.named, text = (
                True,
                f'Const("{self.source.choice(("idle", "busy"))}", Enum({word}, {LABELS}))',
            )
        elif kind < 0.53:
            known.named, text = True, f"Enum(Const(1, {word}), {LABELS})"
        elif kind < 0.56 and self.draw_reference() is not None:
            text = f"Rebuild({word}, {self.count()})"
        self.levels[-1].append(known)
        return text

    def part(self, depth: int) -> str:
        """Return a part that no other part depends on."""
        kinds = [self.word, self.word, self.floating, self.string]
        if depth < 3:
            kinds += [self.array, self.array, self.condition, self.switch]
        if self.interpreted:
            kinds += [self.text, self.draw_computed]
        if self.adapted:
            kinds += [self.draw_xor, self.draw_xor, self.draw_focused, self.draw_focused]
        return self.source.choice(kinds)(depth)

    def draw_xor(self, depth: int) -> str:
        key = self.source.choice(("0x55", repr(self.source.randbytes(3))))
        word = self.source.choice(WORDS)
        return self.source.choice(
            (
                f"FixedSized({word}.sizeof(), ProcessXor({key}, {word}))",
                f"FixedSized({self.source.randint(1, 4)}, ProcessXor({key}, GreedyBytes))",
                f"FixedSized({self.count()}, ProcessXor({key}, GreedyBytes))",
                f'FixedSized(7, ProcessXor({key}, Struct("x" / Int24ub, "y" / GreedyBytes)))',
            )
        )

    def draw_focused(self, depth: int) -> str:
        word = self.source.choice(WORDS)
        text = f"Const({self.source.randbytes(1)!r})"
        return self.source.choice(
            (
                f'FocusedSeq("v", {text}, "v" / {word})',
                f'FocusedSeq("v", "v" / Struct("x" / {word}, "y" / {self.bits("")}), {text})',
                f'FocusedSeq("v", {text}, "n" / {COUNT_OF_ARRAY},'
                f' "v" / Array(this.n, {word}), {text})',
            )
        )

    def word(self, depth: int) -> str:
        word, scale = self.source.choice((*WORDS, *ODD)), self.source.choice(SCALES)
        return self.source.choice(
            (word, word, f"Scaled({word}, {scale})", f"Enum({word}, {LABELS})", f"Const(5, {word})")
        )

    def floating(self, depth: int) -> str:
        return self.source.choice(FLOATS)

    def string(self, depth: int) -> str:
        return f"Bytes({self.count() if self.source.random() < 0.5 else self.source.randint(0, 4)})"

    def text(self, depth: int) -> str:
        return self.source.choice(
            (
                "NullTerminated(GreedyBytes)",
                "NullTerminated(GreedyBytes, term=b'\\x07')",
                "Array(2, NullTerminated(GreedyBytes))",
            )
        )

    def draw_computed(self, depth: int) -> str:
        return f"Computed({self.count()})"

    def array(self, depth: int) -> str:
        count = self.count() if self.source.random() < 0.6 else self.source.randint(0, 4)
        return f"Array({count}, {self.element(depth + 1)})"

    def element(self, depth: int) -> str:
        kind = self.source.random()
        if kind < 0.5:
            return self.struct(depth, members=self.source.randint(1, 3))
        if kind < 0.6:
            return self.bits("")
        return self.part(depth)

    def condition(self, depth: int) -> str:
        asked, kind = self.draw_reference(), self.source.random()
        if asked is None:
            return self.word(depth)
        path, known = asked
        tests = [
            f"{path} == 1",
            f"{path} > 100",
            f"{path} & 1",
            f"{path} % 3 == 2",
            f"{self.function(path)} % 2 == 0",
        ]
        if known.named:
            tests = [
                f'{path} == "busy"',
                f'{path} != "idle"',
                f'{self.function(path)} in ("idle", "lost")',
            ]
        test = self.source.choice(tests)
        then = self.element(depth + 1)
        return (
            f"If({test}, {then})"
            if kind < 0.5
            else f"IfThenElse({test}, {then}, {self.element(depth + 1)})"
        )

    def switch(self, depth: int) -> str:
        asked = self.draw_reference()
        if asked is None:
            return self.word(depth)
        path, known = asked
        values: list[Any] = ["idle", "busy", "lost", 2, 1, 9] if known.named else [0, 1, 2, 7, 200]
        keys = self.source.sample(values, self.source.randint(1, 3))
        key = path if known.named or self.source.random() < 0.5 else f"{path} % 3"
        cases = ", ".join(f"{value!r}: {self.element(depth + 1)}" for value in keys)
        default = f", default={self.element(depth + 1)}" if self.source.random() < 0.6 else ""
        return f"Switch({key}, {{{cases}}}{default})"

    def bits(self, name: str) -> str:
        """Return a bit block of whole bytes.

        If the block has a name, later parts may use its integers.
        """
        left, parts = 8 * self.source.randint(1, 4), list[str]()
        order = self.source.choice(("", "", "ByteSwapped", "BitsSwapped"))
        while left:
            self.number += 1
            inner, width, kind = (
                f"b{self.number}",
                self.source.randint(1, min(left, 17)),
                self.source.random(),
            )
            left -= width
            field, known = f"BitsInteger({width})", Known(f"{name}.{inner}")
            if kind < 0.15:
                field = f"BitsInteger({width}, signed=True)"
            elif kind < 0.3 and width > 2:
                field, known.named = f"Enum(BitsInteger({width}), {LABELS})", True
            elif kind < 0.4:
                field = f"Const({self.source.randint(0, (1 << width) - 1)}, BitsInteger({width}))"
            elif kind < 0.5 and width % 2 == 0:
                parts.append(f'"{inner}" / Array(2, {self.few_bits(inner, width // 2)})')
                continue
            elif kind < 0.55 and width == 1:
                field = "Flag"
            if name and self.levels:
                self.levels[-1].append(known)
            parts.append(f'"{inner}" / {field}')
        text = f"BitStruct({', '.join(parts)})"
        return f"{order}({text})" if order else text

    def few_bits(self, name: str, width: int) -> str:
        """Return an element of an array of bits: an integer, two integers, or an array."""
        if width > 2 and self.source.random() < 0.3:
            return f'Struct("{name}x" / BitsInteger({width - 2}), "{name}y" / BitsInteger(2))'
        if width % 2 == 0 and self.source.random() < 0.2:
            return f"Array(2, BitsInteger({width // 2}))"
        return f"BitsInteger({width})"

    def draw_reference(self) -> tuple[str, Known] | None:
        """Return a reference to an earlier field, as written at this position."""
        spots = [(up, one) for up, level in enumerate(reversed(self.levels)) for one in level]
        if not spots:
            return None
        up, known = self.source.choice(spots)
        return f"this.{'_.' * up}{known.path}", known

    def function(self, path: str) -> str:
        """Return a reference as a Python lambda."""
        return f"lambda found: found{path.removeprefix('this')}"

    def count(self) -> str:
        """Return an array's count."""
        asked = self.draw_reference()
        if asked is None:
            return str(self.source.randint(0, 3))
        path, known = asked
        if known.named:
            return f"lambda found: int(found{path.removeprefix('this')}) % 3"
        forms = [
            f"{path} % 4",
            f"{path} & 3",
            f"({path} + 1) // 2 % 5",
            f"{self.function(path)} % 3",
        ]
        return self.source.choice(forms)


def spec(number: int, *, interpreted: bool = False, adapted: bool = False) -> str:
    """Return the text of the spec with this number.

    Args:
        interpreted: whether it may contain texts, of which construct alone can read some.
        adapted: whether it may contain ProcessXor and FocusedSeq.
    """
    seed = f"spec {number} {interpreted}"
    if adapted:
        seed += " adapted"
    return Drawn(Random(seed), 2 + number % 7, interpreted, adapted).struct(0)


def make_struct(text: str) -> construct.Construct:
    """Return the struct that a text describes."""
    return eval(text, NAMES)
