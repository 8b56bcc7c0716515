"""Failures of a search: how they are reported, shrunk, and written as scenario files."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.planners import load_planner
from real2sim_proto.episode import ResetSpec

from ...world.recording.recording import Recording
from ..episode import Drive, Driven, drive_episode
from ..parameters import Value, drawn_parameters, values_at
from ..storyboard_space import read_scenario, run_options, write_scenario_file
from .evaluation import Evaluation, Evaluator, impact_of

# --- Shrinking -----------------------------------------------------------------------------------

# Moves each parameter alone to where the episode goes well.

HALVINGS = 5
"""A boundary is known to 1/32 of the way from the failure to the end that is safe."""


@dataclass(frozen=True)
class Boundary:
    """Where a failure ends along one parameter.

    Attributes:
        parameter: name.
        failing: the value of the failure.
        last_fail, first_pass: the two that the boundary is between.
        share: way to ``first_pass``, as a share of the range.
    """

    parameter: str
    failing: Value
    last_fail: Value
    first_pass: Value
    share: float


def boundaries(evaluate: Evaluator, failure: Evaluation) -> list[Boundary]:
    """The nearest boundary of each parameter that leads to safety alone, the nearest first.

    Both ends of a parameter are tried; where one goes well, the way to it is halved.
    """
    names = list(drawn_parameters(evaluate.spaces[failure.space].parameters))
    found = []
    for k, name in enumerate(names):
        sides = [_towards(evaluate, failure, (k, name), end) for end in (0.0, 1.0)]
        safe = [b for b in sides if b is not None]
        if safe:
            found.append(min(safe, key=lambda b: b.share))
    return sorted(found, key=lambda b: b.share)


def _towards(
    evaluate: Evaluator, failure: Evaluation, parameter: tuple[int, str], end: float
) -> Boundary | None:
    """The boundary on the way to an end; None where that fails as well."""
    k, name = parameter

    def fails(u: float) -> bool:
        return evaluate(failure.space, _moved(failure, k, u)).at_fault

    if abs(end - failure.point[k]) < 1e-6 or fails(end):
        return None
    bad, good = failure.point[k], end
    for _ in range(HALVINGS):
        middle = (bad + good) / 2
        if fails(middle):
            bad = middle
        else:
            good = middle
    parameters = evaluate.spaces[failure.space].parameters

    def value(u: float) -> Value:
        return values_at(parameters, _moved(failure, k, u))[name]

    share = abs(good - failure.point[k])
    return Boundary(name, failure.values[name], value(bad), value(good), share)


def _moved(failure: Evaluation, k: int, u: float) -> list[float]:
    point = np.array(failure.point)
    point[k] = u
    moved: list[float] = point.tolist()
    return moved


# --- Scenario files ------------------------------------------------------------------------------

NAMING = ("name", "author", "date")
"""Of a storyboard: says nothing about what happens."""


@dataclass(frozen=True)
class WrittenScenario:
    """The file of a failure.

    Attributes:
        file: relative to the folder of the search; OpenSCENARIO, or a storyboard in JSON where that
            has no words for it.
        command: drives it.
        same: whether what it drives ends in the same collision, bit for bit.
    """

    file: str
    command: str
    same: bool


def write_scenario(
    path: Path, evaluate: Evaluator, found: Evaluation, driven: Driven, *, scene: str
) -> WrittenScenario | None:
    """Write a failure's storyboard, with the road network that it names, read it, and drive it.

    Args:
        path: in the folder of the search, without a suffix.
        evaluate: of the search.
        found: the failure.
        driven: its episode.
        scene: name or path of the scene, for people.

    Returns:
        None where the case is no storyboard, or has options beside it that ``real2sim run`` has
        not.
    """
    space = evaluate.spaces[found.space].storyboard
    if space is None:
        return None
    folder = path.parent
    folder.mkdir(parents=True, exist_ok=True)
    source = write_scenario_file(folder, path.name, space.read(found.values), space.source)
    seconds = ResetSpec.model_validate(found.drive.reset).horizon or 0
    seed = int(found.drive.reset.get("seed", 0))
    board = space.laid_out(read_scenario(source, folder, {}).board)
    options = run_options(board, seed=seed, seconds=seconds / 10)
    if found.drive.operations or not _same_options(options, found.drive.reset):
        (folder / source.file).unlink()
        return None
    planner = found.drive.planner
    again = drive_episode(evaluate.scene, Drive(planner, options), load_planner(planner))
    file = f"{folder.name}/{source.file}"
    command = ["real2sim", "run", file, scene, "--planner", planner]
    command += ["--seconds", f"{seconds / 10:g}", "--seed", str(seed)]
    command += ["--ego", space.source.ego] if space.source.ego else []
    command += ["--as-it-is"] if space.source.as_it_is else []
    return WrittenScenario(file, shlex.join(command), _same(again, driven))


def _same_options(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> bool:
    """Whether two resets are the same episode."""
    return _plain(mine) == _plain(theirs)


def _plain(options: Mapping[str, Any]) -> str:
    fields = ResetSpec.model_validate(options).model_dump(mode="json")
    board = fields["storyboard"] or {}
    for key in NAMING:
        board.pop(key, None)
    # A road network's file is called otherwise beside the scenario.
    if (board.get("roads") or {}).get("kind") == "map":
        board["roads"].pop("file", None)
    return json.dumps(fields, sort_keys=True)


def _same(one: Driven, other: Driven) -> bool:
    """Whether two episodes end at the same instant with everybody at the same places, in the same
    collision."""
    a, b = one.world, other.world
    if a is None or b is None or (a.steps, a.motion) != (b.steps, b.motion):
        return False
    return (
        a.instant.others.ids == b.instant.others.ids
        and np.array_equal(a.instant.others.centres, b.instant.others.centres)
        and one.at_fault
        and other.at_fault
        and impact_of(one) == impact_of(other)
    )


@dataclass(frozen=True, eq=False)
class Failure:
    """An avoidable collision that was the planner's fault.

    Attributes:
        name: of its files.
        found: the evaluation.
        recording: of the planner's episode.
        replays: whether the recording comes out the same, bit for bit.
        avoidable_until: seconds before the impact from which on the reference, taking over from the
            planner, still avoids it; None where it cannot, or plans are not trajectories.
        boundaries: nearest first.
        film: file, or None.
        scenario: its file; None where the case is no storyboard.
    """

    name: str
    found: Evaluation
    recording: Recording
    replays: bool
    avoidable_until: float | None
    boundaries: Sequence[Boundary]
    film: str | None
    scenario: WrittenScenario | None = None

    def fields(self) -> dict[str, Any]:
        """For JSON."""
        found = self.found
        return {
            "name": self.name,
            "cell": list(found.cell or ()),
            "values": dict(found.values),
            "reset": dict(found.drive.reset),
            "operations": [dict(o) for o in found.drive.operations],
            "score": found.score,
            "criticality": found.criticality,
            "implausibility": found.implausibility,
            "impact": dict(found.impact),
            "avoidable_until": self.avoidable_until,
            "boundaries": [dataclasses.asdict(b) for b in self.boundaries],
            "case": f"cases/{self.name}.json",
            "recording": f"recordings/{self.name}.r2e",
            "replays": self.replays,
            "film": self.film,
            "scenario": dataclasses.asdict(self.scenario) if self.scenario else None,
        }
