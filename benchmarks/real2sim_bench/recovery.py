"""``real2sim bench recovery``: benefit of recovery data for a planner that learns from images.

The learned planner is trained twice on exports of one scene, with the same number of frames and
epochs: on the recorded path only, and with ``--perturb``. Both drive from the same displaced starts
in the same scene. A planner that follows the known route is the upper bound.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from real2sim.observation import Observation
from real2sim.planners import FollowRoute, LearnedPolicy
from real2sim.planners.learned import PolicyShape
from real2sim_proto.episode import Randomization, ResetSpec, StartRandomization
from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.console import CommandError, print_figures, staged_progress
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.perturbed import Perturbation
from real2sim_server.datasets.plan import ExportPlan
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.policies.cloning import LAYOUT, exported_examples, save_policy, train_network
from real2sim_server.scene import Camera, Scene
from real2sim_server.scene.io import load_scene, read_packed
from real2sim_server.sweeps.episode import draw_frames, observation_of
from real2sim_server.world import World
from real2sim_server.world.common import Draws
from real2sim_server.world.path import LoggedPath

Figures = dict[str, Any]
Report = Callable[[str, int, int], None]

ALONE, WITH, TOLD = "path alone", "with recovery data", "given the route"
COPIES = 4
"""Perturbed copies of each clip."""
CLIP_S, RECOVER_S = 1.0, 2.5
PERIOD_US = 100_000
"""Period of frames and steps [us]."""
AT_ONCE = 16
"""Number of worlds whose images are drawn in one call."""
INSTANTS = 8
"""Number of start times of episodes."""
SEED_STEP = 1_000_003
FAR_SHARE, MAX_DRAWS = 0.75, 100_000
"""Minimum displacement of starts as a fraction of the largest one, and number of seeds to try."""
OFFSET_M, TURNED = 0.5, math.radians(5)
"""Largest offset [m] and heading error [rad] from the recorded path at the end of a successful
episode."""
MIN_PATH_LENGTH = 0.5
"""Minimum distance driven in a successful episode, as a fraction of the recorded one."""


@dataclass(frozen=True)
class RecoveryBenchOptions:
    """Size of the benchmark.

    Attributes:
        scene: scene bundle; None for the demo street.
        episodes: episodes per planner.
        seconds: length of an episode [s].
        plan_s: horizon of plans [s].
        lateral, heading: largest lateral offset [m] and heading offset [rad] of starts.
        epochs: training epochs.
        seed: seed of exports, training and starts.
        camera: camera of the planner.
    """

    scene: Path | None = None
    episodes: int = 64
    seconds: float = 4.0
    plan_s: float = 3.0
    lateral: float = 1.0
    heading: float = math.radians(8)
    epochs: int = 300
    seed: int = 0
    camera: str = "front"


class Planner(Protocol):
    """A planner that drives an episode."""

    def reset(self, obs: Observation) -> None:
        """Called before the first plan."""

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """Called at each step."""
        ...


@dataclass(frozen=True)
class Outcome:
    """Result of an episode.

    Attributes:
        success: whether it returned to the path, without contact and without leaving the road.
        contact, off_road: whether it had a contact, or left the road.
        offset: lateral offset from the path at the end [m].
    """

    success: bool
    contact: bool
    off_road: bool
    offset: float


def run(options: RecoveryBenchOptions | None = None) -> Figures:
    """Export, train, drive, print and return all figures."""
    options = options or RecoveryBenchOptions()
    scene = read_packed(SHIPPED) if options.scene is None else load_scene(options.scene)
    shape = PolicyShape(camera=options.camera)
    figures: Figures = {"scene": scene.name, "episodes of each": options.episodes}
    with tempfile.TemporaryDirectory() as folder, staged_progress() as report:
        trained = _trained(scene, shape, options, Path(folder), report)
        for name, (file, learning) in trained.items():
            driven = partial(report, f"drive: {name}")
            pilots = [LearnedPolicy(file) for _ in range(options.episodes)]
            ends = drive_all(scene, pilots, options, camera=_camera(scene, shape), report=driven)
            figures[name] = _summary(ends) | learning
        told = [FollowRoute(speed=_mean_speed(scene)) for _ in range(options.episodes)]
        figures[TOLD] = _summary(drive_all(scene, told, options))
    share = {name: figures[name]["success"] for name in (ALONE, WITH)}
    figures["gain"] = share[WITH] - share[ALONE]
    print_figures("success from starts off the path", figures)
    return figures


def _trained(
    scene: Scene, shape: PolicyShape, options: RecoveryBenchOptions, folder: Path, report: Report
) -> dict[str, tuple[Path, Figures]]:
    """Weight files and training figures, by name."""
    sets = {}
    for name, plan in _plans(shape, options).items():
        drive = ScenarioDrive(scene, ScenarioState.of(scene))
        label = partial(_only_frames, report, f"export: {name}")
        sets[name] = export_dataset(drive, plan, folder / name, on_progress=label)
    found = {}
    for name, parts in ((ALONE, ["dense"]), (WITH, ["path", "beside"])):
        dataset = exported_examples([sets[part] for part in parts], shape)
        weights, learned = train_network(
            dataset,
            shape,
            epochs=options.epochs,
            seed=options.seed,
            on_progress=partial(report, f"learn: {name}"),
        )
        file = folder / f"{parts[-1]}.safetensors"
        save_policy(weights, shape, file)
        found[name] = (file, {"examples": len(dataset.images), **learned})
    return found


def _plans(shape: PolicyShape, options: RecoveryBenchOptions) -> dict[str, ExportPlan]:
    """Export plans; ``dense`` has as many frames as ``path`` and ``beside`` together."""
    beside = Perturbation(
        lateral_sigma=options.lateral / 2,
        heading_sigma=options.heading / 2,
        recover_s=RECOVER_S,
        copies=COPIES,
    )
    path = ExportPlan(
        formats=(LAYOUT,),
        cameras=(shape.camera,),
        width=2 * shape.width,
        period_us=PERIOD_US,
        clip_s=CLIP_S,
        seed=options.seed,
        flow=False,
    )
    dense = replace(path, period_us=PERIOD_US // (COPIES + 1))
    return {"dense": dense, "path": path, "beside": replace(path, perturb=beside)}


def _only_frames(report: Report, name: str, stage: str, done: int, total: int) -> None:
    if stage == "frames":
        report(name, done, total)


def drive_all(
    scene: Scene,
    planners: Sequence[Planner],
    options: RecoveryBenchOptions,
    *,
    camera: Camera | None = None,
    report: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[Outcome]:
    """Drive one episode per planner; starts are the same in every call.

    Args:
        scene: the recorded scene.
        planners: one planner per episode.
        options: starts and length of episodes.
        camera: camera of the planners; None for planners without images.
        report: callback with (steps done, total).
    """
    worlds = displaced_worlds(scene, len(planners), options)
    steps = worlds[0].horizon
    for step in range(steps):
        for first in range(0, len(worlds), AT_ONCE):
            part = [k for k in range(len(worlds))[first : first + AT_ONCE] if not worlds[k].over]
            seen = _observations([worlds[k] for k in part], camera)
            for k, obs in zip(part, seen, strict=True):
                if step == 0:
                    planners[k].reset(obs)
                worlds[k].step(planners[k].plan(obs))
        report(step + 1, steps)
    return [_outcome(world) for world in worlds]


def displaced_worlds(scene: Scene, count: int, options: RecoveryBenchOptions) -> list[World]:
    """Episodes that start at evenly spaced times, displaced by at least FAR_SHARE of the largest
    offsets and without contact.

    Raises:
        CommandError: the scene is too short, or too few starts are free.
    """
    found: list[World] = []
    for seed in range(options.seed * SEED_STEP, options.seed * SEED_STEP + MAX_DRAWS):
        draws = Draws(seed)
        least = {"start.lateral": options.lateral, "start.heading": options.heading}
        if any(abs(draws.around(w, name, 0)) < FAR_SHARE * w for name, w in least.items()):
            continue
        world = _world(scene, seed, len(found) % INSTANTS, options)
        # If the first draw is occupied, the world draws another.
        if all(abs(world.sampled[name]) >= FAR_SHARE * w for name, w in least.items()):
            found.append(world)
        if len(found) == count:
            return found
    raise CommandError(
        f"{len(found)} of {count} starts {options.lateral:g} m to the side of the path of scene "
        f"{scene.name!r} are free"
    )


def _world(scene: Scene, seed: int, instant: int, options: RecoveryBenchOptions) -> World:
    steps = round(options.seconds * 1e6 / PERIOD_US)
    # Plans must end within the recorded drive: training has no frames beyond it.
    last_us = scene.end_us - round(options.plan_s * 1e6) - steps * PERIOD_US
    if last_us <= scene.start_us:
        seconds = (scene.end_us - scene.start_us) * 1e-6
        raise CommandError(
            f"scene {scene.name!r} is {seconds:.1f} s long; episodes of {options.seconds:g} s and "
            f"plans of {options.plan_s:g} s need more"
        )
    share = instant / (INSTANTS - 1)
    start = StartRandomization(lateral=options.lateral, heading=options.heading)
    spec = ResetSpec(
        seed=seed,
        start_us=scene.start_us + round(share * (last_us - scene.start_us)),
        dt_us=PERIOD_US,
        horizon=steps,
        randomization=Randomization(start=start),
    )
    return World(scene, ScenarioState.of(scene), spec)


def _observations(worlds: Sequence[World], camera: Camera | None) -> list[Observation]:
    """Observations of the worlds, like those of sessions."""
    blind = [observation_of(world) for world in worlds]
    if camera is None or not worlds:
        return blind
    frames = zip(blind, draw_frames(worlds, camera), strict=True)
    return [replace(obs, frames={camera.name: {"rgb": frame}}) for obs, frame in frames]


def _outcome(world: World) -> Outcome:
    motion, start_us = world.motion, world.spec.start_us or 0
    near = world.route.nearest(motion.x, motion.y)
    turned = math.remainder(motion.yaw - near.yaw, math.tau)
    start, end = (world.scene.ego.pose(t)[0] for t in (start_us, world.t_us))
    recorded = float(np.linalg.norm(np.subtract(end, start)[:2]))
    contact, off_road = world.terminated, world.accumulator.off_road
    back = abs(near.offset) <= OFFSET_M and abs(turned) <= TURNED
    on = world.accumulator.distance >= MIN_PATH_LENGTH * recorded
    return Outcome(not contact and not off_road and back and on, contact, off_road, near.offset)


def _summary(ends: Sequence[Outcome]) -> Figures:
    return {
        "success": sum(end.success for end in ends) / len(ends),
        "contact": sum(end.contact for end in ends) / len(ends),
        "off_road": sum(end.off_road for end in ends) / len(ends),
        "offset_median_m": float(np.median([abs(end.offset) for end in ends])),
    }


def _camera(scene: Scene, shape: PolicyShape) -> Camera:
    return scene.rig[shape.camera].resized(2 * shape.width)


def _mean_speed(scene: Scene) -> float:
    seconds = (scene.end_us - scene.start_us) * 1e-6
    return LoggedPath(scene.ego).length / seconds
