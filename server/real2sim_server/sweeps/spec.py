"""The specification of a sweep: a case or a scenario file, its parameters, and the planners."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, InstanceOf, ValidationError, model_validator

from real2sim_proto.base import Identifier, invalid_reason
from real2sim_proto.storyboard import (
    Choice,
    Distribution,
    MapRoads,
    Normal,
    Storyboard,
    Uniform,
    ValueRange,
    ValueSet,
)
from real2sim_proto.sweeps import SpreadMethod, StopRule, with_kinds

from .._files import atomic_file, read_text
from ..console import CommandError
from ..policies.suite import Case
from ..scenarios import ScenarioError
from ..scenarios.flat_scene import fitted_to_scene
from ..scenarios.gallery import corner_case
from ..scenarios.openscenario import (
    ReadOptions,
    ScenarioFile,
    read_openscenario,
    read_openscenario_text,
    write_openscenario,
)
from ..scene import Scene
from ..scene.errors import BundleError
from ..scene.io import open_scene
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

# --- Scenes of storyboards ------------------------------------------------------------------------

GALLERY = "gallery:"
SECONDS = 15.0
"""Default duration of an episode."""
MAX_FILE_BYTES = 16 << 20
MAX_VALUES = 1000
WIDTHS = 4.0
"""Truncation of a normal distribution without a range, in standard deviations."""


class ScenarioSource(BaseModel):
    """``storyboard`` in the file of a space: a name, or these fields.

    Attributes:
        file: OpenSCENARIO file (.xosc), storyboard (.json) or ``gallery:NAME``.
        ego: entity that is the ego; None: the entity with the ego's name.
        leave_out: unsupported elements to ignore.
        as_it_is: whether the file uses the scene's world frame; nothing is then placed along the
            scene's route.
        alone: whether to read only the OpenSCENARIO file, without catalogs and road network.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str = Field(min_length=1, max_length=4000)
    ego: str | None = None
    leave_out: tuple[str, ...] = ()
    as_it_is: bool = False
    alone: bool = False


@dataclass(frozen=True, eq=False)
class StoryboardSpace:
    """Creates the storyboard of each point of a space.

    The file is read again for each point, so parameters can be used anywhere: in numbers, names,
    counts and texts.

    Attributes:
        source: scenario source.
        folder: base of its relative path.
        scene: scene to place the storyboard in.
        start_us: start of episodes [us]; None: start of the recording.
        names: parameters of the storyboard.
    """

    source: ScenarioSource
    folder: Path
    scene: Scene
    start_us: int | None
    names: frozenset[str]

    def read(self, values: Mapping[str, Value]) -> ScenarioFile:
        """The file with values of its parameters, in its own frame. Raises like :meth:`at`."""
        mine = {name: value for name, value in values.items() if name in self.names}
        found = read_scenario(self.source, self.folder, mine)
        # The space samples the distributions of the file.
        fields = {"distributions": {}, "drives_ego": False}
        board = found.board.model_copy(update=fields)
        return ScenarioFile(board, found.road_file, found.notes)

    def at(self, values: Mapping[str, Value]) -> Storyboard:
        """The storyboard with values of its parameters, laid out in the scene.

        Raises:
            ValueError: values that the file does not allow.
        """
        try:
            return self.laid_out(self.read(values).board)
        except (ScenarioError, OSError) as error:
            raise ValueError(f"storyboard {self.source.file!r}: {error}") from error

    def laid_out(self, board: Storyboard) -> Storyboard:
        """A storyboard in the frame of its file, in the scene. Raises ScenarioError."""
        if self.source.as_it_is:
            return board
        return fitted_to_scene(board, self.scene, start_us=self.start_us)


def is_scenario(name: str) -> bool:
    """Whether a name refers to a scenario file or a gallery case."""
    return name.startswith(GALLERY) or name.lower().endswith(".xosc")


def read_scenario(
    source: ScenarioSource, folder: Path, parameters: Mapping[str, Any]
) -> ScenarioFile:
    """A scenario with values of its parameters.

    Raises:
        ScenarioError: not a scenario, or a scenario with unsupported elements.
        ValueError: an unknown parameter.
        OSError: the file cannot be read.
    """
    if source.file.startswith(GALLERY):
        return ScenarioFile(corner_case(source.file).storyboard(**parameters))
    path = folder / source.file
    if (size := path.stat().st_size) > MAX_FILE_BYTES:
        raise ScenarioError(f"{size} bytes; at most {MAX_FILE_BYTES} are read")
    if path.suffix.lower() == ".json":
        fields = json.loads(read_text(path))
        fields["parameters"] = {**fields.get("parameters", {}), **parameters}
        return ScenarioFile(Storyboard.model_validate(fields))
    options = ReadOptions(parameters, frozenset(source.leave_out), source.ego)
    if source.alone:
        return read_openscenario_text(path.read_bytes(), path.name, options)
    return read_openscenario(path, options)


