"""A complete search: replayable failures, their description, and a page."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._files import atomic_file
from ..console import CommandError
from ..policies.page import film_episode
from ..policies.planner_process import PLAN_LIMIT_S
from ..scene import Scene
from ..scene.io import open_scene
from ..world.recording import first_difference, save_recording
from .episode import Driven, recording_of
from .evaluation import REFUSED, Evaluation, Evaluator, drive_reference
from .failure import Failure, boundaries, render_page, write_scenario
from .optimise import SearchBudget, SearchState, search
from .parameters import drawn_parameters
from .spec import Space
from .sweep import check_planners, open_journal

# --- Statistics ----------------------------------------------------------------------------------

# Importance of the parameters, and failure probability of a space.

Array = NDArray[np.float64]
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class Probability:
    """Failure probability of sampled points, with a 95 % interval.

    Attributes:
        value, low, high: estimate and interval.
        how: description of the method.
        episodes: number of episodes.
    """

    value: float
    low: float
    high: float
    how: str
    episodes: int


def wilson(failures: int, episodes: int) -> Probability:
    """Failure probability of independent episodes (Wilson 1927).

    Examples:
        >>> found = wilson(0, 100)
        >>> found.low, round(found.high, 3)
        (0.0, 0.037)
    """
    p, n, z = failures / episodes, episodes, NORMAL_95
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    low = 0.0 if failures == 0 else max(middle - half, 0.0)
    high = 1.0 if failures == episodes else min(middle + half, 1.0)
    return Probability(p, low, high, "independent episodes, Wilson", episodes)


def splitting(
    score: Callable[[Array], float],
    dimensions: int,
    *,
    level: float = 0.0,
    particles: int = 50,
    seed: int = 0,
    most_episodes: int = 2000,
    moves: int = 3,
) -> Probability:
    """Adaptive multilevel splitting (Cerou and Guyader 2007), for events too rare to sample.

    The lowest tenth of the particles is replaced by random continuations of others above its level,
    until all are above ``level``. Moves preserve the uniform distribution of the space.

    Args:
        score: function of a point with coordinates from 0 to 1; higher is closer to a failure.
        dimensions: number of coordinates.
        level: minimum score of a failure.
        particles: number of particles, at least 10.
        seed: seed of all random numbers.
        most_episodes: maximum number of episodes; if it is reached, the estimate is an upper bound.
        moves: attempts per new particle.
    """
    from scipy.special import ndtr, ndtri

    rng, used = np.random.default_rng(seed), 0

    def scored(z: Array) -> float:
        nonlocal used
        used += 1
        return score(np.asarray(ndtr(z), np.float64))

    places = np.asarray(ndtri(rng.random((particles, dimensions))), np.float64)
    values = np.array([scored(z) for z in places])
    logarithm, step, lowest = 0.0, 0.5, max(particles // 10, 1)
    while used < most_episodes and (values < level).any():
        threshold = min(float(np.sort(values)[lowest - 1]), level)
        out = values <= threshold if threshold < level else values < level
        if out.all():
            break
        logarithm += math.log1p(-out.sum() / particles)
        alive = np.flatnonzero(~out)
        for k in np.flatnonzero(out):
            source = int(rng.choice(alive))
            z, value, accepted = places[source], values[source], 0
            for _ in range(moves):
                # A Crank-Nicolson step preserves the normal distribution.
                tried = math.sqrt(1 - step * step) * z + step * rng.standard_normal(dimensions)
                if (found := scored(tried)) > threshold:
                    z, value, accepted = tried, found, accepted + 1
            places[k], values[k] = z, value
            step = min(max(step * (1.1 if accepted > moves / 2 else 0.95), 0.05), 0.9)
    share = float((values >= level).mean())
    estimate = math.exp(logarithm) * share
    spread = NORMAL_95 * math.sqrt(max(-logarithm, 1e-9) / particles)
    how = "adaptive multilevel splitting"
    if share == 0.0:
        bound = math.exp(logarithm)
        return Probability(0.0, 0.0, bound, f"{how}, not reached: an upper bound", used)
    low, high = estimate * math.exp(-spread), min(estimate * math.exp(spread), 1.0)
    return Probability(estimate, low, high, how, used)


def sobol_indices(
    points: Sequence[Sequence[float]],
    scores: Sequence[float],
    names: Sequence[str],
    *,
    seed: int = 0,
) -> dict[str, tuple[float, float]]:
    """First-order and total Sobol indices of a surrogate through episodes, by parameter.

    The surrogate is a smoothed thin-plate spline through the driven points. If these are unevenly
    distributed, as after a search, the indices describe the surrogate. Empty for too few episodes.
    """
    from scipy import stats
    from scipy.interpolate import RBFInterpolator

    where, values = np.array(points), np.array(scores)
    where, first = np.unique(where.round(9), axis=0, return_index=True)
    values = values[first]
    if len(where) < 4 * len(names) + 4 or np.ptp(values) < 1e-9 or not names:
        return {}
    surrogate = RBFInterpolator(where, values, smoothing=1e-2, neighbors=min(len(where), 100))
    indices = stats.sobol_indices(
        func=lambda x: surrogate(np.clip(x.T, 0.0, 1.0)).reshape(1, -1),
        n=512,
        dists=[stats.uniform()] * len(names),
        rng=np.random.default_rng(seed),
    )
    both = np.clip(
        np.stack([np.ravel(indices.first_order), np.ravel(indices.total_order)], axis=1), 0.0, 1.0
    )
    return {n: (float(f), float(t)) for n, (f, t) in zip(names, both, strict=True)}


FAILURES, PAGE, JOURNAL = "failures.json", "failures.html", "search.journal"
TAKE_OVERS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Take-over times of the reference before an impact [s]."""
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class SearchOptions:
    """Options beyond the search itself.

    Attributes:
        budget: budget of the search itself.
        shrink: number of failures, worst first, to find boundaries for.
        probability: episodes for estimating the at-fault probability of each space; 0 skips it.
        films: number of failures, worst first, to film.
        film_width: width of films [px].
        scenes: folder of bundles.
        plan_limit_s: time limit for each answer of the planner [s].
    """

    budget: SearchBudget = field(default_factory=SearchBudget)
    shrink: int = 3
    probability: int = 0
    films: int = 0
    film_width: int = 480
    scenes: Path | None = None
    plan_limit_s: float = PLAN_LIMIT_S


