"""Which episodes a planner is judged by."""

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

from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Operation

from ..console import CommandError

OWN = frozenset({"seed", "sensors", "action", "privileged"})
"""Fields of reset that the evaluation sets: the seed, and what the planner needs."""


class Case(BaseModel):
    """One kind of episode.

    Each seed but 0 varies it: every number of ``reset`` that ``jitter`` names by its path, such as
    ``agents.drivers.car_3.gap``, is drawn uniformly from its value plus or minus the one given.
    Times (``_us``) are rounded to clock steps. Seed 0 is the case as it is written.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,60}$")
    scene: str | None = None
    scenario: str | None = None
    reset: dict[str, Any] = Field(default_factory=dict)
    operations: list[Operation] = Field(default_factory=list)
    jitter: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_whole(self) -> Case:
        if (self.scene is None) == (self.scenario is None):
            raise ValueError(f"case {self.name!r} needs exactly one of scene and scenario")
        if own := sorted(OWN & set(self.reset)):
            raise ValueError(f"reset of case {self.name!r} names {own[0]!r}, which is set for it")
        ResetSpec.model_validate(self.reset)
        for path in self.jitter:
            _number_at(self.reset, path)
        return self

    def reset_for(self, seed: int) -> dict[str, Any]:
        """Options of reset for a seed; the same for every planner."""
        options = copy.deepcopy(self.reset)
        dt_us = int(options.get("dt_us", 100_000))
        for path, width in self.jitter.items():
            if seed == 0:
                break
            value = _number_at(options, path)
            draw = np.random.default_rng([seed, zlib.crc32(path.encode())]).uniform(-width, width)
            varied: float = value + float(draw)
            if path.endswith("_us"):
                varied = max(round(varied / dt_us), 0) * dt_us
            _put(options, path, varied)
        return options | {"seed": seed}


@dataclass(frozen=True)
class Asked:
    """What is to be run.

    Attributes:
        cases: kinds of episodes.
        policies: planners by name, as ``load_planner`` takes them.
        seeds: of every case.
    """

    cases: Sequence[Case]
    policies: Sequence[str]
    seeds: Sequence[int] = field(default=(0, 1, 2))

    def episodes(self) -> list[tuple[str, Case, int]]:
        """Every planner in every case with every seed."""
        return [(p, c, s) for c in self.cases for p in self.policies for s in self.seeds]


def load_suite(path: Path) -> list[Case]:
    """Cases of a JSON file: ``{"cases": [{"name": ..., "scene": ..., "reset": {...}}, ...]}``.

    Raises:
        CommandError: no such file, or a case that is not one; the sentence names it.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return _checked([Case.model_validate(case) for case in found["cases"]])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommandError(f"{path} is no suite: {_sentence(error)}") from error


def cases_of(scenes: Sequence[str], scenarios: Sequence[str]) -> list[Case]:
    """One case each, as recorded."""
    try:
        found = [Case(name=_name(s), scene=s) for s in scenes]
        return _checked(found + [Case(name=_name(s), scenario=s) for s in scenarios])
    except ValidationError as error:
        raise CommandError(_sentence(error)) from error


def demo_cases(scene: str) -> list[Case]:
    """The shipped street as it was recorded, and with its leading van made to be in the way.

    In the recording the van keeps 10 m ahead at 8 m/s. In the two others it brakes at 7 m/s^2 to
    a stop, and comes out of the lane beside the ego's to drive 3 m/s slower.
    """
    brakes = {"kind": "hard_brake", "delay": 1.5, "gap": 25.0, "braking": 7.0}
    cuts_in = {"kind": "cut_in", "delay": 1.5, "gap": 6.0, "duration": 1.5, "speed_change": -3.0}
    path = "agents.drivers.van_0."
    return [
        Case(
            name="as_recorded",
            scene=scene,
            reset={"start_us": 500_000},
            jitter={"start_us": 500_000},
        ),
        Case(
            name="lead_brakes",
            scene=scene,
            reset={"agents": {"drivers": {"van_0": brakes}}},
            jitter={path + "delay": 1.0, path + "braking": 1.5},
        ),
        Case(
            name="cut_in",
            scene=scene,
            reset={"agents": {"drivers": {"van_0": cuts_in}}},
            jitter={path + "delay": 1.0, path + "gap": 1.5, path + "speed_change": 1.0},
        ),
    ]


def _checked(cases: list[Case]) -> list[Case]:
    names = [case.name for case in cases]
    if not names:
        raise CommandError("there is nothing to run; name a scene, a scenario or a suite")
    if len(set(names)) != len(names):
        raise CommandError(f"cases need names of their own; given are {', '.join(names)}")
    return cases


def _name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in text)[:60]


def _number_at(options: Mapping[str, Any], path: str) -> float:
    found: Any = options
    for part in path.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    if isinstance(found, bool) or not isinstance(found, int | float):
        raise ValueError(f"jitter names {path!r}, which is no number in the reset of the case")
    return float(found)


def _put(options: dict[str, Any], path: str, value: float) -> None:
    *folders, last = path.split(".")
    for part in folders:
        options = options[part]
    options[last] = value


def _sentence(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"{where}: {first['msg']}" if where else str(first["msg"])
    return f"no {error}" if isinstance(error, KeyError) else str(error)
