"""The kernels' source text: constants and functions shared with the CPU, translated to C++.

Functions marked by ``numerics.device_function`` use a small subset of Python: numbers, tuples of
numbers, rows of arrays that are read or added to, ``if``, ``for`` over a range, ``while``, and
calls of such functions. All floating point numbers have one type, chosen by the caller; integers
stay integers. The translator rejects anything else with its name and line, so errors show up at
compile time.
"""

from __future__ import annotations

import ast
import functools
import inspect
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ... import contact, numerics, stress

# The translator.

Kind = str | tuple[Any, ...]
"""``real``, ``int``, ``bool``, ``rows`` (read-only), ``row`` (read and written), ``void``, or a
tuple."""

_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "/"}
_OPERATORS |= {ast.Mod: "%"}
_COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_FUNCTIONS = {"sqrt": "root", "log": "logarithm", "exp": "exponential", "copysign": "signed_as"}


class Untranslatable(TypeError):
    """A function uses Python that the translator does not support."""


@dataclass(frozen=True)
class Value:
    """A C++ expression and its kind."""

    text: str
    kind: Kind


class Translator:
    """Collects functions together with their callees.

    Args:
        real: C++ type of floating point numbers.
        prefix: prefix of the names of tuple types.
    """

    def __init__(self, real: str, prefix: str) -> None:
        self.real = real
        self._prefix = prefix
        self._made: dict[tuple[Any, tuple[Kind, ...]], tuple[str, Kind]] = {}
        self._structures: dict[tuple[Kind, ...], str] = {}
        self._tables: dict[int, str] = {}
        self._text: list[str] = []

    @property
    def text(self) -> str:
        """The collected text, in an order that compiles."""
        return "\n".join(self._text)

    def add(self, function: Callable[..., Any], kinds: Sequence[Kind]) -> tuple[str, Kind]:
        """Translate a function for arguments of these kinds; return its name and result kind.

        Raises:
            Untranslatable: with the position of the unsupported code.
        """
        key = (function, tuple(kinds))
        if key not in self._made:
            self._made[key] = _Function(self, function, key[1]).translated()
        return self._made[key]

    def type_of(self, kind: Kind) -> str:
        """C++ type of a kind."""
        if isinstance(kind, tuple):
            if all(part == "real" for part in kind):
                return f"Numbers<{self.real}, {len(kind)}>"
            return self._structure(kind)
        names = {"real": self.real, "rows": f"const {self.real}*", "row": f"{self.real}*"}
        return names.get(kind, kind)

    def table(self, values: Any) -> str:
        """Name of a constant array."""
        if id(values) not in self._tables:
            name = f"{self._prefix}table_{len(self._tables)}"
            numbers = ", ".join(repr(float(v)) for v in values)
            head = f"__device__ const {self.real} {name}[{len(values)}]"
            self._text.append("\n".join([f"{head} = {{", *textwrap.wrap(numbers, 96), "};"]))
            self._tables[id(values)] = name
        return self._tables[id(values)]

    def write(self, text: str) -> None:
        """Add the text of a function whose callees have been added."""
        self._text.append(text)

    def _structure(self, kind: tuple[Kind, ...]) -> str:
        if kind not in self._structures:
            fields = "".join(f" {self.type_of(part)} at{n};" for n, part in enumerate(kind))
            name = f"{self._prefix}tuple_{len(self._structures)}"
            self._structures[kind] = name
            self._text.append(f"struct {name} {{{fields} }};")
        return self._structures[kind]


