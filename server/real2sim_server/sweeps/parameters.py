"""Parameters of a space, their expressions, and sampling of points."""

from __future__ import annotations

import ast
import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from real2sim_proto.sweeps import (
    MAX_POINTS,
    ChoiceParameter,
    DerivedParameter,
    FloatParameter,
    GridMethod,
    ImportanceMethod,
    IntParameter,
    NormalParameter,
    ParameterName,
    ParameterValue,
    SpreadMethod,
)

# --- Expressions ---------------------------------------------------------------------------------

# Numbers, names, ``+ - * / **`` and a few functions.

MAX_CHARACTERS = 200
MAX_POWER = 64.0
"""Maximum exponent; larger ones are rejected as mistakes."""

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
    """Parameters used in an expression.

    Raises:
        ValueError: not an expression of numbers, names and the operators and functions above.
    """
    tree = _parsed(expression)
    functions = {id(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)}
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and id(n) not in functions}
    evaluate(expression, dict.fromkeys(names, 1.0), check_only=True)
    return names


def evaluate(expression: str, values: Mapping[str, float], *, check_only: bool = False) -> float:
    """The value of an expression.

    Args:
        expression: the expression.
        values: values of its names.
        check_only: whether to ignore errors caused by these values.

    Raises:
        ValueError: not arithmetic, an unknown name, or a result that is not finite.
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
    if len(expression) > MAX_CHARACTERS:
        raise ValueError(f"an expression of {len(expression)} characters; at most 200 are read")
    try:
        return ast.parse(expression.strip(), mode="eval")
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise ValueError(f"{expression!r} is not an expression: {error}") from error


def _value(node: ast.expr, values: Mapping[str, float]) -> Any:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name):
        if node.id not in values:
            known = ", ".join(sorted(values)) or "none"
            raise ValueError(f"{node.id!r} is not a parameter; there are {known}")
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
        if abs(right) > MAX_POWER:
            raise ValueError(f"exponent {right:g}; at most {MAX_POWER:g} either way is allowed")
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


Value = ParameterValue
Name = ParameterName


class FloatRange(FloatParameter):
    """Uniform between two numbers, or log-uniform."""

    def at(self, u: float) -> float:
        """The value at a coordinate."""
        if self.log:
            return float(self.low * (self.high / self.low) ** u)
        return self.low + (self.high - self.low) * u

    def coordinate(self, value: Any) -> float:
        """Coordinate of a value."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (float(value) - self.low) / (self.high - self.low)

    def levels(self, count: int) -> list[float]:
        """Coordinates of a grid with ``count`` values, including the ends."""
        return [k / (count - 1) for k in range(count)] if count > 1 else [0.5]


class IntRange(IntParameter):
    """Uniform integers from ``low`` to ``high``, both included."""

    def at(self, u: float) -> int:
        """The value at a coordinate."""
        count = self.high - self.low + 1
        return self.low + min(int(u * count), count - 1)

    def coordinate(self, value: Any) -> float:
        """Coordinate of the middle of a value's interval."""
        return (int(value) - self.low + 0.5) / (self.high - self.low + 1)

    def levels(self, count: int) -> list[float]:
        """Coordinates of a grid."""
        most = self.high - self.low + 1
        values = [self.low + round(k * (most - 1) / max(count - 1, 1)) for k in range(count)]
        return [self.coordinate(v) for v in dict.fromkeys(values)]


class Choice(ChoiceParameter):
    """Uniform choice from a list."""

    def at(self, u: float) -> Value:
        """The value at a coordinate."""
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]

    def coordinate(self, value: Any) -> float:
        """Coordinate of the middle of a value's interval."""
        return (self.values.index(value) + 0.5) / len(self.values)

    def levels(self, count: int) -> list[float]:
        """Coordinates of all values, regardless of ``count``."""
        return [(k + 0.5) / len(self.values) for k in range(len(self.values))]


class Normal(NormalParameter):
    """Normal distribution, truncated at ``low`` and ``high``."""

    def at(self, u: float) -> float:
        """The value at a coordinate, which is the value's cumulative probability."""
        from scipy.special import ndtr, ndtri

        low, high = (ndtr((x - self.mean) / self.std) for x in (self.low, self.high))
        value = self.mean + self.std * float(ndtri(low + (high - low) * u))
        return min(max(value, self.low), self.high)

    def coordinate(self, value: Any) -> float:
        """Coordinate of a value: its cumulative probability."""
        from scipy.special import ndtr

        low, high, x = (
            float(ndtr((v - self.mean) / self.std)) for v in (self.low, self.high, value)
        )
        return (x - low) / (high - low)

    def levels(self, count: int) -> list[float]:
        """Coordinates of a grid, in the middle of intervals of equal probability."""
        return [(k + 0.5) / count for k in range(count)]


class Derived(DerivedParameter):
    """Computed from other parameters by an expression."""

    @model_validator(mode="after")
    def _check_expression(self) -> Self:
        names_in(self.expression)
        return self


Drawn = FloatRange | IntRange | Choice | Normal
Parameter = Annotated[Drawn | Derived, Field(discriminator="kind")]


def drawn_parameters(parameters: Mapping[str, Parameter]) -> dict[str, Drawn]:
    """Parameters with a coordinate, in the order of the file."""
    return {k: p for k, p in parameters.items() if not isinstance(p, Derived)}


