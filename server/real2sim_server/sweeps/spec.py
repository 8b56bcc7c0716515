"""What a sweep is asked for: a case, parameters in it, and who drives it."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    InstanceOf,
    ValidationError,
    model_validator,
)

from real2sim_proto.base import Identifier
from real2sim_proto.sweeps import SpreadMethod, StopRule, with_kinds

from ..console import CommandError
from ..policies.suite import Case
from .parameters import (
    Method,
    Name,
    Parameter,
    Value,
    check_derived,
    drawn_parameters,
    points_of,
    values_at,
)
from .storyboard_space import StoryboardSpace, is_scenario, with_storyboard

MOST_BYTES = 1 << 20
SHIPPED_SPACES = Path(__file__).with_name("spaces")


class Space(BaseModel):
    """A case and what is varied in it.

    The same for a sweep, which drives points of it, and for a search, which chooses them.

    Attributes:
        case: as of a suite, with a scene.
        parameters: by name.
        storyboard: makes the storyboard of each point; None where the case has none, or its own.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    case: Case
    parameters: dict[Name, Parameter] = Field(min_length=1, max_length=64)
    storyboard: InstanceOf[StoryboardSpace] | None = Field(default=None, exclude=True)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.case.scene is None:
            raise ValueError("the case of a sweep names a scene; scenarios live in workers")
        check_derived(self.parameters)
        middle = [0.5] * len(drawn_parameters(self.parameters))
        self.case_at(values_at(self.parameters, middle))
        return self

    def case_at(self, values: Mapping[str, Value]) -> Case:
        """The case with values of the parameters in their places.

        Raises:
            ValueError: a path that leads nowhere, or a value that is not allowed there.
        """
        fields: dict[str, Any] = {
            "reset": copy.deepcopy(self.case.reset),
            "operations": [o.model_dump(mode="json") for o in self.case.operations],
        }
        if self.storyboard is not None:
            board = self.storyboard.at(values)
            fields["reset"]["storyboard"] = board.model_dump(mode="json")
        for name, parameter in self.parameters.items():
            for path in parameter.paths:
                _put(fields, path, values[name])
        kept = self.case.model_dump(exclude={"reset", "operations", "jitter"}, exclude_none=True)
        return Case.model_validate({**kept, **fields})


class SweepSpec(Space):
    """A sweep: ``sweep.yaml``.

    Attributes:
        method: which points.
        seeds: each point is driven with each.
        planners: by name, as ``load_planner`` takes them; each drives each point.
        stop: when enough is known; None drives all.
        metrics: scores that get columns.
        worst: so many episodes, by ``rank_by`` from the highest on, leave recordings.
        rank_by: a column.
    """

    method: Method = SpreadMethod()
    seeds: list[Annotated[int, Field(ge=0, lt=2**63)]] = Field(default=[0], min_length=1)
    planners: list[Annotated[str, Field(min_length=1, max_length=400)]] = Field(
        default=["idm"], min_length=1
    )
    stop: StopRule | None = None
    metrics: list[Identifier] = Field(default=[])
    worst: int = Field(default=3, ge=0, le=1000)
    rank_by: Identifier = "criticality"

    @model_validator(mode="after")
    def _check_points(self) -> Self:
        if isinstance(self.method, SpreadMethod) and self.method.count > 4096:
            return self  # Names cannot be wrong, and drawing them twice would take its time.
        points_of(self.method, drawn_parameters(self.parameters))
        return self


S = TypeVar("S", bound=Space)


def load_sweep(path: Path, scenes: Path | None = None) -> SweepSpec:
    """A sweep in a YAML or JSON file.

    Args:
        path: the file.
        scenes: folder of bundles, where a storyboard is laid out in one.

    Raises:
        CommandError: it cannot be read, or is none; the sentence says why.
    """
    return _loaded(path, SweepSpec, "sweep", scenes)


def load_space(name: str | Path, scenes: Path | None = None) -> Space:
    """A space in a YAML or JSON file, or the shipped one of that name, or that of the distributions
    of an OpenSCENARIO file; what a sweep has beyond a space is left out.

    Raises:
        CommandError: as :func:`load_sweep`.
    """
    if is_scenario(str(name)):
        return _validated({"storyboard": str(name)}, Path(), Space, (str(name), "space"), scenes)
    path = Path(name)
    shipped = SHIPPED_SPACES / f"{name}.yaml"
    if not path.exists() and shipped.is_file():
        path = shipped
    elif not path.exists():
        there = ", ".join(sorted(p.stem for p in SHIPPED_SPACES.glob("*.yaml")))
        raise CommandError(f"no space {str(name)!r}; give a file, or one of {there}")
    return _loaded(path, Space, "space", scenes)


def _loaded(path: Path, kind: type[S], what: str, scenes: Path | None) -> S:
    try:
        fields = _content(path)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise CommandError(f"{path} is no {what}: {error}") from error
    return _validated(fields, path.parent, kind, (str(path), what), scenes)


def _validated(
    fields: dict[str, Any], folder: Path, kind: type[S], named: tuple[str, str], scenes: Path | None
) -> S:
    """Args: fields; the folder of names in them; what they are of; file and kind for messages."""
    name, what = named
    if kind is Space:
        fields = {k: v for k, v in fields.items() if k in Space.model_fields}
    try:
        if "storyboard" in fields:
            fields = with_storyboard(fields, folder, scenes)
        return kind.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise CommandError(f"{name} is no {what}: {where}: {first['msg']}") from error
    except (TypeError, ValueError) as error:
        raise CommandError(f"{name} is no {what}: {error}") from error


def _content(path: Path) -> dict[str, Any]:
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ValueError(f"{size} bytes; at most {MOST_BYTES} are read")
    text = path.read_text(encoding="utf-8")
    # Aliases let a small file stand for a huge one, and no sweep needs them.
    if path.suffix != ".json" and any(
        isinstance(e, yaml.events.AliasEvent) for e in yaml.parse(text, yaml.SafeLoader)
    ):
        raise ValueError("it has YAML aliases, which are not read")
    fields = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    if not isinstance(fields, dict):
        raise ValueError(f"its top level is a {type(fields).__name__}, no mapping")
    return with_kinds(fields)


def _put(fields: dict[str, Any], path: str, value: Value) -> None:
    """Set what a path names: ``reset.agents.drivers.van_0.gap``, the same without ``reset``, or
    ``operations.0.delta.1``."""
    parts = path.split(".")
    if parts[0] not in {"reset", "operations"}:
        parts.insert(0, "reset")
    where: Any = fields
    try:
        for part in parts[:-1]:
            where = where[int(part)] if isinstance(where, list) else where.setdefault(part, {})
        if isinstance(where, list):
            where[int(parts[-1])] = value
        else:
            # Times and counts are whole numbers.
            whole = parts[-1].endswith("_us") and not isinstance(value, str | bool)
            where[parts[-1]] = round(float(value)) if whole else value
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"path {path!r} leads nowhere in the case: {error}") from error
