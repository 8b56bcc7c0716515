"""Arithmetic of parameters, as text: numbers, names, ``+ - * / **`` and a few functions."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

MOST_CHARACTERS = 200
MOST_POWER = 64.0
"""An exponent beyond this is refused: such numbers are a mistake."""

BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "abs": abs,
    "cos": math.cos,
    "max": max,
    "min": min,
    "radians": math.radians,
    "sin": math.sin,
    "sqrt": math.sqrt,
}


def names_in(expression: str) -> set[str]:
    """Parameters that an expression needs.

    Raises:
        ValueError: it is no expression of numbers, names and the operators and functions above.
    """
    tree = _parsed(expression)
    functions = {id(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)}
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and id(n) not in functions}
    evaluate(expression, dict.fromkeys(names, 1.0), check_only=True)
    return names


def evaluate(expression: str, values: Mapping[str, float], *, check_only: bool = False) -> float:
    """The value of an expression.

    Args:
        expression: text.
        values: of the names in it.
        check_only: what cannot be computed with these values is no error.

    Raises:
        ValueError: another thing than arithmetic, an unknown name, or no finite result.
    """
    try:
        found = float(_value(_parsed(expression).body, values))
    except (ArithmeticError, OverflowError) as error:
        found, reason = math.nan, str(error)
    else:
        reason = "no finite number"
    if not math.isfinite(found) and not check_only:
        given = ", ".join(f"{k} = {v:g}" for k, v in sorted(values.items()))
        raise ValueError(f"{expression!r} is {reason} with {given}")
    return found


def _parsed(expression: str) -> ast.Expression:
    if len(expression) > MOST_CHARACTERS:
        raise ValueError(f"an expression of {len(expression)} characters; at most 200 are read")
    try:
        return ast.parse(expression.strip(), mode="eval")
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise ValueError(f"{expression!r} is no expression: {error}") from error


def _value(node: ast.expr, values: Mapping[str, float]) -> Any:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name):
        if node.id not in values:
            known = ", ".join(sorted(values)) or "none"
            raise ValueError(f"{node.id!r} is no parameter; there are {known}")
        return values[node.id]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        inner = _value(node.operand, values)
        return -inner if isinstance(node.op, ast.USub) else inner
    if isinstance(node, ast.BinOp):
        return _binary(node, values)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        return _called(node.func.id, [_value(a, values) for a in node.args])
    raise ValueError(
        f"{ast.unparse(node)!r} is not understood; numbers, parameters, + - * / ** and "
        f"{', '.join(FUNCTIONS)} are"
    )


def _binary(node: ast.BinOp, values: Mapping[str, float]) -> float:
    left, right = _value(node.left, values), _value(node.right, values)
    if isinstance(node.op, ast.Pow):
        if abs(right) > MOST_POWER:
            raise ValueError(f"exponent {right:g}; at most {MOST_POWER:g} either way is allowed")
        found = left**right
        if isinstance(found, complex):
            raise ArithmeticError("no real number")
        return float(found)
    if type(node.op) not in BINARY:
        raise ValueError(f"{ast.unparse(node)!r} has an operator other than + - * / **")
    return BINARY[type(node.op)](left, right)


def _called(name: str, arguments: list[float]) -> float:
    if name not in FUNCTIONS:
        raise ValueError(f"function {name!r}; allowed are {', '.join(FUNCTIONS)}")
    try:
        return FUNCTIONS[name](*arguments)
    except TypeError as error:
        raise ValueError(f"{name}: {error}") from error
    except ValueError as error:
        raise ArithmeticError(f"{name}: {error}") from error
