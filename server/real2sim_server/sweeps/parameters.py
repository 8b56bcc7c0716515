"""Parameters of a space: what a coordinate between 0 and 1 stands for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from real2sim_proto.sweeps import (
    ChoiceParameter,
    DerivedParameter,
    FloatParameter,
    IntParameter,
    NormalParameter,
    ParameterName,
    ParameterValue,
)

from .expression import evaluate, names_in

Value = ParameterValue
Name = ParameterName


class FloatRange(FloatParameter):
    """Uniform between two numbers, or uniform in its logarithm."""

    def at(self, u: float) -> float:
        """The value at a coordinate."""
        if self.log:
            return float(self.low * (self.high / self.low) ** u)
        return self.low + (self.high - self.low) * u

    def coordinate(self, value: Any) -> float:
        """Of a value."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (float(value) - self.low) / (self.high - self.low)

    def levels(self, count: int) -> list[float]:
        """Coordinates of a grid with so many values, the ends among them."""
        return [k / (count - 1) for k in range(count)] if count > 1 else [0.5]


class IntRange(IntParameter):
    """Whole numbers from ``low`` to ``high``, both included, each as likely."""

    def at(self, u: float) -> int:
        """The value at a coordinate."""
        count = self.high - self.low + 1
        return self.low + min(int(u * count), count - 1)

    def coordinate(self, value: Any) -> float:
        """The middle of a value's stretch."""
        return (int(value) - self.low + 0.5) / (self.high - self.low + 1)

    def levels(self, count: int) -> list[float]:
        """Coordinates of a grid."""
        most = self.high - self.low + 1
        values = [self.low + round(k * (most - 1) / max(count - 1, 1)) for k in range(count)]
        return [self.coordinate(v) for v in dict.fromkeys(values)]


class Choice(ChoiceParameter):
    """One of a list, each as likely."""

    def at(self, u: float) -> Value:
        """The value at a coordinate."""
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]

    def coordinate(self, value: Any) -> float:
        """The middle of a value's stretch."""
        return (self.values.index(value) + 0.5) / len(self.values)

    def levels(self, count: int) -> list[float]:
        """Coordinates of all values, whatever the count."""
        return [(k + 0.5) / len(self.values) for k in range(len(self.values))]


class Normal(NormalParameter):
    """Normal, cut off at ``low`` and ``high``."""

    def at(self, u: float) -> float:
        """The value at a coordinate, which is its cumulative probability."""
        from scipy.special import ndtr, ndtri

        low, high = (ndtr((x - self.mean) / self.std) for x in (self.low, self.high))
        value = self.mean + self.std * float(ndtri(low + (high - low) * u))
        return min(max(value, self.low), self.high)

    def coordinate(self, value: Any) -> float:
        """Its cumulative probability."""
        from scipy.special import ndtr

        low, high, x = (
            float(ndtr((v - self.mean) / self.std)) for v in (self.low, self.high, value)
        )
        return (x - low) / (high - low)

    def levels(self, count: int) -> list[float]:
        """Coordinates of a grid, at middles of equal shares."""
        return [(k + 0.5) / count for k in range(count)]


class Derived(DerivedParameter):
    """Computed from other parameters, by arithmetic."""

    @model_validator(mode="after")
    def _check_expression(self) -> Self:
        names_in(self.expression)
        return self


Drawn = FloatRange | IntRange | Choice | Normal
Parameter = Annotated[Drawn | Derived, Field(discriminator="kind")]


def drawn_parameters(parameters: Mapping[str, Parameter]) -> dict[str, Drawn]:
    """Those that have a coordinate, in the order that they are written in."""
    return {k: p for k, p in parameters.items() if not isinstance(p, Derived)}


def values_at(parameters: Mapping[str, Parameter], point: Sequence[float]) -> dict[str, Value]:
    """Values of all parameters, by name.

    Args:
        parameters: of the space.
        point: coordinates from 0 to 1 of those that are drawn.

    Raises:
        ValueError: a derived one cannot be computed.
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
    """Raises ValueError: one that is derived from what is not before it."""
    known = {k for k, p in parameters.items() if not isinstance(p, Derived)}
    for name, parameter in parameters.items():
        if isinstance(parameter, Derived):
            if missing := sorted(names_in(parameter.expression) - known):
                raise ValueError(
                    f"parameter {name!r} needs {missing[0]!r}, which is none, or derived after it"
                )
            known.add(name)
