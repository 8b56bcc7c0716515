"""A failure as a scenario file that ``real2sim run`` drives to the same collision."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.planners import load_planner
from real2sim_proto.episode import ResetSpec

from ..episode import Drive, Driven, drive_episode
from ..storyboard_space import read_scenario, run_options, write_scenario_file
from .evaluation import Evaluation, Evaluator, impact_of

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
