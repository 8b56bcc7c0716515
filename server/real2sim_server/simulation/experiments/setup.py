"""What an experiment is, and what setting one up needs of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import Float
from ...physics.colliders import HeightField
from ...scene import Scene
from ..ground import ground_collider
from ..playback import PlacedObject, PlacedObjects
from ..rollout import SimulateOptions
from .viewing import visibility_of

SIDEWAYS, SLANT_MIN = 2.0, 0.25
"""Near views stand at most so many times as far to the side as the recording saw it from, and at
least so far."""
ROAD_FRICTION = 0.7
CLEARED = 11.0
"""What takes no part is not shown this near to what happens [m]."""
FROM_AHEAD = 0.18
"""By how much a view from the side is from ahead as well."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """A simulation and its camera.

    Attributes:
        name: of the experiment.
        options: what to simulate.
        subjects: objects that are shown.
        focus: [3] point of the world that the near camera faces [m].
        side: [3] direction from the focus to a near-by viewer, unit.
        distance: of that viewer [m].
        without: objects that are not shown.
        slow: how many times slower films show it than it was.
        follows: subject that the near-by viewer moves along with; None: he stays.
    """

    name: str
    options: SimulateOptions
    subjects: tuple[str, ...]
    focus: Float
    side: Float
    distance: float
    without: frozenset[str] = frozenset()
    slow: float = 1.0
    follows: str | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """What an experiment is set up from.

    Attributes:
        scene, state: the scene, and its objects.
        chosen: vehicles that may take part, the best seen first; as ``named`` if they were.
        start_us: scene time [us].
        preset: of the materials.
        speed: [m/s]; None for the experiment's own.
        grids: that objects will be given, see ``ObjectPhysics.grid``.
    """

    scene: Scene
    state: PlacedObjects
    chosen: tuple[PlacedObject, ...]
    named: bool
    start_us: int
    preset: str
    speed: float | None
    grids: tuple[int, ...] = ()


def scene_road(scene: Scene, state: PlacedObjects, t_us: int) -> HeightField:
    """The scene's ground around all objects there at ``t_us`` and around the ego's path."""
    there = [
        o.trajectory.pose(t_us)[0][None, :2] for o in state.visible if o.trajectory.covers(t_us)
    ]
    places = np.concatenate([scene.ego.positions[:, :2], *there])
    return ground_collider(scene.ground, places, friction=ROAD_FRICTION)


def level(direction: Float) -> Float:
    """A direction without its slope, unit."""
    flat = np.array([direction[0], direction[1], 0.0])
    return flat / max(float(np.linalg.norm(flat)), 1e-9)


def viewer(
    scene: Scene, subject: PlacedObject, pose: Float, *, slant: float, rise: float = 0.4
) -> Float:
    """Direction [3] to a viewer on the side and at the end from which it was seen.

    Args:
        slant: how much to the side, against along the subject; less for a side hardly seen.
        rise: how much up.
    """
    x, y, _ = visibility_of(scene, subject).direction
    slant = min(slant, max(SIDEWAYS * abs(y) / max(abs(x), 1e-9), SLANT_MIN))
    along = (1.0 if x >= 0 else -1.0) * level(pose[:3, 0])
    side = (1.0 if y >= 0 else -1.0) * slant * level(np.cross([0, 0, 1], pose[:3, 0]))
    direction: Float = level(along + side) + np.array([0.0, 0.0, rise])
    return direction


def beside(
    scene: Scene,
    subject: PlacedObject,
    pose: Float,
    *,
    ahead: float = FROM_AHEAD,
    rise: float = 0.35,
) -> Float:
    """Direction [3] to a viewer on the side that was seen.

    Args:
        ahead: how much ahead, against to the side; little where what it runs into is broad, so that
            it hides nothing.
        rise: how much up.
    """
    forward = level(pose[:3, 0])
    left = np.cross([0.0, 0.0, 1.0], forward)
    seen = 1.0 if visibility_of(scene, subject).direction[1] >= 0 else -1.0
    direction: Float = seen * left + ahead * forward + np.array([0.0, 0.0, rise])
    return direction


def others_near(request: Request, options: SimulateOptions, focus: Float) -> frozenset[str]:
    """What takes no part and comes near: it would drive through what happens there."""
    times = options.start_us + np.linspace(0, options.duration * 1e6, 5).astype(np.int64)
    return frozenset(
        s.object_id
        for s in request.state.visible
        if s.object_id not in options.objects
        and any(
            np.linalg.norm(s.trajectory.pose(int(t))[0] - focus) < CLEARED
            for t in times
            if s.trajectory.covers(int(t))
        )
    )