def run_search(
    spaces: Sequence[Space],
    planner: str,
    out: Path,
    options: SearchOptions | None = None,
    *,
    on_progress: Report = lambda _stage, _done, _total: None,
) -> dict[str, Any]:
    """Search spaces of one scene for a planner's avoidable failures, and write the findings.

    Episodes that are already in the journal of the folder are not driven again; what is found
    depends neither on them nor on interruptions of the search.

    Returns:
        Contents of ``failures.json``, and ``driven_now``, the number of newly driven episodes.

    Raises:
        CommandError: spaces of several scenes, an unsuitable planner, or no such scene.
    """
    options = options or SearchOptions()
    scene = _scene_of(spaces, options.scenes)
    limit_s = options.plan_limit_s
    check_planners([planner], scene, limit_s)
    journal = open_journal(out / JOURNAL)
    known = len(journal.rows)
    evaluate = Evaluator(scene, spaces, planner, journal=journal, plan_limit_s=limit_s)
    with journal, contextlib.closing(evaluate):
        state = search(
            evaluate, options.budget, on_progress=lambda d, t: on_progress("search", d, t)
        )
        found = state.archive.ordered()
        failures = []
        for k, one in enumerate(found):
            failures.append(_failure(evaluate, one, k, out, options))
            on_progress("failures", k + 1, len(found))
        odds = _probabilities(evaluate, options, on_progress)
    report = _report(evaluate, state, failures, odds, options)
    with atomic_file(out / FAILURES) as file:
        file.write(json.dumps(report, indent=2, allow_nan=False).encode())
    with atomic_file(out / PAGE) as file:
        file.write(render_page(report, failures).encode())
    return {**report, "driven_now": len(journal.rows) - known}


def _scene_of(spaces: Sequence[Space], folder: Path | None) -> Scene:
    names = list(dict.fromkeys(s.case.scene or "" for s in spaces))
    if len(names) != 1:
        raise CommandError(
            f"a search needs a single scene; the spaces name {', '.join(names) or 'none'}"
        )
    return open_scene(names[0], folder)


