"""REST models of sweeps and searches: many variants of a case, driven by planners."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from .base import Identifier, Model
from .episode import ResetSpec
from .jobs import PlannerName
from .operations import Operation
from .storyboard import Storyboard

ParameterValue = float | int | str | bool
Number = Annotated[float, Field(ge=-1e18, le=1e18)]
ParameterName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]
SweepSeed = Annotated[int, Field(ge=0, lt=2**63)]

MAX_POINTS = 1_000_000
"""Maximum number of points of a sweep, on a worker or by the command."""

MAX_EPISODES = 10_000
"""Maximum number of episodes of one job; sweeps of the command can be larger."""

SET_BY_SWEEPS = frozenset({"seed", "sensors", "action", "privileged"})
"""Fields of reset that a case cannot set: the seed, and those that depend on the planner."""


class CaseParameter(Model):
    """Members of all parameters."""

    path: str | list[str] | None = Field(
        default=None,
        description=(
            "path that its value is written to: agents.drivers.van_0.gap in reset, "
            "operations.0.y in the edits, or several paths; null for a parameter of the "
            "scenario file, or one that is used only to derive others"
        ),
    )

    @property
    def paths(self) -> list[str]:
        """Paths in a case that receive its value; empty if only other parameters are derived from
        it."""
        if self.path is None:
            return []
        return [self.path] if isinstance(self.path, str) else self.path


class FloatParameter(CaseParameter):
    """Uniform between two numbers, or uniform in its logarithm."""

    kind: Literal["float"] = "float"
    low: Number
    high: Number
    log: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high or (self.log and self.low <= 0):
            raise ValueError(
                f"low {self.low:g} and high {self.high:g}; low is below high, and above 0 with log"
            )
        return self


class IntParameter(CaseParameter):
    """Whole numbers from ``low`` to ``high``, both included, each as likely."""

    kind: Literal["int"]
    low: int = Field(ge=-(2**53), le=2**53)
    high: int = Field(ge=-(2**53), le=2**53)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")
        return self


class ChoiceParameter(CaseParameter):
    """One of a list, each as likely."""

    kind: Literal["choice"]
    values: list[ParameterValue] = Field(min_length=1, max_length=1000)


class NormalParameter(CaseParameter):
    """Normal, cut off at ``low`` and ``high``."""

    kind: Literal["normal"]
    mean: Number
    std: Annotated[float, Field(gt=0, le=1e9)]
    low: Number
    high: Number

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} is not below high {self.high:g}")
        return self


class DerivedParameter(CaseParameter):
    """Computed from other parameters, by arithmetic."""

    kind: Literal["derived"]
    expression: str = Field(
        max_length=1000,
        description="numbers, names, `+ - * / **`, abs cos max min radians sin sqrt",
    )


SweepParameter = Annotated[
    FloatParameter | IntParameter | ChoiceParameter | NormalParameter | DerivedParameter,
    Field(discriminator="kind"),
]


class GridMethod(Model):
    """Every combination of values."""

    kind: Literal["grid"]
    levels: int | dict[ParameterName, int] = Field(
        default=5, description="number of values per parameter; a choice takes all its values"
    )


class SpreadMethod(Model):
    """A number of points: independent, a Latin hypercube, or a low-discrepancy sequence."""

    kind: Literal["random", "latin_hypercube", "sobol", "halton"] = "sobol"
    count: int = Field(default=64, ge=1, le=MAX_POINTS)
    seed: SweepSeed = 0


class ImportanceBump(Model):
    """A component of importance sampling: a normal distribution truncated to the parameter's
    range."""

    mean: float
    std: Annotated[float, Field(gt=0)]


class ImportanceMethod(Model):
    """Points drawn where failures are thought to be, with weights that take it back.

    A share of ``defensive`` of the points is drawn from the parameters' own distributions, so that
    no weight is above 1 / ``defensive`` (Hesterberg 1995).
    """

    kind: Literal["importance"]
    count: int = Field(default=64, ge=1, le=MAX_POINTS)
    seed: SweepSeed = 0
    towards: dict[ParameterName, ImportanceBump] = Field(min_length=1)
    defensive: Annotated[float, Field(gt=0, le=1)] = 0.1


class SearchMethod(Model):
    """Adaptive search: points depend on earlier results, to find avoidable failures of one
    planner."""

    kind: Literal["search"]
    episodes: int = Field(default=300, ge=20, le=MAX_EPISODES)
    seed: SweepSeed = 0
    shrink: int = Field(
        default=3, ge=0, le=20, description="number of failures to find the boundary of"
    )
    probability: int = Field(
        default=0,
        ge=0,
        le=2000,
        description="number of episodes to estimate the failure rate; 0: none",
    )
    films: int = Field(default=0, ge=0, le=10, description="number of failures to film")


SweepMethod = Annotated[
    GridMethod | SpreadMethod | ImportanceMethod | SearchMethod, Field(discriminator="kind")
]


class StopRule(Model):
    """Stopping rule. Episodes count in the order of the table, independent of the worker."""

    at_fault: int | None = Field(
        default=None, ge=1, description="stop after this many at-fault collisions"
    )
    collisions: int | None = Field(default=None, ge=1)
    episodes: int | None = Field(default=None, ge=1)


class SweepRequest(Model):
    """Body of `POST /v1/sweeps`: points of a parameter space, driven by planners."""

    scene: Identifier
    corner_case: Identifier | None = Field(
        default=None, description="name in `GET /v1/gallery`, placed along the scene's route"
    )
    openscenario: str | None = Field(
        default=None,
        max_length=1_000_000,
        description="an OpenSCENARIO 1.0 to 1.3 file without catalogs, placed along the route",
    )
    storyboard: Storyboard | None = Field(
        default=None, description="in the scene's frame, as `reset` takes it"
    )
    ego: str | None = Field(
        default=None, max_length=200, description="name of the ego entity; default: Ego"
    )
    leave_out: list[Annotated[str, Field(max_length=200)]] = Field(
        default_factory=list, max_length=100, description="elements of the file to leave out"
    )
    reset: dict[str, Any] = Field(
        default_factory=dict,
        description="options of the episodes; the seed and the needs of planners are filled in",
    )
    operations: list[Operation] = Field(default_factory=list, max_length=64)
    parameters: dict[ParameterName, SweepParameter] = Field(
        default_factory=dict,
        max_length=64,
        description=(
            "distributions by name; parameters of a scenario file need no path. Leave out "
            "parameters that the file draws itself, and `kind` if it is unambiguous"
        ),
    )
    method: SweepMethod = Field(default_factory=SpreadMethod, description="or the name of its kind")
    seeds: list[SweepSeed] = Field(default=[0], min_length=1, max_length=1000)
    planners: list[PlannerName] = Field(default=["idm"], min_length=1, max_length=8)
    stop: StopRule | None = None
    metrics: list[Identifier] = Field(
        default_factory=list, max_length=64, description="scores to write as columns"
    )
    worst: int = Field(
        default=3,
        ge=0,
        le=20,
        description="number of episodes to keep recordings of, ranked by rank_by",
    )
    rank_by: Identifier = "criticality"

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, fields: Any) -> Any:
        return with_kinds(fields) if isinstance(fields, Mapping) else fields

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = (self.corner_case, self.openscenario, self.storyboard)
        if sum(one is not None for one in given) > 1:
            raise ValueError("give one of corner_case, openscenario and storyboard, or none")
        draws = self.storyboard is not None and self.storyboard.distributions
        if not (self.parameters or self.openscenario or draws):
            raise ValueError("name a parameter with its range: nothing would vary")
        if fixed := sorted(SET_BY_SWEEPS & set(self.reset)):
            raise ValueError(f"reset names {fixed[0]!r}, which is set by the sweep")
        ResetSpec.model_validate(self.reset)
        if isinstance(self.method, SearchMethod):
            self._check_search()
        elif (count := self.most_episodes()) > MAX_EPISODES:
            raise ValueError(
                f"{count} episodes; {MAX_EPISODES} is the most of a job: ask for fewer points, "
                "planners or seeds, or drive it with `real2sim sweep`"
            )
        return self

    def _check_search(self) -> None:
        if len(self.planners) != 1:
            raise ValueError(f"{len(self.planners)} planners; a search tests exactly one")
        only = sorted({"seeds", "stop", "metrics", "worst", "rank_by"} & self.model_fields_set)
        if only:
            raise ValueError(f"{only[0]!r} is for sweeps; a search chooses its own episodes")

    def most_episodes(self) -> int:
        """Maximum number of episodes."""
        method = self.method
        if isinstance(method, SearchMethod):
            return method.episodes
        points = _grid_points(method, self.parameters) if method.kind == "grid" else method.count
        return points * len(self.planners) * len(self.seeds)


def _grid_points(method: GridMethod, parameters: Mapping[str, SweepParameter]) -> int:
    counts = []
    for name, parameter in parameters.items():
        levels = method.levels if isinstance(method.levels, int) else method.levels.get(name, 5)
        if isinstance(parameter, ChoiceParameter):
            counts.append(len(parameter.values))
        elif not isinstance(parameter, DerivedParameter):
            counts.append(max(levels, 1))
    return math.prod(counts)


def with_kinds(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a sweep with omitted kinds filled in: for parameters from their members, and for
    the method if it is only a name."""
    filled = dict(fields)
    given = fields.get("parameters")
    if isinstance(given, Mapping):
        filled["parameters"] = {name: _with_kind(p) for name, p in given.items()}
    if isinstance(method := fields.get("method"), str):
        filled["method"] = {"kind": method}
    return filled


def _with_kind(parameter: Any) -> Any:
    if not isinstance(parameter, Mapping) or "kind" in parameter:
        return parameter
    if "values" in parameter:
        return {**parameter, "kind": "choice"}
    return {**parameter, "kind": "derived" if "expression" in parameter else "float"}
