"""``real2sim bench search``: episodes to the first avoidable failure of a planner, searched for and
drawn at random, and how many kinds a whole search finds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.planners import load_planner

from ..console import print_figures, staged_progress
from ..scene import Scene
from ..sweeps.episode import drive_episode, recording_of
from ..sweeps.scenes import open_scene
from ..sweeps.search.evaluation import Evaluation, Evaluator
from ..sweeps.search.optimise import SearchBudget, SearchState, random_search, search
from ..sweeps.spec import load_space
from ..world import warm_up
from ..world.recording.recording import first_difference

Figures = dict[str, Any]

CASES: Mapping[str, str] = {
    "idm": "cut_in_broad",
    "follow_route": "cut_in_broad",
    "pid": "cut_in_calm",
}
"""In which space each planner is tested: one in which it fails once in hundreds of times."""
LEARNED_SPACE = "cut_in_brief"
ALL_SPACES = ("cut_in", "hard_brake", "junction_crossing", "oncoming", "slow_crossing")
WHOLE_FOR = "follow_route"


@dataclass(frozen=True)
class SearchBenchOptions:
    """How much is measured.

    Attributes:
        episodes: at most, of each search.
        seeds: of each planner.
        policy: weights of a trained planner, as of `train-policy`; None leaves it out.
        planners: by name, beside the trained one.
        whole: whether all spaces are searched with all episodes for the kinds of failures.
    """

    episodes: int = 300
    seeds: int = 5
    policy: Path | None = None
    whole: bool = True
    planners: tuple[str, ...] = tuple(CASES)


def run(options: SearchBenchOptions | None = None) -> Figures:
    """Search, draw at random, print and return all figures."""
    options = options or SearchBenchOptions()
    warm_up()
    scene, figures = open_scene("demo_street"), Figures()
    cases = {planner: CASES[planner] for planner in options.planners}
    if options.policy is not None:
        cases[f"learned={options.policy}"] = LEARNED_SPACE
    with staged_progress() as report:
        for number, (planner, space) in enumerate(cases.items()):
            name = planner.partition("=")[0]
            figures[f"{name} in {space}"] = _compared(scene, planner, space, options)
            report("planners", number + 1, len(cases))
        if options.whole:
            figures[f"{WHOLE_FOR} in all spaces"] = _whole(scene, options)
    print_figures("episodes to the first avoidable failure", figures)
    return figures


def _compared(scene: Scene, planner: str, space: str, options: SearchBenchOptions) -> Figures:
    begun = time.process_time()
    ways: Mapping[str, Callable[[Evaluator, SearchBudget], SearchState]] = {
        "search": search,
        "random": random_search,
    }
    found: Figures = {}
    for way, look in ways.items():
        firsts = []
        for seed in range(options.seeds):
            budget = SearchBudget(options.episodes, seed, stop_at_first=True)
            state = look(Evaluator(scene, [load_space(space)], planner), budget)
            # One that found none needs more than all episodes.
            firsts.append(state.archive.first or options.episodes + 1)
        found[way] = firsts
    medians = {way: float(np.median(found[way])) for way in ways}
    return {
        **found,
        "median search": medians["search"],
        "median random": medians["random"],
        "search : random": medians["search"] / medians["random"],
        "cpu_s": time.process_time() - begun,
    }


def _whole(scene: Scene, options: SearchBenchOptions) -> Figures:
    spaces = [load_space(name) for name in ALL_SPACES]
    state = search(Evaluator(scene, spaces, WHOLE_FOR), SearchBudget(options.episodes, 0))
    at_fault = sum(e.at_fault for e in state.evaluations)
    return {
        "episodes": len(state.evaluations),
        "at fault": at_fault,
        "avoidable share": sum(e.is_failure for e in state.evaluations) / max(at_fault, 1),
        "cells": len(state.archive.elites),
        "replay to the same collision": sum(
            _replays(scene, e) for e in state.archive.elites.values()
        ),
    }


def _replays(scene: Scene, found: Evaluation) -> bool:
    """Whether a failure's recording comes out the same, bit for bit, its collision at the end."""
    planner = load_planner(found.drive.planner)
    recording = recording_of(scene, drive_episode(scene, found.drive, planner, keep_entries=True))
    same = first_difference(recording, recording.replayer(scene)) is None
    return same and sum(recording.accumulators()[-1].at_fault.values()) == 1
