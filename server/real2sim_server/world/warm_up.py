"""Kernel compilation ahead of the first request."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from real2sim_proto.episode import AgentsSpec, ContactSpec, EgoSpec, ResetSpec
from real2sim_proto.operations import Translate
from real2sim_proto.plans import TrajectoryPlan

from .._numba import is_on_disk, made
from ..edit import ScenarioState
from ..render.types import Instance
from ..scene import Camera, CameraRig, GaussianCloud, Scene, SceneObject, Trajectory
from .collision.bodies import BodyProperties, BodyState, Impact, ImpactParticipant
from .collision.contact import ObstacleGrid
from .collision.deformation import DeformationTracker
from .collision.sweep import StepStart, swept_contacts
from .controller import make_tracker
from .driving import KINDS, PLANNING_AHEAD, advance_vehicle, prepare_schedule
from .ego_motion import Motion
from .plan import PlannedTrajectory, ReferenceTrajectory
from .scoring.comfort import windowed_sum
from .scoring.metric import NONE_AGAINST
from .world import World

PERIOD_US = 100_000
CAR = (4.0, 2.0, 1.5)
DEFORMED_AFTER_US = 20_000
STEPS = 20
"""Number of steps; more than the window of the comfort metrics."""
STEP_KERNELS = 28
"""Number of kernels that :func:`warm_up` compiles."""


@cache
def warm_up() -> None:
    """Compile the kernels of steps and edits, or load them from the disk cache, once per process.

    Runs a small episode that uses all of them.
    """
    made.expect(STEP_KERNELS)
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
    # Kernel for an ego outside its lane.
    world.context.in_lane(world.instant.ego._replace(offset=10.0))
    # Kernel for an ego that drives against its route.
    windowed_sum(NONE_AGAINST, 1.0, 2)
    # Kernel for perfect tracking and sliding vehicles.
    _track(EgoSpec(tracker="perfect"))
    # Ground queries of edits, views and rollouts.
    scene.ground.height(0.0, 0.0)
    scene.ground.height_at([[0.0, 0.0]])
    scene.ground.normal_at([[0.0, 0.0]])
    # This edit moves the cars close together, so that their boxes are compared.
    world.apply([Translate(object_id="ahead", x=-9.0)])


def warm_up_planning() -> None:
    """Like :func:`warm_up`, for trackers that plan ahead (see :func:`plans_ahead`).

    Separate because they take as long as all other kernels and few sessions use them.
    """
    _track(EgoSpec(tracker="ilqr"))


def warm_up_deformation() -> None:
    """Like :func:`warm_up`, for images of deformed objects (see :func:`may_deform`).

    Simulates a car-to-car impact and an impact with the background.
    """
    scene = _street(_filling())
    subjects = {o.object_id: o for o in ScenarioState.of(scene).objects.values()}
    for against_background in (False, True):
        tracker = DeformationTracker(scene)
        tracker = tracker.with_impact(_impact(against_background=against_background), subjects)
        tracker.solve(DEFORMED_AFTER_US)
        drawn = Instance(scene.objects["ahead"].cloud)
        tracker.deformed_instance("ahead", drawn, DEFORMED_AFTER_US)


def kernels_on_disk() -> bool:
    """Whether the disk cache has the slowest kernels of :func:`warm_up`."""
    return is_on_disk(advance_vehicle)


def planning_on_disk() -> bool:
    """Whether the disk cache has the kernels of :func:`warm_up_planning`."""
    return is_on_disk(prepare_schedule)


def deformation_on_disk() -> bool:
    """Whether the disk cache has the kernels of :func:`warm_up_deformation`."""
    from ..physics.backends.cpu.kernels import advance  # Heavy import, only needed for deformation.

    return is_on_disk(advance)


def may_deform(spec: ResetSpec) -> bool:
    """Whether images of an episode may need the kernels of :func:`warm_up_deformation`."""
    return bool(spec.sensors) and spec.on_collision == "continue" and spec.contact.dents


def plans_ahead(ego: EgoSpec) -> bool:
    """Whether a vehicle needs the kernels of :func:`warm_up_planning`."""
    return KINDS.get(ego.tracker) in PLANNING_AHEAD


def _sweep(world: World) -> None:
    """A step next to objects and into the background."""
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


def _impact(*, against_background: bool) -> Impact:
    """An impact of the ego on the rear of object ``ahead``, or of that object on the background."""
    properties = BodyProperties(mass=1500.0, inertia=2500.0, length=4.0, width=2.0)
    behind, ahead = (
        ImpactParticipant(properties, BodyState(x, 0.0, 0.0, speed, 0.0, 0.0), low=0.0, high=1.5)
        for x, speed in ((-2.0, 10.0), (2.0, 0.0))
    )
    return Impact(
        object_id=None if against_background else "ahead",
        other_id="ahead" if against_background else None,
        t_us=0,
        point=(0.0, 0.0),
        normal=(-1.0, 0.0),
        approach_speed=10.0,
        relative_speed=10.0,
        impulse=(-7500.0, 0.0),
        delta_v=5.0,
        object_delta_v=5.0,
        energy=3.75e4,
        participants=(behind, None if against_background else ahead),
    )


def _filling() -> GaussianCloud:
    """Gaussians spread over a car, so that it can be filled with particles."""
    places = np.stack(np.meshgrid(*(np.linspace(-s / 2, s / 2, 9) for s in CAR), indexing="ij"))
    means = torch.from_numpy(places.reshape(3, -1).T.astype(np.float32).copy())
    return _cloud(means)


def _cloud(means: torch.Tensor) -> GaussianCloud:
    count = len(means)
    return GaussianCloud(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.1),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 1, 3),
    )


def _street(of_cars: GaussianCloud | None = None) -> Scene:
    """A scene with one background Gaussian, one car ahead of the ego and one next to it."""
    cloud = _cloud(torch.zeros(1, 3))
    times = np.arange(STEPS + 2) * PERIOD_US
    camera = Camera("front", 16, 16, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4))
    return Scene(
        "warm-up",
        cloud,
        {
            name: SceneObject(name, "car", CAR, of_cars or cloud, _drive(times, *place))
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
