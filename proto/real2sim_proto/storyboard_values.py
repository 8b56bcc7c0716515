"""Values of a storyboard: numbers, parameters, and expressions of them.

An expression is a string that begins with ``$``: ``$gap`` is the parameter of that name, and
``${2 * $gap + 1}`` an expression, with the operators and functions of OpenSCENARIO XML 1.3 (ASAM
2024, section 9.1): ``+ - * / %``, ``== != < <= > >=``, ``and or not``, ``round floor ceil sqrt abs
sign pow min max sin cos tan asin acos atan``, parentheses, numbers, ``true``, ``false``, and pi.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import Field

NAME_PATTERN = r"^[A-Za-z_][A-Za-z0-9_]{0,79}$"

Name = Annotated[str, Field(pattern=NAME_PATTERN)]
"""Name of a parameter or variable."""

Expression = Annotated[str, Field(pattern=r"^\$", max_length=8000)]

Value = Annotated[float, Field(ge=-1e9, le=1e9)] | Expression
"""A number, or an expression of parameters such as ``$gap`` or ``${2 * $gap}``."""

Plain = bool | Annotated[float, Field(ge=-1e15, le=1e15)] | Annotated[str, Field(max_length=1000)]
"""Value of a parameter or variable."""

MAX_DEPTH = 40
"""Maximum nesting of parentheses in an expression."""

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>\$?[A-Za-z_]\w*)"
    r"|(?P<sign>==|!=|<=|>=|[-+*/%()<>,]))"
)
_COMPARE: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_FUNCTIONS: Mapping[str, tuple[int, Callable[..., float]]] = {
    "round": (1, lambda x: math.floor(x + 0.5)),
    "floor": (1, math.floor),
    "ceil": (1, math.ceil),
    "sqrt": (1, math.sqrt),
    "abs": (1, abs),
    "sign": (1, lambda x: math.copysign(1.0, x) if x else 0.0),
    "sin": (1, math.sin),
    "cos": (1, math.cos),
    "tan": (1, math.tan),
    "asin": (1, math.asin),
    "acos": (1, math.acos),
    "atan": (1, math.atan),
    "pow": (2, math.pow),
    "min": (2, min),
    "max": (2, max),
}
_CONSTANTS = {"true": True, "false": False, "pi": math.pi}


def evaluated(text: str, parameters: Mapping[str, Any]) -> Any:
    """Evaluate an expression that begins with ``$``; other strings are returned unchanged.

    Args:
        text: ``$name`` or ``${expression}``.
        parameters: values by name.

    Raises:
        ValueError: an unknown parameter, a syntax error, or a result that is not finite.
    """
    if not text.startswith("$"):
        return text
    if not text.startswith("${"):
        return _parameter(text, parameters)
    if not text.endswith("}"):
        raise ValueError(f"expression {text!r} has no closing brace")
    try:
        value = _Reader(text[2:-1], parameters).read()
    except (ArithmeticError, TypeError) as error:
        raise ValueError(f"expression {text!r} has no value: {error}") from error
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"expression {text!r} has the value {value}")
    return value


def with_values(fields: Any, parameters: Mapping[str, Any]) -> Any:
    """Plain data (maps, lists, strings, numbers) with all expressions evaluated.

    Raises:
        ValueError: see :func:`evaluated`.
    """
    if isinstance(fields, str):
        return evaluated(fields, parameters)
    if isinstance(fields, Mapping):
        return {key: with_values(value, parameters) for key, value in fields.items()}
    if isinstance(fields, list | tuple):
        return [with_values(value, parameters) for value in fields]
    return fields


def _parameter(name: str, parameters: Mapping[str, Any]) -> Any:
    if name[1:] not in parameters:
        known = ", ".join(sorted(parameters)) or "none"
        raise ValueError(f"{name!r} names no parameter; there are: {known}")
    value = parameters[name[1:]]
    if isinstance(value, str) and value.startswith("$"):
        raise ValueError(f"parameter {name[1:]!r} holds {value!r}, an expression of others")
    return value


def _number_if_possible(value: Any) -> Any:
    """Numbers may come as text, in parameters of the type string."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


class _Reader:
    """Recursive descent over the tokens of one expression."""

    def __init__(self, text: str, parameters: Mapping[str, Any]) -> None:
        self._text, self._parameters, self._depth = text, parameters, 0
        self._tokens, self._at = list(self._split()), 0

    def read(self) -> Any:
        value = self._either()
        if self._at < len(self._tokens):
            raise ValueError(f"expression {self._text!r}: {self._tokens[self._at]!r} is too much")
        return value

    def _split(self) -> Any:
        at, text = 0, self._text.rstrip()
        while at < len(text):
            found = _TOKEN.match(text, at)
            if found is None:
                raise ValueError(f"expression {text!r} cannot be read from {text[at:]!r} on")
            yield found.group(found.lastgroup or 0)
            at = found.end()

    def _next(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _take(self, *allowed: str) -> str:
        token = self._next()
        if token and token in allowed:
            self._at += 1
            return token
        return ""

    def _either(self) -> Any:
        value = self._both()
        while self._take("or"):
            other = self._both()
            value = bool(value) or bool(other)
        return value

    def _both(self) -> Any:
        value = self._compared()
        while self._take("and"):
            other = self._compared()
            value = bool(value) and bool(other)
        return value

    def _compared(self) -> Any:
        value = self._sum()
        while sign := self._take(*_COMPARE):
            value = _COMPARE[sign](value, self._sum())
        return value

    def _sum(self) -> Any:
        value = self._product()
        while sign := self._take("+", "-"):
            other = self._product()
            value = value + other if sign == "+" else value - other
        return value

    def _product(self) -> Any:
        value = self._signed()
        while sign := self._take("*", "/", "%"):
            other = self._signed()
            if sign == "*":
                value = value * other
            elif sign == "/":
                value = value / other
            else:
                value = math.fmod(value, other)
        return value

    def _signed(self) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError(f"expression {self._text!r} is nested deeper than {MAX_DEPTH}")
        if sign := self._take("-", "+", "not"):
            value = self._signed()
            found = -value if sign == "-" else not value if sign == "not" else value
        else:
            found = self._atom()
        self._depth -= 1
        return found

    def _atom(self) -> Any:
        token = self._next()
        self._at += 1
        if token == "(":
            value = self._either()
            self._close()
            return value
        if token.startswith("$"):
            return _number_if_possible(_parameter(token, self._parameters))
        if token in _CONSTANTS:
            return _CONSTANTS[token]
        if token in _FUNCTIONS:
            return self._call(token)
        try:
            return float(token)
        except ValueError:
            raise ValueError(
                f"expression {self._text!r}: {token or 'its end'!r} is not a number, parameter or "
                f"function; functions are {', '.join(sorted(_FUNCTIONS))}"
            ) from None

    def _call(self, name: str) -> float:
        count, function = _FUNCTIONS[name]
        if not self._take("("):
            raise ValueError(f"expression {self._text!r}: {name} needs its arguments in ( )")
        arguments = [self._either()]
        while self._take(","):
            arguments.append(self._either())
        self._close()
        if len(arguments) != count:
            raise ValueError(f"expression {self._text!r}: {name} takes {count} arguments")
        try:
            return float(function(*arguments))
        except ValueError as error:
            raise ValueError(f"expression {self._text!r}: {name} of {arguments}: {error}") from None

    def _close(self) -> None:
        if not self._take(")"):
            raise ValueError(f"expression {self._text!r} lacks a closing parenthesis")
