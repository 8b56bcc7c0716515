"""Compiles the kernels of a step and of an edit before the first request needs them."""

from __future__ import annotations

import numpy as np
import torch

from real2sim_proto.episode import AgentsSpec, ContactSpec, EgoSpec, ResetSpec
from real2sim_proto.operations import Translate
from real2sim_proto.plans import TrajectoryPlan

from .._numba import is_on_disk
from ..edit import ScenarioState
from ..scene import Camera, CameraRig, GaussianCloud, Scene, SceneObject, Trajectory
from .collision.obstacles import ObstacleGrid
from .collision.sweep import StepStart, swept_contacts
from .driving import KINDS, PLANNING_AHEAD, advance_vehicle, prepare_schedule
from .ego.motion import Motion
from .ego.reference import PlannedTrajectory, ReferenceTrajectory
from .ego.trackers import make_tracker
from .world import World

PERIOD_US = 100_000
STEPS = 20
"""More than fill the window of the comfort metrics."""


def warm_up() -> None:
    """Compile the kernels of a step and of an edit, or load them from the disk cache.

    A small episode uses them all: afterwards neither waits for the compiler.
    """
    scene = _street()
    spec = ResetSpec(
        dt_us=PERIOD_US,
        on_collision="continue",
        contact=ContactSpec(background=False),
        agents=AgentsSpec(default="idm"),
    )
    world = World(scene, ScenarioState.of(scene), spec)
    for _ in range(STEPS):
        times = tuple(world.t_us + k * PERIOD_US for k in range(1, 11))
        x, y, yaw = world.motion.x, world.motion.y, world.motion.yaw
        poses = [(x + 0.1 * k, y, yaw) for k in range(1, 11)]
        world.step(TrajectoryPlan(times_us=times, poses=poses, frame="world"))
        world.observe()
    _sweep(world)
    # Which lane an ego is in that has left its own.
    world.context.in_lane(world.instant.ego._replace(offset=10.0))
    # What only perfect tracking and sliding vehicles call.
    _track(EgoSpec(tracker="perfect"))
    # What edits, views and rollouts ask of the ground.
    scene.ground.height(0.0, 0.0)
    scene.ground.height_at([[0.0, 0.0]])
    scene.ground.normal_at([[0.0, 0.0]])
    # An edit that brings the cars near each other, for only then their boxes are compared.
    world.apply([Translate(object_id="ahead", x=-9.0)])


def warm_up_planning() -> None:
    """Like :func:`warm_up`, for trackers that plan ahead: they take as long as all the rest, and
    few sessions have one, see :func:`plans_ahead`."""
    _track(EgoSpec(tracker="ilqr"))


def kernels_on_disk() -> bool:
    """Whether an earlier run left what :func:`warm_up` compiles longest."""
    return is_on_disk(advance_vehicle)


def planning_on_disk() -> bool:
    """Whether an earlier run left what :func:`warm_up_planning` compiles."""
    return is_on_disk(prepare_schedule)


def plans_ahead(ego: EgoSpec) -> bool:
    """Whether a vehicle needs what :func:`warm_up_planning` compiles."""
    return KINDS.get(ego.tracker) in PLANNING_AHEAD


def _sweep(world: World) -> None:
    """A step beside objects and into the background."""
    start = StepStart(
        world.motion, world.T_world_vehicle, world.agents, t_us=0, dt_us=PERIOD_US, at=None
    )
    swept_contacts(
        start,
        world.motion,
        world.T_world_vehicle,
        world.agents,
        spec=world.spec,
        ego_size=world.scene.ego_size,
        obstacles=ObstacleGrid(np.array([-50.0, -50.0]), np.ones((400, 400), np.bool_)),
        before=frozenset(),
    )


def _track(ego: EgoSpec) -> None:
    """Half a step and a command of a tracker."""
    motion = Motion(0.0, 0.0, 0.0, speed=1.0)
    trajectory = PlannedTrajectory.of([PERIOD_US], [(1.0, 0.0, 0.0)], (0.0, 0.0, 0.0))
    ahead = ReferenceTrajectory(motion, start_us=0, trajectory=trajectory, spec=ego)
    tracker = make_tracker(ahead, ego)
    tracker.command(tracker.advance(motion, 0.0, PERIOD_US // 2), 0.0)


def _street() -> Scene:
    """The ego behind one car and beside another, touching neither, in a scene of one Gaussian."""
    cloud = GaussianCloud(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.1),
        opacities=torch.full((1,), 0.5),
        sh=torch.zeros(1, 1, 3),
    )
    times = np.arange(STEPS + 2) * PERIOD_US
    camera = Camera("front", 16, 16, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4))
    return Scene(
        "warm-up",
        cloud,
        {
            name: SceneObject(name, "car", (4.0, 2.0, 1.5), cloud, _drive(times, *place))
            for name, place in {"ahead": (12.0, 0.0), "beside": (1.0, 3.0)}.items()
        },
        None,
        CameraRig((camera,)),
        _drive(times, 0.0, 0.0),
        times,
    )


def _drive(times_us: np.ndarray, x: float, y: float) -> Trajectory:
    """Straight on at 1 m/s from (x, y) [m]."""
    positions = np.zeros((len(times_us), 3))
    positions[:, 0], positions[:, 1] = x + times_us * 1e-6, y
    return Trajectory(times_us, positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(times_us), 1)))