class _Function:
    """One function, for arguments of given kinds."""

    def __init__(self, owner: Translator, function: Any, kinds: tuple[Kind, ...]) -> None:
        self._owner = owner
        self._function = function
        source = textwrap.dedent(inspect.getsource(function))
        node = ast.parse(source).body[0]
        assert isinstance(node, ast.FunctionDef)
        self._node = node
        self._names = [argument.arg for argument in node.args.args]
        if len(self._names) != len(kinds):
            raise self._refused(node, f"{len(kinds)} arguments")
        self._arguments = dict(zip(self._names, kinds, strict=True))
        self._kinds: dict[str, Kind] = dict(self._arguments)
        # A name that holds values of two kinds becomes two variables.
        self._now: dict[str, str] = {}
        self._returned: Kind = "void"
        self._lines: list[str] = []
        self._depth = 0
        self._temporaries = 0

    def translated(self) -> tuple[str, Kind]:
        # Kinds of variables are found by reading the code twice, enough for these functions.
        before: Any = None
        while before != (before := (dict(self._kinds), self._returned)):
            self._lines, self._temporaries, self._depth, self._now = [], 0, 1, {}
            self._local: set[str] = set()
            self._block(self._node.body)
        owner, name = self._owner, self._node.name
        given = ", ".join(f"{owner.type_of(self._kinds[n])} {n}" for n in self._names)
        local = [
            f"    {owner.type_of(kind)} {name}{{}};"
            for name, kind in self._kinds.items()
            if name in self._local
        ]
        head = f"__device__ __forceinline__ {owner.type_of(self._returned)} {name}({given}) {{"
        owner.write("\n".join([head, *local, *self._lines, "}"]))
        return name, self._returned

    def _refused(self, node: ast.AST, what: str) -> Untranslatable:
        line = self._function.__code__.co_firstlineno + getattr(node, "lineno", 1) - 1
        where = f"{self._function.__module__}.{self._function.__name__}, line {line}"
        return Untranslatable(f"{where}: kernels do not know {what}")

    def _say(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)

    def _block(self, statements: Sequence[ast.stmt]) -> None:
        for statement in statements:
            self._statement(statement)

    def _inner(self, head: str, statements: Sequence[ast.stmt]) -> None:
        self._say(f"{head} {{")
        self._depth += 1
        before = dict(self._now)
        self._block(statements)
        # A branch that returns does not affect the variables after it.
        if isinstance(statements[-1], ast.Return):
            self._now = before
        self._depth -= 1
        self._say("}")

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Expr(value=ast.Constant()) | ast.Pass():
                pass
            case ast.Expr(value=value):
                self._say(f"{self._value(value).text};")
            case ast.Assign(targets=[target], value=value):
                self._assign(target, self._value(value))
            case ast.AugAssign(target=target, op=op, value=value):
                self._assign(target, self._value(ast.BinOp(self._read(target), op, value)))
            case ast.Return(value=None):
                self._say("return;")
            case ast.Return(value=value):
                assert value is not None
                found = self._value(value)
                self._returned = self._both(node, self._returned, found.kind)
                self._say(f"return {self._as(found, self._returned)};")
            case ast.If(test=test, body=body, orelse=orelse):
                self._inner(f"if ({self._value(test).text})", body)
                if orelse:
                    self._inner("else", orelse)
            case ast.For(target=ast.Name(id=name), iter=ast.Call(args=args), body=body):
                self._for(node, name, [self._value(a) for a in args], body)
            case ast.While(test=test, body=body):
                self._inner(f"while ({self._value(test).text})", body)
            case ast.Break():
                self._say("break;")
            case _:
                raise self._refused(node, f"this statement: {ast.unparse(node)}")

    def _for(self, node: ast.stmt, name: str, ends: list[Value], body: list[ast.stmt]) -> None:
        assert isinstance(node, ast.For)
        assert isinstance(node.iter, ast.Call)
        if ast.unparse(node.iter.func) != "range" or len(ends) > 2 or node.orelse:
            raise self._refused(node, "loops that are not over range(end) or range(first, end)")
        first = ends[0].text if len(ends) == 2 else "0"
        self._inner(f"for (int {name} = {first}; {name} < {ends[-1].text}; ++{name})", body)

    @staticmethod
    def _read(target: ast.expr) -> ast.expr:
        read = ast.parse(ast.unparse(target), mode="eval").body
        return ast.copy_location(read, target)

    def _assign(self, target: ast.expr, value: Value) -> None:
        match target:
            case ast.Name(id="_"):
                return
            case ast.Name(id=name):
                variable, kind = self._variable(name, value.kind)
                self._say(f"{variable} = {self._as(value, kind)};")
            case ast.Subscript():
                self._say(f"{self._value(target).text} = {value.text};")
            case ast.Tuple(elts=parts) if isinstance(value.kind, tuple):
                self._temporaries += 1
                held = f"held_{self._temporaries}"
                self._say(f"const {self._owner.type_of(value.kind)} {held} = {value.text};")
                for n, part in enumerate(parts):
                    self._assign(part, self._part(Value(held, value.kind), n))
            case _:
                raise self._refused(target, f"this assignment to {ast.unparse(target)}")

    def _variable(self, name: str, kind: Kind) -> tuple[str, Kind]:
        """The variable that a name refers to from here on, and its kind."""
        for number in range(9):
            variable = f"{name}_{number}" if number else name
            try:
                held = self._both(self._node, self._kinds.get(variable, kind), kind)
            except Untranslatable:
                continue
            self._kinds[variable], self._now[name] = held, variable
            if variable not in self._arguments:
                self._local.add(variable)
            return variable, held
        raise self._refused(self._node, f"this number of kinds of {name}")

    def _both(self, node: ast.AST, one: Kind, other: Kind) -> Kind:
        """A kind that holds values of either kind."""
        if one in {other, "void"}:
            return other
        if {one, other} <= {"real", "int", "bool"}:
            return "real" if "real" in {one, other} else "int"
        if isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other):
            return tuple(self._both(node, a, b) for a, b in zip(one, other, strict=True))
        raise self._refused(node, f"one variable for {one} and {other}")

    def _as(self, value: Value, kind: Kind) -> str:
        if value.kind == kind:
            return value.text
        if isinstance(kind, tuple):
            parts = [self._as(self._part(value, n), part) for n, part in enumerate(kind)]
            return f"{self._owner.type_of(kind)}{{{', '.join(parts)}}}"
        return f"{self._owner.type_of(kind)}({value.text})"

    def _part(self, value: Value, n: int) -> Value:
        assert isinstance(value.kind, tuple)
        flat = all(part == "real" for part in value.kind)
        return Value(f"{value.text}[{n}]" if flat else f"{value.text}.at{n}", value.kind[n])

    def _value(self, node: ast.expr) -> Value:
        found = self._plain(node) or self._composed(node)
        if found is None:
            raise self._refused(node, f"this expression: {ast.unparse(node)}")
        return found

    def _plain(self, node: ast.expr) -> Value | None:
        """Numbers, names, and their elements."""
        found = None
        match node:
            case ast.Constant(value=value):
                found = self._constant(node, value)
            case ast.Name(id=name) if name in self._kinds:
                variable = self._now.get(name, name)
                found = Value(variable, self._kinds[variable])
            case ast.Name(id=name) if name in self._function.__globals__:
                found = self._constant(node, self._function.__globals__[name])
            case ast.Name(id=name):
                found = Value(name, "int")  # Loop variable.
            case ast.Attribute(attr="inf"):
                found = Value("INFINITE", "real")
            case ast.Tuple(elts=parts):
                found = self._tuple([self._value(part) for part in parts])
            case ast.Subscript(value=of, slice=index):
                found = self._subscript(node, self._value(of), self._value(index))
        return found

    def _composed(self, node: ast.expr) -> Value | None:
        """Operators, calls and other compound expressions."""
        found = None
        match node:
            case ast.UnaryOp(op=op, operand=operand):
                found = self._signed(op, self._value(operand))
            case ast.BinOp(left=left, op=op, right=right):
                found = self._binary(node, self._value(left), op, self._value(right))
            case ast.BoolOp(op=op, values=values):
                joint = " && " if isinstance(op, ast.And) else " || "
                found = Value(f"({joint.join(self._value(v).text for v in values)})", "bool")
            case ast.Compare(left=left, ops=ops, comparators=others):
                found = self._compared(ops, [self._value(side).text for side in (left, *others)])
            case ast.IfExp(test=test, body=body, orelse=orelse):
                found = self._chosen(node, *(self._value(part) for part in (test, body, orelse)))
            case ast.Call(func=function, args=args, keywords=[]):
                found = self._call(node, function, [self._value(a) for a in args])
        return found

    @staticmethod
    def _signed(op: ast.unaryop, value: Value) -> Value:
        if isinstance(op, ast.Not):
            return Value(f"!{value.text}", "bool")
        return Value(f"-{value.text}" if isinstance(op, ast.USub) else value.text, value.kind)

    @staticmethod
    def _compared(ops: Sequence[ast.cmpop], sides: list[str]) -> Value:
        each = [f"{sides[n]} {_COMPARED[type(op)]} {sides[n + 1]}" for n, op in enumerate(ops)]
        return Value(f"({' && '.join(each)})", "bool")

    def _chosen(self, node: ast.expr, test: Value, one: Value, other: Value) -> Value:
        kind = self._both(node, one.kind, other.kind)
        return Value(f"({test.text} ? {self._as(one, kind)} : {self._as(other, kind)})", kind)

    def _constant(self, node: ast.expr, value: Any) -> Value:
        if isinstance(value, bool):
            return Value(str(value).lower(), "bool")
        if isinstance(value, int):
            return Value(str(value), "int")
        if isinstance(value, float | np.floating):
            number = repr(float(value)) if math.isfinite(value) else "INFINITE"
            return Value(f"{self._owner.real}({number})", "real")
        if isinstance(value, np.ndarray):
            return Value(self._owner.table(value), "rows")
        raise self._refused(node, f"{ast.unparse(node)}, which is {type(value).__name__}")

    def _tuple(self, parts: list[Value]) -> Value:
        kind = tuple(part.kind for part in parts)
        return Value(f"{self._owner.type_of(kind)}{{{', '.join(p.text for p in parts)}}}", kind)

    def _subscript(self, node: ast.Subscript, of: Value, index: Value) -> Value:
        if of.kind in {"row", "rows"}:
            return Value(f"{of.text}[{index.text}]", "real")
        if isinstance(of.kind, tuple) and all(part == "real" for part in of.kind):
            return Value(f"{of.text}[{index.text}]", "real")
        if isinstance(of.kind, tuple) and index.text.isdecimal():
            return self._part(of, int(index.text))
        raise self._refused(node, f"this index: {ast.unparse(node)}")

    def _binary(self, node: ast.expr, a: Value, op: ast.operator, b: Value) -> Value:
        kind = self._both(node, a.kind, b.kind)
        if isinstance(op, ast.Pow):
            if b.text == "2":
                return Value(f"squared({a.text})", a.kind)
            return Value(f"power({a.text}, {b.text})", "real")
        if type(op) not in _OPERATORS or kind not in {"real", "int"}:
            raise self._refused(node, f"this operation: {ast.unparse(node)}")
        if isinstance(op, ast.Div):
            a, kind = Value(self._as(a, "real"), "real"), "real"
        return Value(f"({a.text} {_OPERATORS[type(op)]} {b.text})", kind)

    def _call(self, node: ast.expr, function: ast.expr, args: list[Value]) -> Value:
        name = ast.unparse(function)
        if name in {"int", "float", "F32"}:
            kind = "int" if name == "int" else "real"
            return Value(f"{self._owner.type_of(kind)}({args[0].text})", kind)
        if name == "abs":
            return Value(f"magnitude({args[0].text})", args[0].kind)
        if name in {"min", "max"}:
            return self._extreme(node, "least" if name == "min" else "greatest", args)
        if name.startswith("math.") and name[5:] in _FUNCTIONS:
            given = ", ".join(self._as(a, "real") for a in args)
            return Value(f"{_FUNCTIONS[name[5:]]}({given})", "real")
        called = self._function.__globals__.get(name)
        if not inspect.isfunction(called):
            raise self._refused(node, f"the function {name}")
        made, returned = self._owner.add(called, [a.kind for a in args])
        return Value(f"{made}({', '.join(a.text for a in args)})", returned)

    def _extreme(self, node: ast.expr, made: str, args: list[Value]) -> Value:
        kind = functools.reduce(lambda a, b: self._both(node, a, b), (a.kind for a in args))
        text = functools.reduce(lambda a, b: f"{made}({a}, {b})", (self._as(a, kind) for a in args))
        return Value(text, kind)