def _failure(
    evaluate: Evaluator, found: Evaluation, number: int, out: Path, options: SearchOptions
) -> Failure:
    """Record a failure, write its scenario file, shrink it and film it."""
    name = f"failure_{number + 1:02d}"
    driven = evaluate.drive(found.drive, keep_entries=True, keep_worlds=True)
    recording = recording_of(evaluate.scene, driven)
    save_recording(recording, out / "recordings" / f"{name}.r2e")
    case = evaluate.spaces[found.space].case_at(found.values)
    fields = case.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    with atomic_file(_made(out / "cases") / f"{name}.json") as file:
        file.write(json.dumps({"cases": [fields | {"name": name}]}, indent=2).encode())
    film = None
    if number < options.films:
        film = f"films/{name}.mp4"
        again = recording.replayer(evaluate.scene)
        path, poster = (_made(out / "films") / f"{name}{suffix}" for suffix in (".mp4", ".jpg"))
        film_episode(
            recording, again, evaluate.scene, path, width=options.film_width, poster=poster
        )
    edges = boundaries(evaluate, found) if number < options.shrink else []
    replays = first_difference(recording, recording.replayer(evaluate.scene)) is None
    scene = _scene_path(evaluate.spaces[0].case.scene or "", options.scenes)
    scenario = write_scenario(out / "scenarios" / name, evaluate, found, driven, scene=scene)
    until = _avoidable_until(driven)
    return Failure(name, found, recording, replays, until, edges, film, scenario)


def _scene_path(name: str, folder: Path | None) -> str:
    """The scene argument for `real2sim run`."""
    below = folder / name if folder is not None else None
    return str(below) if below is not None and below.is_dir() else name


def _avoidable_until(driven: Driven) -> float | None:
    """Latest take-over by the reference that avoids the impact, in seconds before it.

    None if none of the tried times avoids it, or if plans are not trajectories.
    """
    for before in TAKE_OVERS:
        assert driven.world is not None
        step = len(driven.worlds) - round(before / driven.world.context.dt)
        if step < 0 or driven.world.spec.action != "trajectory":
            return None
        if drive_reference(driven.worlds[step].fork()).survived:
            return before
    return None


def _probabilities(
    evaluate: Evaluator, options: SearchOptions, on_progress: Report
) -> list[Probability | None]:
    """Probability of at-fault collisions in each space under its distributions.

    Estimated from independent episodes, and by splitting if none of them fails.
    """
    if not options.probability:
        return [None] * len(evaluate.spaces)
    found: list[Probability | None] = []
    rng = np.random.default_rng([options.budget.seed, 1])
    for space in range(len(evaluate.spaces)):
        dimensions, failures, episodes = evaluate.dimensions(space), 0, 0
        for k in range(options.probability):
            one = evaluate(space, rng.random(dimensions))
            failures, episodes = failures + one.at_fault, episodes + (one.error is None)
            on_progress("probability", k + 1, options.probability)
        if not episodes:
            found.append(None)
            continue
        odds = wilson(failures, episodes)
        if failures == 0:
            rare = splitting(
                lambda u, space=space: _danger(evaluate(space, u)),  # type: ignore[misc]
                dimensions,
                seed=options.budget.seed,
                particles=max(options.probability // 4, 10),
                most_episodes=4 * options.probability,
            )
            odds = rare if rare.value > 0 else odds
        found.append(odds)
    return found


def _danger(found: Evaluation) -> float:
    """Criticality, at least 0 for every at-fault collision, avoidable or not."""
    return max(found.criticality, 0.0) if found.at_fault else min(found.criticality, -1e-9)


def _report(
    evaluate: Evaluator,
    state: SearchState,
    failures: Sequence[Failure],
    odds: Sequence[Probability | None],
    options: SearchOptions,
) -> dict[str, Any]:
    """Contents of failures.json."""
    at_fault = [e for e in state.evaluations if e.at_fault]
    errors = [e.error for e in state.evaluations if e.error is not None]
    return {
        "format": "real2sim-failures",
        "version": 1,
        "planner": evaluate.planner,
        "scene": evaluate.scene.name,
        "scene_hash": evaluate.scene.content_hash,
        "seed": options.budget.seed,
        "episodes": len(state.evaluations),
        "planner_failed": len(errors),
        "first_error": errors[0] if errors else None,
        "first_failure": state.archive.first,
        "at_fault": len(at_fault),
        "avoidable": sum(e.is_failure for e in at_fault),
        "cells": len(state.archive.elites),
        "failures": [f.fields() for f in failures],
        "spaces": [_space_fields(evaluate, state, k, odds[k]) for k in range(len(evaluate.spaces))],
    }


def _space_fields(
    evaluate: Evaluator, state: SearchState, number: int, odds: Probability | None
) -> dict[str, Any]:
    space = evaluate.spaces[number]
    mine = [e for e in state.evaluations if e.space == number and e.score > REFUSED]
    names = list(drawn_parameters(space.parameters))
    indices = sobol_indices([e.point for e in mine], [e.criticality for e in mine], names)
    return {
        "name": space.case.name,
        "episodes": len(mine),
        "failures": sum(e.is_failure for e in mine),
        "sobol": {n: {"first": a, "total": b} for n, (a, b) in indices.items()},
        "probability": None if odds is None else dataclasses.asdict(odds),
    }


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