def values_at(parameters: Mapping[str, Parameter], point: Sequence[float]) -> dict[str, Value]:
    """Values of all parameters, by name.

    Args:
        parameters: parameters of the space.
        point: coordinates from 0 to 1 of the sampled parameters.

    Raises:
        ValueError: a derived parameter cannot be computed.
    """
    drawn = drawn_parameters(parameters)
    values: dict[str, Value] = {
        name: p.at(float(u)) for (name, p), u in zip(drawn.items(), point, strict=True)
    }
    for name, parameter in parameters.items():
        if isinstance(parameter, Derived):
            numbers = {k: float(v) for k, v in values.items() if not isinstance(v, str)}
            values[name] = evaluate(parameter.expression, numbers)
    return values


def check_derived(parameters: Mapping[str, Parameter]) -> None:
    """Raise ValueError if a parameter is derived from another that does not precede it."""
    known = {k for k, p in parameters.items() if not isinstance(p, Derived)}
    for name, parameter in parameters.items():
        if isinstance(parameter, Derived):
            if missing := sorted(names_in(parameter.expression) - known):
                raise ValueError(
                    f"parameter {name!r} needs {missing[0]!r}, which is none, or derived after it"
                )
            known.add(name)


# --- Sampling ------------------------------------------------------------------------------------

# Points of a grid, or a given number of space-filling or weighted points.

Points = NDArray[np.float64]

Method = Annotated[GridMethod | SpreadMethod | ImportanceMethod, Field(discriminator="kind")]


def points_of(
    method: GridMethod | SpreadMethod | ImportanceMethod, drawn: Mapping[str, Drawn]
) -> tuple[Points, Points]:
    """Points [N, D] with coordinates from 0 to 1, and their weights [N], 1 if all are equal.

    Raises:
        ValueError: too many points, or an unknown parameter.
    """
    if isinstance(method, GridMethod):
        points = _grid(method, drawn)
        return points, np.ones(len(points))
    if isinstance(method, ImportanceMethod):
        return _weighted(method, drawn)
    points = spread(method.kind, method.count, len(drawn), seed=method.seed)
    return points, np.ones(len(points))


def spread(kind: str, count: int, dimensions: int, *, seed: int) -> Points:
    """Space-filling points [count, dimensions] in [0, 1).

    The points are a prefix of longer sequences, except for Latin hypercubes.
    """
    from scipy.stats import qmc

    if dimensions == 0:
        return np.zeros((count, 0))
    if kind == "random":
        return np.random.default_rng(seed).random((count, dimensions))
    if kind == "sobol":
        engine = qmc.Sobol(dimensions, rng=seed)
        # Balanced sequences require a power of two.
        whole = engine.random_base2(max(math.ceil(math.log2(count)), 0))
        return np.asarray(whole[:count], np.float64)
    makers = {"latin_hypercube": qmc.LatinHypercube, "halton": qmc.Halton}
    return np.asarray(makers[kind](dimensions, rng=seed).random(count), np.float64)


def _grid(method: GridMethod, drawn: Mapping[str, Drawn]) -> Points:
    levels = method.levels
    given = levels if isinstance(levels, dict) else dict.fromkeys(drawn, levels)
    _check_names(given, drawn)
    axes = [p.levels(max(given.get(name, 5), 1)) for name, p in drawn.items()]
    if (count := math.prod(len(a) for a in axes)) > MAX_POINTS:
        raise ValueError(f"a grid of {count} points; {MAX_POINTS} are the most")
    return np.array(list(itertools.product(*axes)), np.float64).reshape(count, len(drawn))


def _weighted(method: ImportanceMethod, drawn: Mapping[str, Drawn]) -> tuple[Points, Points]:
    """Points and importance weights. In coordinates, any distribution has nominal density 1."""
    _check_names(method.towards, drawn)
    rng, names = np.random.default_rng(method.seed), list(drawn)
    points = rng.random((method.count, len(names)))
    aimed = rng.random(method.count) >= method.defensive
    density = np.ones(method.count)
    for name, bump in method.towards.items():
        k, parameter = names.index(name), drawn[name]
        centre = parameter.coordinate(bump.mean)
        width = abs(parameter.coordinate(bump.mean + bump.std) - centre)
        points[aimed, k] = _cut_normal(points[aimed, k], centre, width)
        density *= _cut_density(points[:, k], centre, width)
    weights: Points = 1.0 / (method.defensive + (1.0 - method.defensive) * density)
    return points, weights


def _cut_normal(u: Points, centre: float, width: float) -> Points:
    from scipy.special import ndtr, ndtri

    low, high = ndtr((0.0 - centre) / width), ndtr((1.0 - centre) / width)
    found: Points = np.clip(centre + width * ndtri(low + (high - low) * u), 0.0, 1.0)
    return found


def _cut_density(x: Points, centre: float, width: float) -> Points:
    from scipy.special import ndtr

    share = ndtr((1.0 - centre) / width) - ndtr((0.0 - centre) / width)
    z = (x - centre) / width
    found: Points = np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * width * share)
    return found


def _check_names(given: Sequence[str] | Mapping[str, object], drawn: Mapping[str, Drawn]) -> None:
    if unknown := sorted(set(given) - set(drawn)):
        raise ValueError(f"{unknown[0]!r} is not a drawn parameter; there are {', '.join(drawn)}")
