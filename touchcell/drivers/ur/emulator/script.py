"""Straight-line URScript: programs of one statement after another, without variables, branches or loops.

Enough for paths that ur-rtde injects into its program and for short scripts sent to the script ports. A script that
needs more is refused with the line that does. Source: Universal Robots, "The URScript Programming Language for
e-Series".
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose literal ``p[x, y, z, rx, ry, rz]``, m and rotation vector."""

    vector: Array


Argument = float | str | Array | Pose
"""Value of an argument."""


@dataclass(frozen=True, slots=True)
class Statement:
    """One call: name of the function and its arguments by parameter name."""

    name: str
    arguments: Mapping[str, Argument]


class ScriptError(Exception):
    """A script is not understood; the message has the line and the reason."""


PARAMETERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "movej": ("q", "a", "v", "t", "r"),
        "movel": ("pose", "a", "v", "t", "r"),
        "movep": ("pose", "a", "v", "r"),
        "stopj": ("a",),
        "stopl": ("a",),
        "speedl": ("xd", "a", "t"),
        "speedj": ("qd", "a", "t"),
        "sleep": ("t",),
        "sync": (),
        "textmsg": ("s1", "s2"),
        "set_tcp": ("pose",),
        "set_payload": ("m", "cog"),
        "zero_ftsensor": (),
        "protective_stop": (),
        "set_digital_out": ("n", "b"),
        "set_standard_digital_out": ("n", "b"),
        "set_configurable_digital_out": ("n", "b"),
        "set_tool_digital_out": ("n", "b"),
        "write_output_integer_register": ("address", "value"),
        "write_output_float_register": ("address", "value"),
        "signal_async_progress": ("value",),
    }
)
"""Functions that are emulated, with their parameters."""

_HEAD = re.compile(r"(def|sec) +(\w+)\(\):")


def parse_program(text: str) -> tuple[Statement, ...]:
    """Return the statements of ``def name(): ... end``, or of the single line that a script port takes too.

    Raises:
        ScriptError: a line is not understood.
    """
    lines = text.strip().splitlines()
    if lines and _HEAD.fullmatch(lines[0].strip()):
        if lines[-1].strip() != "end":
            raise ScriptError(f"line {len(lines)}: the program has no end")
        lines = lines[1:-1]
    return tuple(parse_lines(lines))


def parse_lines(lines: Sequence[str]) -> Iterator[Statement]:
    """Yield the statement of each line. Raises ScriptError."""
    for number, line in enumerate(lines, start=1):
        code = line.partition("#")[0].strip()
        if code:
            try:
                yield _statement(code)
            except (SyntaxError, ValueError, TypeError) as error:
                raise ScriptError(f"line {number}, {code!r}: {error}") from None


def _statement(code: str) -> Statement:
    call = ast.parse(re.sub(r"\bp\[", "p_[", code), mode="eval").body
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
        raise ValueError("is not a call; variables, branches and loops are not emulated")
    name = call.func.id
    if name not in PARAMETERS:
        raise ValueError(f"{name} is not emulated")
    parameters = PARAMETERS[name]
    if len(call.args) > len(parameters):
        raise ValueError(f"{name} takes {len(parameters)} arguments")
    given = {parameter: _value(node) for parameter, node in zip(parameters, call.args, strict=False)}
    for keyword in call.keywords:
        if keyword.arg not in parameters or keyword.arg in given:
            raise ValueError(f"{name} has no argument {keyword.arg}, or it is given twice")
        given[keyword.arg] = _value(keyword.value)
    return Statement(name, given)


def _value(node: ast.expr) -> Argument:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.Name) and node.id in ("True", "False"):
        return float(node.id == "True")
    if isinstance(node, ast.List):
        return np.array([_number(each) for each in node.elts], dtype=np.float64)
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id == "p_":
        elements = node.slice.elts if isinstance(node.slice, ast.Tuple) else []
        vector = np.array([_number(each) for each in elements], dtype=np.float64)
        if vector.shape != (6,):
            raise ValueError("a pose has six numbers")
        return Pose(vector)
    return _number(node)


def _number(node: ast.expr) -> float:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        value = _number(node.operand)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        left, right = _number(node.left), _number(node.right)
        return left + right if isinstance(node.op, ast.Add) else left - right
    raise ValueError(f"{ast.unparse(node)} is not a number")
