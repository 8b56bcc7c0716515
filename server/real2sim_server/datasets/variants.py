"""Sweeps: the same drive many times over, each with other values in its edits."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from real2sim_proto.jobs import DatasetSweep, SweptValues
from real2sim_proto.operations import Operation

from ..edit import EditError, ScenarioState, apply_operations
from ..scene import Scene
from .drive import Drive, ScenarioDrive
from .errors import DatasetError

MAX_VARIANTS = 1000
_OPERATIONS: TypeAdapter[list[Operation]] = TypeAdapter(list[Operation])


@dataclass(frozen=True, eq=False)
class Variant:
    """One drive of a sweep.

    Attributes:
        drive: that is exported.
        values: of the parameters; empty where nothing is swept.
    """

    drive: Drive
    values: Mapping[str, Any] = field(default_factory=dict)


def swept(scene: Scene, state: ScenarioState, sweep: DatasetSweep, seed: int) -> list[Variant]:
    """The variants of a scenario: every combination of lists and ranges, each with ``draws`` draws
    of what has a distribution.

    Args:
        scene: of the scenario.
        state: before the edits of the sweep.
        sweep: parameters, and edits in which ``"$name"`` stands for one's value.
        seed: of the draws.

    Raises:
        DatasetError: more than MAX_VARIANTS, an edit that names no parameter, parameters that no
            edit names, or values that make no edits or edits that cannot be made, which are named.
    """
    _check_names(sweep)
    variants = []
    for values in _combinations(sweep, seed):
        try:
            edits = _OPERATIONS.validate_python(_filled(sweep.operations, values))
            edited = apply_operations(state, edits).state
        except ValidationError as error:
            raise DatasetError(f"sweep: {dict(values)} make no edits ({error})") from error
        except EditError as error:
            raise DatasetError(f"sweep: {dict(values)}: {error}") from error
        variants.append(Variant(ScenarioDrive(scene, edited), values))
    return variants


def _check_names(sweep: DatasetSweep) -> None:
    named = set(_names(sweep.operations))
    given = set(sweep.parameters)
    if named - given:
        known = ", ".join(sweep.parameters)
        raise DatasetError(
            f"sweep: an edit has ${min(named - given)}; there are the parameters {known}"
        )
    if given - named:
        raise DatasetError(f"sweep: no edit has ${min(given - named)}")


def _names(value: Any) -> list[str]:
    if isinstance(value, str) and value.startswith("$"):
        return [value[1:]]
    if isinstance(value, Mapping):
        return [name for part in value.values() for name in _names(part)]
    return [name for part in value for name in _names(part)] if isinstance(value, list) else []


def _filled(value: Any, values: Mapping[str, Any]) -> Any:
    if isinstance(value, str) and value.startswith("$"):
        return values[value[1:]]
    if isinstance(value, Mapping):
        return {key: _filled(part, values) for key, part in value.items()}
    return [_filled(part, values) for part in value] if isinstance(value, list) else value


def _combinations(sweep: DatasetSweep, seed: int) -> list[dict[str, Any]]:
    grid = {name: _grid(p) for name, p in sweep.parameters.items() if not p.is_drawn}
    drawn = {name: p for name, p in sweep.parameters.items() if p.is_drawn}
    draws = sweep.draws if drawn else 1
    count = int(np.prod([len(values) for values in grid.values()], initial=1)) * draws
    if count > MAX_VARIANTS:
        raise DatasetError(f"the sweep has {count} variants; {MAX_VARIANTS} is the most")
    rng = np.random.default_rng([seed, len(drawn)])
    return [
        dict(zip(grid, point, strict=True)) | {name: _draw(p, rng) for name, p in drawn.items()}
        for point in itertools.product(*grid.values())
        for _ in range(draws)
    ]


def _grid(values: SweptValues) -> Sequence[Any]:
    if values.values is not None:
        return values.values
    assert values.range is not None
    first, last, count = values.range
    return [float(value) for value in np.linspace(first, last, count)]


def _draw(values: SweptValues, rng: np.random.Generator) -> float:
    if values.uniform is not None:
        return float(rng.uniform(*values.uniform))
    assert values.normal is not None
    return float(rng.normal(*values.normal))
