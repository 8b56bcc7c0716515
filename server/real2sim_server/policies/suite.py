"""Suites: sets of cases for the comparison of planners.

A suite is a JSON file, ``{"cases": [{"name": ..., "scene": ..., "reset": {...}}, ...]}``;
docs/policies.md describes its format. Files in the folder ``suites`` are shipped and available by
name. To add a suite or a case, add its JSON.
"""

from __future__ import annotations

import copy
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from real2sim_proto.base import invalid_reason
from real2sim_proto.episode import Randomization, ResetSpec
from real2sim_proto.operations import Operation

from .._files import read_text
from ..console import CommandError

SHIPPED_SUITES = Path(__file__).with_name("suites")
DEMO_SUITE = "demo"
SET_BY_EVALUATION = frozenset({"seed", "sensors", "action", "privileged"})
"""Fields of reset that a case must not set: the seed, and the planner's needs."""


class Case(BaseModel):
    """One kind of episode.

    ``jitter`` maps paths into ``reset``, such as ``agents.drivers.car_3.gap``, to half-ranges.
    Every seed except 0 samples these numbers uniformly from their value plus or minus the
    half-range. Times (``_us``) are rounded to clock steps. Seed 0 is the unmodified case. For every
    seed, the worker samples ``randomization`` and ``agents.spawn`` of ``reset``. An episode has no
    other randomness: a case without these is the same for every seed.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,60}$")
    scene: str | None = None
    scenario: str | None = None
    reset: dict[str, Any] = Field(default_factory=dict)
    operations: list[Operation] = Field(default_factory=list)
    jitter: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> Case:
        if (self.scene is None) == (self.scenario is None):
            raise ValueError(f"case {self.name!r} needs exactly one of scene and scenario")
        if fixed := sorted(SET_BY_EVALUATION & set(self.reset)):
            raise ValueError(f"reset of case {self.name!r} names {fixed[0]!r}, which is set for it")
        ResetSpec.model_validate(self.reset)
        for path in self.jitter:
            _number_at(self.reset, path)
        return self

    @property
    def is_random(self) -> bool:
        """Whether its episodes depend on the seed."""
        spec = ResetSpec.model_validate(self.reset)
        drawn = spec.agents.spawn is not None or spec.randomization != Randomization()
        return drawn or any(width != 0 for width in self.jitter.values())

    def reset_for(self, seed: int) -> dict[str, Any]:
        """Options of reset for a seed; the same for every planner."""
        options = copy.deepcopy(self.reset)
        dt_us = int(options.get("dt_us", 100_000))
        for path, width in self.jitter.items():
            if seed == 0:
                break
            value = _number_at(options, path)
            rng = np.random.default_rng([seed, zlib.crc32(path.encode())])
            varied = value + float(rng.uniform(-width, width))
            if path.endswith("_us"):
                varied = max(round(varied / dt_us), 0) * dt_us
            _set_at(options, path, varied)
        return options | {"seed": seed}


@dataclass(frozen=True)
class EpisodeGrid:
    """Episodes to run: the product of planners, cases and seeds.

    Attributes:
        cases: kinds of episodes.
        policies: names of planners for ``load_planner``.
        seeds: seeds of every random case; other cases run only with the first seed.
    """

    cases: Sequence[Case]
    policies: Sequence[str]
    seeds: Sequence[int] = field(default=(0, 1, 2))

    def episodes(self) -> list[tuple[str, Case, int]]:
        """(planner, case, seed) of every episode."""
        return [
            (policy, case, seed)
            for case in self.cases
            for policy in self.policies
            for seed in (self.seeds if case.is_random else self.seeds[:1])
        ]


def load_suite(suite: str | Path) -> list[Case]:
    """Cases of a JSON file, or of the shipped suite with that name if the file does not exist.

    Raises:
        CommandError: no such file or suite, or an invalid case, which the message names.
    """
    path = Path(suite)
    shipped = SHIPPED_SUITES / f"{suite}.json"
    if not path.exists() and shipped.is_file():
        path = shipped
    try:
        content = json.loads(read_text(path))
        return _checked([Case.model_validate(case) for case in content["cases"]])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommandError(f"{path} is not a suite: {_sentence(error)}") from error


def cases_as_recorded(
    scenes: Sequence[str], scenarios: Sequence[str], reset: Mapping[str, Any] | None = None
) -> list[Case]:
    """One case for each scene and each scenario, unmodified, with options of ``reset``.

    Raises:
        CommandError: no scene or scenario, a duplicate name, or an invalid option.
    """
    options = dict(reset or {})
    try:
        cases = [Case(name=_case_name(s), scene=s, reset=options) for s in scenes]
        cases += [Case(name=_case_name(s), scenario=s, reset=options) for s in scenarios]
        return _checked(cases)
    except ValidationError as error:
        raise CommandError(_sentence(error)) from error


def _checked(cases: list[Case]) -> list[Case]:
    names = [case.name for case in cases]
    if not names:
        raise CommandError("there is nothing to run; name a scene, a scenario or a suite")
    if len(set(names)) != len(names):
        raise CommandError(f"cases need names of their own; given are {', '.join(names)}")
    return cases


def _case_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in text)[:60]


def _number_at(options: Mapping[str, Any], path: str) -> float:
    value: Any = options
    for part in path.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"jitter names {path!r}, which is not a number in the reset of the case")
    return float(value)


def _set_at(options: dict[str, Any], path: str, value: float) -> None:
    *parents, last = path.split(".")
    for part in parents:
        options = options[part]
    options[last] = value


def _sentence(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"{where}: {invalid_reason(first)}" if where else invalid_reason(first)
    return f"no {error}" if isinstance(error, KeyError) else str(error)