FOLDER = Path(__file__).parent / "kernels"
SOURCE = FOLDER / "solver.cu"
KERNELS = (
    "begin_run",
    "find_keys",
    "count_digits",
    "sum_digits",
    "scatter_digits",
    "reorder",
    "mark_blocks",
    "add_pieces",
    "sum_pieces",
    "spread_sums",
    "fill_blocks",
    "mark_fields",
    "fill_fields",
    "link_fields",
    "mark_lists",
    "fill_lists",
    "find_near",
    "advance_blocks",
    "advance_obstructed",
    "collect_fields",
    "measure_blocks",
    "measure_bodies",
    "sum_contacts",
    "add_totals",
)
PRECISIONS = {"single": "float", "double": "double"}
_THREE: Kind = ("real",) * 3
_SIX: Kind = ("real",) * 6
_NINE: Kind = ("real",) * 9
_CONSTANTS = {
    stress: ("LAW", "MU", "LAMBDA", "VISCOSITY", "PLASTIC", "MATERIAL_ROW"),
    contact: ("KIND", "HEIGHT_FIELD", "THIN", "COLLIDER_ROW"),
}


@functools.cache
def solver_source(precision: str) -> str:
    """C++ of all kernels for a precision, ``single`` or ``double``; includes files of FOLDER."""
    constants = [
        f"constexpr unsigned {name} = {getattr(module, name)};"
        for module, names in _CONSTANTS.items()
        for name in names
    ]
    parts = [
        f"typedef {PRECISIONS[precision]} real;",
        '#include "numbers.h"',
        *constants,
        f"namespace laws {{\n{_laws()}\n}}",
        f"namespace contact {{\n{_contact()}\n}}",
        SOURCE.read_text(encoding="ascii"),
    ]
    return "\n".join(parts)


