"""Parses the text of a program that XLA has optimised, ``compiled.as_text()``."""

import contextlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import Any

BITS = {"pred": 8, "s4": 4, "u4": 4, "f4e2m1fn": 4, "token": 0, "opaque": 0, "c64": 64, "c128": 128}
HOST = 5  # the memory space of arrays that are kept in the host's memory

_COMPUTATION = re.compile(r"^(ENTRY )?%?(\S+) \(.*\{$")
_INSTRUCTION = re.compile(r"^\s+(ROOT )?%?(\S+) = ")
_ARRAY = re.compile(r"(\w+)\[([\d,<=]*)\](?:\{([\d,]*)(?::([^}]*))?\})?")
_COMMENT = re.compile(r"/\*.*?\*/")


@dataclass(frozen=True)
class Array:
    """An array of the program.

    Attributes:
        order: its axes from the most minor one; empty for the default order.
        tile: sizes to which a TPU pads the most minor axes, the last one for the most minor axis.
        space: the memory space; 0 is the device's main memory.
    """

    dtype: str
    dims: tuple[int, ...]
    order: tuple[int, ...] = ()
    tile: tuple[int, ...] = ()
    space: int = 0

    @property
    def size(self) -> int:
        """The number of elements."""
        return prod(self.dims)

    @property
    def bytes(self) -> int:
        """Bytes in memory, with padding."""
        dims = [self.dims[axis] for axis in self.order] or list(reversed(self.dims))
        for axis, step in zip(range(len(dims)), reversed(self.tile), strict=False):
            dims[axis] = -(-dims[axis] // step) * step
        return prod(dims) * bits(self.dtype) // 8


@dataclass(frozen=True)
class Instruction:
    """An instruction: ``name = arrays opcode(operands), attributes``.

    Attributes:
        arrays: the results, one unless the result is a tuple; nested tuples are flat.
        argument: the text between the parentheses.
        operands: names of the instructions that it reads.
        op_name: the path of the operation in the traced Python program.
    """

    name: str
    arrays: tuple[Array, ...]
    opcode: str
    argument: str
    operands: tuple[str, ...]
    attributes: str

    @cached_property
    def op_name(self) -> str:
        match = re.search(r'op_name="((?:[^"\\]|\\.)*)"', self.attributes)
        if match is None:
            return ""
        return match[1].replace("\\'", "'")

    @cached_property
    def called(self) -> tuple[str, ...]:
        """Names of the computations that it calls, without those that only combine elements (``to_apply``)."""
        pattern = r"\b(?:calls|body|branch_computations|true_computation|false_computation)=(\{[^}]*\}|%?[\w.\-]+)"
        groups = re.findall(pattern, self.attributes.partition(", metadata=")[0])
        if self.opcode == "call":
            groups = re.findall(r"\bto_apply=(%?[\w.\-]+)", self.attributes)
        return tuple(name for group in groups for name in re.findall(r"[\w.\-]+", group))

    def attribute(self, name: str) -> str:
        """Returns the text of an attribute, without braces; "" without it."""
        match = re.search(rf"\b{name}=(?:\{{([^}}]*)\}}|([^\s,]+))", self.attributes)
        if match is None:
            return ""
        return match[1] or match[2] or ""

    def integers(self, name: str) -> tuple[int, ...]:
        """Returns the numbers in an attribute."""
        return tuple(map(int, re.findall(r"\d+", self.attribute(name))))

    @cached_property
    def backend_config(self) -> dict[str, Any]:
        """The backend's settings; {} if they are not JSON."""
        text = self.attributes.partition("backend_config=")[2]
        with contextlib.suppress(json.JSONDecodeError):
            return json.JSONDecoder().raw_decode(text)[0]
        return {}


@dataclass
class Computation:
    """Instructions by name, in the order of execution."""

    name: str
    instructions: dict[str, Instruction] = field(default_factory=dict)
    root: str = ""

    def __iter__(self) -> Iterator[Instruction]:
        return iter(self.instructions.values())

    def __getitem__(self, name: str) -> Instruction:
        return self.instructions[name]

    @cached_property
    def parameters(self) -> dict[int, Instruction]:
        """The parameters by number."""
        return {int(one.argument): one for one in self if one.opcode == "parameter"}

    @cached_property
    def users(self) -> dict[str, list[Instruction]]:
        """The instructions that read each instruction."""
        users: dict[str, list[Instruction]] = {name: [] for name in self.instructions}
        for one in self:
            for operand in dict.fromkeys(one.operands):
                users[operand].append(one)
        return users


@dataclass(frozen=True)
class Module:
    """A program: its computations by name, and the name of the one where it starts."""

    computations: dict[str, Computation]
    entry: str

    def __getitem__(self, name: str) -> Computation:
        return self.computations[name]


def parse(text: str) -> Module:
    """Parses a program.

    Raises:
        ValueError: the text has no entry computation, so it is not a program.
    """
    computations: dict[str, Computation] = {}
    entry = ""
    current: Computation | None = None
    for line in text.splitlines():
        if current is None:
            header = _COMPUTATION.match(line)
            if header:
                current = computations.setdefault(header[2], Computation(header[2]))
                if header[1]:
                    entry = current.name
        elif line.startswith("}"):  # an execution thread may follow
            current = None
        else:
            start = _INSTRUCTION.match(line)
            if start is None:
                continue
            definition = line[start.end() :]
            end = definition.index(" ")
            if definition.startswith("("):
                end = _closing(definition)
            shape = definition[:end]
            opcode, _, rest = definition[end:].strip().partition("(")
            close = _closing("(" + rest) - 1
            argument = rest[: close - 1]
            operands = []
            if opcode != "constant":
                operands = re.findall(r"%([^\s,()]+)", _COMMENT.sub("", argument))
            one = Instruction(start[2], arrays(shape), opcode, argument, tuple(operands), rest[close:])
            current.instructions[one.name] = one
            if start[1]:
                current.root = one.name
    if not entry:
        raise ValueError("the text is not a program of XLA: it has no entry computation")
    return Module(computations, entry)


def bits(dtype: str) -> int:
    """Returns the bits of an element."""
    if dtype in BITS:
        return BITS[dtype]
    return int(re.sub(r"e\d.*", "", dtype).lstrip("bfsuc") or 8)  # f8e4m3fn has 8


def arrays(text: str) -> tuple[Array, ...]:
    """Parses the arrays of a shape; a tuple's are flat."""
    parsed = []
    for match in _ARRAY.finditer(_COMMENT.sub("", text)):
        layout = match[4] or ""
        tile = re.search(r"T\(([\d,]*)\)", layout)
        space = re.search(r"S\((\d+)\)", layout)
        array = Array(
            dtype=match[1],
            dims=_numbers(match[2]),
            order=_numbers(match[3]),
            tile=_numbers(tile and tile[1]),
            space=sum(_numbers(space and space[1])),
        )
        parsed.append(array)
    return tuple(parsed)


def _numbers(text: str | None) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", text or "")))


def _closing(text: str) -> int:
    """Returns the position after the parenthesis that closes the one at the start of ``text``."""
    depth = 0
    for match in re.finditer(r"[()]", text):
        depth += {"(": 1, ")": -1}[match[0]]
        if depth == 0:
            return match.end()
    return len(text)
