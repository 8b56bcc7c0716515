"""``real2sim bench search``: episodes to the first avoidable failure of a planner, for search and
random sampling, and the number of failure kinds that a complete search finds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.planners import load_planner
from real2sim_server.console import print_figures, staged_progress
from real2sim_server.scene import Scene
from real2sim_server.scene.io import open_scene
from real2sim_server.sweeps.episode import drive_episode, recording_of
from real2sim_server.sweeps.evaluation import Evaluation, Evaluator
from real2sim_server.sweeps.optimise import SearchBudget, SearchState, random_search, search
from real2sim_server.sweeps.search import wilson
from real2sim_server.sweeps.spec import load_space
from real2sim_server.world import warm_up
from real2sim_server.world.recording import first_difference

Figures = dict[str, Any]

CASES: Mapping[str, str] = {
    "idm": "cut_in_everyday",
    "follow_route": "cut_in_everyday",
    "pid": "cut_in_calm",
    "learned": "cut_in_brief",
}
"""Test space of each planner, in which it fails about once in hundreds of episodes."""
LEARNED = "learned"
ALL_SPACES = ("cut_in", "hard_brake", "junction_crossing", "oncoming", "slow_crossing")


@dataclass(frozen=True)
class SearchBenchOptions:
    """Size of the benchmark.

    Attributes:
        episodes: maximum episodes per search.
        seeds: number of seeds per planner.
        first_seed: first seed. The spaces were chosen with seeds from 1000 on.
        policy: weights of the learned planner from `train-policy`; None skips it.
        planners: names of planners.
        whole: complete searches per planner over all spaces, for the kinds of failures.
    """

    episodes: int = 300
    seeds: int = 5
    first_seed: int = 0
    policy: Path | None = None
    whole: int = 1
    planners: tuple[str, ...] = tuple(CASES)

    @property
    def all_seeds(self) -> range:
        """Seeds of the searches."""
        return range(self.first_seed, self.first_seed + self.seeds)


def run(options: SearchBenchOptions | None = None) -> Figures:
    """Run search and random sampling; print and return all figures."""
    options = options or SearchBenchOptions()
    warm_up()
    scene, figures = open_scene("demo_street"), Figures()
    names = [n for n in options.planners if n != LEARNED or options.policy is not None]
    with staged_progress() as report:
        for number, name in enumerate(names):
            planner, space = name, CASES[name]
            if name == LEARNED:
                planner = f"{LEARNED}={options.policy}"
            if options.seeds:
                figures[f"{name} in {space}"] = _compared(scene, planner, space, options)
            if options.whole:
                figures[f"{name} in all spaces"] = _whole(scene, planner, options)
            report("planners", number + 1, len(names))
    print_figures("episodes to the first avoidable failure", figures)
    return figures


def _compared(scene: Scene, planner: str, space: str, options: SearchBenchOptions) -> Figures:
    begun = time.process_time()
    ways: Mapping[str, Callable[[Evaluator, SearchBudget], SearchState]] = {
        "search": search,
        "random": random_search,
    }
    firsts: dict[str, list[int]] = {way: [] for way in ways}
    drawn = failed = 0
    for seed in options.all_seeds:
        for way, look in ways.items():
            budget = SearchBudget(options.episodes, seed, stop_at_first=True)
            state = look(Evaluator(scene, [load_space(space)], planner), budget)
            # A search without failures counts as one more than all episodes.
            firsts[way].append(state.archive.first or options.episodes + 1)
        drawn, failed = drawn + len(state.evaluations), failed + (state.archive.first is not None)
    medians = {way: float(np.median(found)) for way, found in firsts.items()}
    # Sampling stops at the first failure; failures / draws is the maximum likelihood rate.
    odds = wilson(failed, drawn)
    return {
        **firsts,
        "median search": medians["search"],
        "median random": medians["random"],
        "search : random": medians["search"] / medians["random"],
        "random points": drawn,
        "failures among them": failed,
        "failure rate": odds.value,
        "failure rate, 95 %": [odds.low, odds.high],
        "cpu_s": time.process_time() - begun,
    }


def _whole(scene: Scene, planner: str, options: SearchBenchOptions) -> Figures:
    """Number of failure kinds that complete searches find, by seed."""
    spaces = [load_space(name) for name in ALL_SPACES]
    rows: list[Figures] = []
    for seed in range(options.first_seed, options.first_seed + options.whole):
        evaluate = Evaluator(scene, spaces, planner)
        state = search(evaluate, SearchBudget(options.episodes, seed))
        at_fault = sum(e.at_fault for e in state.evaluations)
        elites = state.archive.elites.values()
        rows.append(
            {
                "episodes": len(state.evaluations),
                "at fault": at_fault,
                "avoidable share": sum(e.is_failure for e in state.evaluations) / max(at_fault, 1),
                "cells": len(elites),
                "replay to the same collision": sum(_replays(scene, e) for e in elites),
            }
        )
    return {name: [row[name] for row in rows] for name in rows[0]}


def _replays(scene: Scene, found: Evaluation) -> bool:
    """Whether the replay of a failure is bitwise equal to its recording and ends in a collision."""
    planner = load_planner(found.drive.planner)
    recording = recording_of(scene, drive_episode(scene, found.drive, planner, keep_entries=True))
    same = first_difference(recording, recording.replayer(scene)) is None
    return same and sum(recording.accumulators()[-1].at_fault.values()) == 1