def _laws() -> str:
    """Functions of one particle, in the precision of the state."""
    made = Translator("real", "law_")
    made.add(stress.stress_update, (_NINE, "real", "rows", "real"))
    made.add(stress.add_viscosity, (_SIX, _NINE, "real", "real"))
    made.add(stress.advance_gradient, (_NINE, _NINE, "real"))
    made.add(stress.wave_hardening, ("real", "rows"))
    made.add(numerics.spline_weights, ("real",))
    return made.text


def _contact() -> str:
    """Functions of one node, or of one particle near a thin collider, in double precision."""
    made = Translator("double", "contact_")
    place: tuple[Kind, ...] = ("rows", "rows", "real", "real", _THREE, "row", "rows", "row")
    made.add(contact.resolve_node_collider, place)
    pair: tuple[Kind, ...] = ("row", "row", "rows", "rows", "real", "real", _THREE, "row", "row")
    made.add(contact.resolve_node_pair, pair)
    made.add(contact.pair_friction, ("real", "real"))
    touch: list[Kind] = ["rows", "real", "real", "real", _THREE, _THREE, "real", "row"]
    wide = "heights" in inspect.signature(contact.resolve_particle_collider).parameters
    if wide:
        touch.insert(1, "rows")
    made.add(contact.resolve_particle_collider, touch)
    given = "row, heights, " if wide else "row, "
    macro = (
        f"#define TOUCH_PARTICLE(row, heights, ...) resolve_particle_collider({given}__VA_ARGS__)"
    )
    return f"{made.text}\n{macro}"
