"""Distributions of parameters (``ParameterValueDistribution``)."""

from __future__ import annotations

import itertools
import math
from typing import Any

from .elements import Part
from .read_conditions import plain_value
from .read_positions import Fields

MAX_CASES = 1_000_000


def read_distributions(part: Part) -> tuple[list[dict[str, Any]], Fields]:
    """Values of parameters of each case of the deterministic distributions, their product; and the
    stochastic ones by parameter.

    Raises:
        ScenarioError: a distribution that is not supported, or more than a million cases.
    """
    deterministic, stochastic = part.find("Deterministic"), part.find("Stochastic")
    if deterministic is not None:
        return _cases(deterministic), {}
    if stochastic is None:
        raise part.error("<ParameterValueDistribution> needs <Deterministic> or <Stochastic>")
    stochastic.optional("numberOfTestRuns")
    stochastic.optional("randomSeed")
    return [], {
        d.text("parameterName"): _drawn(d) for d in stochastic.children("StochasticDistribution")
    }


def _cases(part: Part) -> list[dict[str, Any]]:
    axes: list[list[dict[str, Any]]] = []
    for each in part.children():
        if each.tag == "DeterministicSingleParameterDistribution":
            name = each.text("parameterName")
            axes.append([{name: value} for value in _values(each)])
        elif each.tag == "DeterministicMultiParameterDistribution":
            sets = each.child("ValueSetDistribution").children("ParameterValueSet")
            axes.append(
                [
                    {
                        a.text("parameterRef"): plain_value(a.text("value"))
                        for a in s.children("ParameterAssignment")
                    }
                    for s in sets
                ]
            )
        else:
            raise each.refused(("DeterministicSingleParameterDistribution",))
    if math.prod(len(axis) for axis in axes) > MAX_CASES:
        raise part.error(f"its distributions have more than {MAX_CASES} cases")
    return [
        {name: value for values in case for name, value in values.items()}
        for case in itertools.product(*axes)
    ]


def _values(part: Part) -> list[Any]:
    found = part.only({"DistributionSet", "DistributionRange"})
    if found.tag == "DistributionSet":
        return [plain_value(e.text("value")) for e in found.children("Element")]
    step, limits = float(found.number("stepWidth")), found.child("Range")
    low, high = float(limits.number("lowerLimit")), float(limits.number("upperLimit"))
    if not step > 0 or (high - low) / step > MAX_CASES:
        raise found.error(f"a range from {low} to {high} in steps of {step} has too many values")
    return [low + k * step for k in range(math.floor((high - low) / step + 1e-9) + 1)]


def _drawn(part: Part) -> Fields:
    kinds = {
        "UniformDistribution", "NormalDistribution", "LogNormalDistribution",
        "PoissonDistribution", "ProbabilityDistributionSet", "Histogram",
    }  # fmt: skip
    found = part.only(kinds)
    if found.tag == "ProbabilityDistributionSet":
        values = [
            {"value": plain_value(e.text("value")), "weight": e.number("weight")}
            for e in found.children("Element")
        ]
        return {"kind": "choice", "values": values}
    if found.tag == "Histogram":
        bins = [{**_range(b), "weight": b.number("weight")} for b in found.children("Bin")]
        return {"kind": "histogram", "bins": bins}
    limits = _range(found) if found.find("Range") is not None else {}
    if found.tag == "UniformDistribution":
        return {"kind": "uniform", **limits}
    if found.tag == "PoissonDistribution":
        return {"kind": "poisson", "mean": found.number("expectedValue"), **limits}
    return {
        "kind": "normal",
        "mean": found.number("expectedValue"),
        "variance": found.number("variance"),
        "log": found.tag == "LogNormalDistribution",
        **limits,
    }


def _range(part: Part) -> Fields:
    limits = part.child("Range")
    return {"low": limits.number("lowerLimit"), "high": limits.number("upperLimit")}