def write_scenario_file(
    folder: Path, name: str, read: ScenarioFile, source: ScenarioSource
) -> ScenarioSource:
    """Write a storyboard with its road network; return the source to read it again.

    Args:
        folder: folder of the file.
        name: file name without its suffix: ``.xosc``, or ``.json`` if OpenSCENARIO cannot express
            it.
        read: storyboard in the frame of its file.
        source: original source of the storyboard.
    """
    board = read.board
    if isinstance(board.roads, MapRoads) and read.road_file is not None:
        roads = f"{name}{read.road_file.suffix}"
        with atomic_file(folder / roads) as file:
            file.write(read.road_file.read_bytes())
        board = board.model_copy(update={"roads": MapRoads(file=roads)})
    try:
        suffix, content = ".xosc", write_openscenario(board)
    except ScenarioError:
        suffix, content = ".json", board.model_dump_json(indent=2).encode()
    with atomic_file(folder / f"{name}{suffix}") as file:
        file.write(content)
    return ScenarioSource(file=f"{name}{suffix}", ego=source.ego, as_it_is=source.as_it_is)


def run_options(board: Storyboard, *, seed: int, seconds: float) -> dict[str, Any]:
    """Reset options with which ``real2sim run`` drives a storyboard."""
    return {
        "storyboard": board.model_dump(mode="json"),
        "seed": seed,
        "horizon": max(round(seconds * 10), 1),
        "beyond_log": "extend",
    }


def with_storyboard(
    fields: Mapping[str, Any], folder: Path, scenes: Path | None = None
) -> dict[str, Any]:
    """Fields of a space whose ``storyboard`` names a scenario, with the factory of storyboards.

    Parameters of the space without a path set the storyboard's parameters of the same name.
    Parameters with distributions in the file can be omitted.

    Args:
        fields: fields of the space file.
        folder: base of the relative path.
        scenes: folder of bundles, as for :func:`~.open_scene`.

    Raises:
        CommandError: the scenario does not exist or cannot be a space; the message explains why.
        ValueError: invalid fields.
    """
    asked = fields["storyboard"]
    source = ScenarioSource.model_validate({"file": asked} if isinstance(asked, str) else asked)
    case = {"name": _name(source.file), "scene": "demo_street", **(fields.get("case") or {})}
    reset = {
        "beyond_log": "extend",
        "horizon": round(SECONDS * 10),
        **(case.get("reset") or {}),
    }
    try:
        found = read_scenario(source, folder, {})
        scene = open_scene(str(case["scene"]), scenes)
    except (ScenarioError, BundleError, OSError, ValueError) as error:
        raise CommandError(f"storyboard {source.file!r}: {error}") from error
    names = frozenset(found.board.parameters)
    made = StoryboardSpace(source, folder, scene, reset.get("start_us"), names)
    parameters = _parameters(fields.get("parameters") or {}, found, source.file)
    return {
        **fields,
        "storyboard": made,
        "case": {**case, "reset": reset},
        "parameters": parameters,
    }


def _name(file: str) -> str:
    text = file.removeprefix(GALLERY) if file.startswith(GALLERY) else Path(file).stem
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in text)[:60] or "scenario"


def _parameters(given: Mapping[str, Any], found: ScenarioFile, file: str) -> dict[str, Any]:
    """Parameters named by the space, and other parameters with distributions in the file."""
    board = found.board
    # Parameters that the space names may have any distribution in the file.
    drawn = {n: d for n, d in board.distributions.items() if n not in given}
    parameters = {name: _parameter(name, d) for name, d in drawn.items()}
    parameters |= {n: p for n, p in _of_cases(found.cases).items() if n not in given}
    parameters |= dict(given)
    if not parameters:
        raise CommandError(
            f"storyboard {file!r} has no distributions; name its parameters with their ranges in a "
            f"file, as docs/sweeps.md says: it has {', '.join(board.parameters) or 'none'}"
        )
    used = " ".join(str(p.get("expression", "")) for p in parameters.values() if _is(p))
    for name, parameter in parameters.items():
        known = name in board.parameters or name in used
        if _is(parameter) and parameter.get("path") is None and not known:
            raise CommandError(
                f"storyboard {file!r} has no parameter {name!r}; it has "
                f"{', '.join(board.parameters) or 'none'}"
            )
    return parameters


def _is(parameter: Any) -> bool:
    return isinstance(parameter, dict)


def _parameter(name: str, found: Distribution) -> dict[str, Any]:
    """A parameter of a space with the distribution of a storyboard's parameter."""
    if isinstance(found, Uniform):
        return {"kind": "float", "low": found.low, "high": found.high}
    if isinstance(found, Normal) and not found.log:
        std = math.sqrt(found.variance)
        low = found.mean - WIDTHS * std if found.low is None else found.low
        high = found.mean + WIDTHS * std if found.high is None else found.high
        return {"kind": "normal", "mean": found.mean, "std": std, "low": low, "high": high}
    if isinstance(found, ValueSet):
        return _choice(name, found.values)
    if isinstance(found, ValueRange):
        count = math.floor((found.high - found.low) / found.step + 1e-9) + 1
        values = [found.low + k * found.step for k in range(min(count, MAX_VALUES + 1))]
        return _choice(name, values)
    if isinstance(found, Choice) and len({v.weight for v in found.values}) == 1:
        return _choice(name, [v.value for v in found.values])
    kind = "log-normal" if isinstance(found, Normal) else found.kind
    raise CommandError(
        f"parameter {name!r} has a distribution ({kind}) that spaces do not have; give its range "
        f"in `parameters`: {name}: {{low: ..., high: ...}}"
    )


def _of_cases(cases: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters of a deterministic distribution whose cases are all combinations."""
    if not cases:
        return {}
    found = {name: list(dict.fromkeys(c[name] for c in cases)) for name in cases[0]}
    if math.prod(len(values) for values in found.values()) != len(cases):
        raise CommandError(
            f"the file's sets give {', '.join(found)} together, not each its values; name ranges "
            "in `parameters` instead"
        )
    return {name: _choice(name, values) for name, values in found.items()}


def _choice(name: str, values: Sequence[Any]) -> dict[str, Any]:
    if len(values) > MAX_VALUES:
        raise CommandError(
            f"parameter {name!r} has more than {MAX_VALUES} values; give its range in "
            f"`parameters`: {name}: {{low: ..., high: ...}}"
        )
    return {"kind": "choice", "values": list(values)}


# --- Specification --------------------------------------------------------------------------------

MAX_BYTES = 1 << 20
SHIPPED_SPACES = Path(__file__).with_name("spaces")


class Space(BaseModel):
    """A case and its varied parameters.

    Sweeps drive sampled points of it; searches select points.

    Attributes:
        case: case as in a suite, with a scene.
        parameters: parameters by name.
        storyboard: creates the storyboard of each point; None if the case has no storyboard, or a
            fixed one.
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
        """The case with values of the parameters inserted.

        Raises:
            ValueError: a path that does not exist, or an invalid value.
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
        method: selects the points.
        seeds: each point is driven with each seed.
        planners: names for ``load_planner``; each drives each point.
        stop: stop rule; None drives all points.
        metrics: scores to add as columns.
        worst: number of episodes to record, with the highest ``rank_by``.
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
            return self  # Names are already valid; computing the points again would take time.
        points_of(self.method, drawn_parameters(self.parameters))
        return self


S = TypeVar("S", bound=Space)


def load_sweep(path: Path, scenes: Path | None = None) -> SweepSpec:
    """Load a sweep from a YAML or JSON file.

    Args:
        path: the file.
        scenes: folder of bundles, for a storyboard placed in a scene.

    Raises:
        CommandError: the file cannot be read, or is not a sweep; the message explains why.
    """
    return _loaded(path, SweepSpec, "sweep", scenes)


def load_space(name: str | Path, scenes: Path | None = None) -> Space:
    """A space in a YAML or JSON file, a built-in one, or the distributions of an OpenSCENARIO file.

    Fields of a sweep beyond a space are ignored.

    Raises:
        CommandError: see :func:`load_sweep`.
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
        raise CommandError(f"{path} is not a valid {what}: {error}") from error
    return _validated(fields, path.parent, kind, (str(path), what), scenes)


def _validated(
    fields: dict[str, Any], folder: Path, kind: type[S], named: tuple[str, str], scenes: Path | None
) -> S:
    """Validate the fields of a file; ``named``: file and kind, for messages."""
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
        raise CommandError(
            f"{name} is not a valid {what}: {where}: {invalid_reason(first)}"
        ) from error
    except (TypeError, ValueError) as error:
        raise CommandError(f"{name} is not a valid {what}: {error}") from error


def _content(path: Path) -> dict[str, Any]:
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{size} bytes; at most {MAX_BYTES} are read")
    text = read_text(path)
    # Aliases can expand a small file to a huge one, and no sweep needs them.
    if path.suffix.lower() != ".json" and any(
        isinstance(e, yaml.events.AliasEvent) for e in yaml.parse(text, yaml.SafeLoader)
    ):
        raise ValueError("it has YAML aliases, which are not read")
    fields = json.loads(text) if path.suffix.lower() == ".json" else yaml.safe_load(text)
    if not isinstance(fields, dict):
        raise ValueError(f"its top level is a {type(fields).__name__}, no mapping")
    return with_kinds(fields)


def _put(fields: dict[str, Any], path: str, value: Value) -> None:
    """Set the value at a path.

    For example ``reset.agents.drivers.van_0.gap``, the same without ``reset``, or
    ``operations.0.delta.1``.
    """
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
