"""Films, still strips and curves of a rollout, and the stored plan of a film."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..._files import atomic_file
from ...geometry import Float, apply_transform, matrix_to_quaternion
from ...physics.colliders import Box, Plane
from ...physics.errors import PhysicsError
from ...render import Instance, RasterOptions, render_cameras
from ...render.images import video_file, write_png
from ...scene import Camera, GaussianCloud
from ..body import BodyMode
from ..result import ENERGIES, Playback, SimulationResult
from .setups import Experiment

# The film's plan, stored next to the result.

FILE = "film.json"
SLAB = (0.3, 2.6, 1.2)
"""Depth, width and height of the visible part of a virtual wall around the focus [m]."""
PITCH = 0.07
"""Spacing of Gaussians on an obstacle [m]."""
THIN = 0.008
"""Thickness of these Gaussians across their face [m]."""
CONCRETE, STEEL = (0.56, 0.55, 0.52), (0.3, 0.33, 0.34)
SLENDER = 0.6
"""Obstacles narrower than this are steel posts [m]."""
SUN = np.array([0.4, 0.3, 0.87])
SH_0 = 0.28209479177387814
Obstacle = tuple[Float, Float]
"""Pose [4, 4] of a box and its size [3] [m]."""


@dataclass(frozen=True, eq=False)
class FilmPlan:
    """Subjects and viewpoints of a film.

    Attributes:
        focus: [3] target point of the near camera, world frame [m].
        side: [3] direction from the focus to the near camera.
        distance: distance of that camera from the focus [m].
        start_us: scene time of the start [us].
        without: objects that are not shown.
        slow: slow-motion factor.
        obstacles: virtual boxes that vehicles run into.
        follows: object that focus and near camera follow; None if they are fixed.
    """

    focus: Float
    side: Float
    distance: float
    start_us: int
    without: frozenset[str] = frozenset()
    slow: float = 1.0
    obstacles: tuple[Obstacle, ...] = ()
    follows: str | None = None

    @classmethod
    def of(cls, experiment: Experiment, height: Callable[[float, float], float]) -> FilmPlan:
        """The plan of an experiment; ``height``: ground height at x, y [m]."""
        solid: list[Obstacle] = []
        for collider in experiment.options.colliders:
            if collider.name in experiment.options.road:
                continue
            if isinstance(collider, Box):
                solid.append((np.asarray(collider.T_world_box), np.asarray(collider.size)))
            elif isinstance(collider, Plane):
                solid.append(_slab(collider, experiment.focus, height))
        return cls(
            experiment.focus,
            experiment.side,
            experiment.distance,
            experiment.options.start_us,
            experiment.without,
            experiment.slow,
            tuple(solid),
            experiment.follows,
        )

    def save(self, folder: Path) -> None:
        """Write FILE into a folder."""
        record = {
            "focus": self.focus.tolist(),
            "side": self.side.tolist(),
            "distance": self.distance,
            "start_us": self.start_us,
            "without": sorted(self.without),
            "slow": self.slow,
            "follows": self.follows,
            "obstacles": [{"pose": p.tolist(), "size": s.tolist()} for p, s in self.obstacles],
        }
        with atomic_file(folder / FILE) as file:
            file.write(json.dumps(record, indent=1).encode())

    @classmethod
    def load(cls, folder: Path) -> FilmPlan:
        """Read the file of :meth:`save`.

        Raises:
            PhysicsError: missing or unreadable file.
        """
        try:
            record: dict[str, Any] = json.loads((folder / FILE).read_text())
            return cls(
                np.array(record["focus"], dtype=np.float64),
                np.array(record["side"], dtype=np.float64),
                float(record["distance"]),
                int(record["start_us"]),
                frozenset(record["without"]),
                float(record["slow"]),
                tuple((np.array(o["pose"]), np.array(o["size"])) for o in record["obstacles"]),
                record.get("follows"),
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise PhysicsError(
                f"{folder / FILE}: no readable film plan ({error}); `real2sim simulate` "
                "writes one next to each result"
            ) from error


def _slab(wall: Plane, focus: Float, height: Callable[[float, float], float]) -> Obstacle:
    """The part of a virtual wall near the focus: behind its surface, on the ground."""
    point, normal = np.asarray(wall.point), np.asarray(wall.normal)
    foot = focus - ((focus - point) @ normal + SLAB[0] / 2) * normal
    pose = np.eye(4)
    across = np.cross([0.0, 0.0, 1.0], normal)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    pose[:3, :3] = np.stack([normal, across, np.cross(normal, across)], axis=1)
    pose[:3, 3] = foot
    pose[2, 3] = height(foot[0], foot[1]) + SLAB[2] / 2
    return pose, np.array(SLAB)


def obstacle_cloud(obstacle: Obstacle) -> GaussianCloud:
    """Gaussians on the faces of a box, world frame: concrete, or steel for slender boxes."""
    pose, size = obstacle
    colour = np.array(STEEL if size[:2].max() < SLENDER else CONCRETE)
    places, turns, lit = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            points = _face(size, axis, side)
            normal = pose[:3, axis] * side
            brightness = 0.55 + 0.5 * max(float(normal @ SUN), 0.0)
            places.append(apply_transform(pose, points))
            turns.append(np.tile(np.roll(pose[:3, :3], 2 - axis, axis=1), (len(points), 1, 1)))
            lit.append(np.full(len(points), brightness))
    means, light = np.concatenate(places), np.concatenate(lit)
    rough = np.random.default_rng(7).normal(1.0, 0.05, (len(means), 1))
    rgb = colour * light[:, None] * rough
    proper = np.concatenate(turns)
    proper[np.linalg.det(proper) < 0, :, 0] *= -1
    n = len(means)
    return GaussianCloud(
        _tensor(means),
        _tensor(matrix_to_quaternion(proper)),
        _tensor(np.tile([0.6 * PITCH, 0.6 * PITCH, THIN], (n, 1))),
        _tensor(np.full(n, 0.98)),
        _tensor(((rgb - 0.5) / SH_0)[:, None, :]),
    )


def _face(size: Float, axis: int, side: float) -> Float:
    """[K, 3] points on one face of a box, box frame."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    grids = [
        (np.arange(max(round(size[a] / PITCH), 1)) + 0.5) / max(round(size[a] / PITCH), 1) - 0.5
        for a in (one, two)
    ]
    u, v = np.meshgrid(grids[0] * size[one], grids[1] * size[two], indexing="ij")
    points = np.zeros((u.size, 3))
    points[:, axis], points[:, one], points[:, two] = side * size[axis] / 2, u.ravel(), v.ravel()
    return points


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32))


Image = NDArray[np.uint8]

RGB_ONLY = RasterOptions(depth=False, instance=False)
FILM_RATE = 15.0
STILLS = 5
HARD_SHARE = 0.05
"""Minimum fraction of the kinetic energy lost between two frames that counts as an impact."""
AFTERWARDS = 0.25
"""Time of the still between the impact and the end, as a fraction of the time from impact to end.
"""
PATH_POSES = 8
"""Number of positions of a moving camera at which occluding background is searched."""
CLEAR = 0.8
"""Radius cleared around a near camera, as a fraction of its distance from the focus."""


@dataclass(frozen=True, eq=False)
class FilmView:
    """A camera of the film.

    Attributes:
        camera: camera in the world: ``T_vehicle_camera`` is ``T_world_camera`` at the start.
        background: the visible part of the background.
        clear: uninvolved objects closer than this are omitted [m]; they would hide the subjects,
            and were not recorded from this distance.
        without: objects that are omitted.
        obstacles: virtual obstacles that vehicles run into.
        moved: [F, 3] displacement of the camera in each frame [m]; None if it is fixed.
    """

    camera: Camera
    background: GaussianCloud
    clear: float = 0.0
    without: frozenset[str] = frozenset()
    obstacles: tuple[GaussianCloud, ...] = ()
    moved: Float | None = None

    def camera_at(self, frame: int) -> Camera:
        """The camera's pose in a frame of the result."""
        if self.moved is None:
            return self.camera
        pose = self.camera.T_vehicle_camera.copy()
        pose[:3, 3] += self.moved[frame]
        return replace(self.camera, T_vehicle_camera=pose)


def views(playback: Playback, plan: FilmPlan, *, width: int | None = None) -> list[FilmView]:
    """The scene's first camera at its initial pose, and a camera near the subjects.

    Args:
        playback: playback to film.
        plan: film plan with the viewpoint.
        width: image width [px]; the recorded one by default.
    """
    scene = playback.scene
    recorded = scene.rig.cameras[0]
    recorded = recorded if width is None else recorded.resized(width)
    stood = recorded.pose(scene.ego.transform(plan.start_us))
    viewer = plan.focus + plan.distance * plan.side / np.linalg.norm(plan.side)
    near = look_at(viewer, plan.focus)
    moved = _moved(playback.result, plan)
    obstacles = tuple(obstacle_cloud(o) for o in plan.obstacles)
    K = np.array(recorded.K)
    K[0, 0] = K[1, 1] = 0.9 * recorded.width
    K[0, 2], K[1, 2] = recorded.width / 2, recorded.height / 2
    return [
        FilmView(
            Camera("scene", recorded.width, recorded.height, np.array(recorded.K), stood),
            scene.background,
            without=plan.without,
            obstacles=obstacles,
        ),
        FilmView(
            Camera("near", recorded.width, recorded.height, K, near),
            _before(scene.background, viewer, moved, plan),
            clear=CLEAR * plan.distance,
            without=plan.without,
            obstacles=obstacles,
            moved=moved,
        ),
    ]


def _moved(result: SimulationResult, plan: FilmPlan) -> Float | None:
    """[F, 3] displacement of the near camera along the road with its subject [m], or None."""
    if plan.follows is None or plan.follows not in result.objects:
        return None
    places = result.objects[plan.follows].positions
    moved: Float = (places - places[0]) * [1.0, 1.0, 0.0]
    return moved


def _before(
    cloud: GaussianCloud, viewer: Float, moved: Float | None, plan: FilmPlan
) -> GaussianCloud:
    """The background without obstructions between the near camera and the focus.

    Removes trees, posts and the like along the camera's path.
    """
    means = cloud.means.detach().cpu().numpy()
    way = np.zeros((1, 3)) if moved is None else moved[:: max(len(moved) // PATH_POSES, 1)]
    near = np.zeros(len(means), dtype=bool)
    for step in way:
        near |= np.linalg.norm(means - (viewer + step), axis=1) < CLEAR * plan.distance
    hides = torch.from_numpy(near & (means[:, 2] > plan.focus[2]))
    return cloud.select(~hides.to(cloud.device))


def look_at(viewer: Float, focus: Float) -> Float:
    """``T_world_camera`` [4, 4] of an upright OpenCV camera at ``viewer`` that faces ``focus``."""
    z = (focus - viewer) / np.linalg.norm(focus - viewer)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = viewer
    return pose


def draw(playback: Playback, shown: Sequence[FilmView], frame: int, backend: str) -> list[Image]:
    """RGB images of a frame, one for each view."""
    images = []
    for view in shown:
        left_out = view.without | _bystanders(playback, view, frame)
        _, *objects = playback.instances(frame, without=left_out)
        obstacles = [Instance(cloud) for cloud in view.obstacles]
        [drawn] = render_cameras(
            [Instance(view.background), *obstacles, *objects],
            [view.camera_at(frame)],
            np.eye(4),
            sky=playback.scene.sky,
            options=RGB_ONLY,
            backend=backend,
        )
        images.append(drawn.rgb)
    return images


def _bystanders(playback: Playback, view: FilmView, frame: int) -> set[str]:
    """Uninvolved objects too near to the view to be shown."""
    t_us, eye = playback.time_us(frame), view.camera_at(frame).T_vehicle_camera[:3, 3]
    return {
        o.object_id
        for o in playback.state.visible
        if o.object_id not in playback.result.objects
        and o.trajectory.covers(t_us)
        and float(np.linalg.norm(o.trajectory.transform(t_us)[:3, 3] - eye))
        < view.clear + o.scaled_size[0] / 2
    }


def write_film(
    playback: Playback,
    shown: Sequence[FilmView],
    folder: Path,
    *,
    slow: float = 1.0,
    backend: str = "auto",
    on_progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write ``film.mp4``, the views side by side, and ``strip.png``, stills row by row.

    Args:
        playback: playback to film.
        shown: views of :func:`views`.
        folder: output folder.
        slow: slow-motion factor.
        backend: renderer backend.
        on_progress: called with (images done, images).

    Raises:
        VideoError: if OpenCV cannot encode.
    """
    result = playback.result
    frame_rate = float(result.figures["frame_rate"])
    stride = max(round(frame_rate / slow / FILM_RATE), 1)
    frames = list(range(0, result.frames, stride))
    stills = _stills(result, frames)
    kept = []
    with video_file(folder / "film.mp4", frames_per_second=frame_rate / slow / stride) as video:
        for done, frame in enumerate(frames):
            images = draw(playback, shown, frame, backend)
            time = float(result.times_s[frame])
            video.add(_captioned(np.concatenate(images, axis=1), time))
            if frame in stills:
                kept.append([_captioned(image, time) for image in images])
            if on_progress is not None:
                on_progress(done + 1, len(frames))
    rows = [np.concatenate([still[c] for still in kept], axis=1) for c in range(len(shown))]
    write_png(folder / "strip.png", np.concatenate(rows, axis=0))


def _stills(result: SimulationResult, frames: Sequence[int]) -> set[int]:
    """Key frames of a film: start, before, at and after the hardest impact, and end."""
    energy = result.energies[:, ENERGIES.index("kinetic")]
    lost = -np.diff(energy[list(frames)])
    hardest = int(lost.argmax()) if len(lost) else 0
    last = len(frames) - 1
    if not len(lost) or lost[hardest] < HARD_SHARE * float(energy.max()):
        return {frames[round(k * last / (STILLS - 1))] for k in range(STILLS)}
    later = hardest + 1 + round(AFTERWARDS * (last - hardest - 1))
    shown = (0, max(hardest - 1, 0), min(hardest + 1, last), later, last)
    return {frames[k] for k in shown}


def draw_curves(result: SimulationResult, path: Path) -> None:
    """Plot speed, height, impulses and energies over time, with deforming phases; PNG or SVG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 7), dpi=110)
    FigureCanvasAgg(figure)
    (speed, height), (impulse, energy) = figure.subplots(2, 2)
    t = result.times_s
    for name, o in result.objects.items():
        [line] = speed.plot(t, np.linalg.norm(o.velocities, axis=1), label=name)
        height.plot(t, o.positions[:, 2], color=line.get_color())
        deforming = o.modes == BodyMode.DEFORMING
        speed.plot(t[deforming], np.zeros(deforming.sum()), ".", ms=3, color=line.get_color())
    for c, contact in enumerate(result.contacts):
        size = np.linalg.norm(result.impulses[:, c], axis=1)
        impulse.plot(t, size * 1e-3, label=f"{contact.object_id} by {contact.other}")
    for k, name in enumerate(ENERGIES):
        values = result.energies[:, k] * 1e-3
        energy.plot(t, values - (values.min() if name == "gravity" else 0), label=name)
    speed.set_ylabel("speed [m/s]; dots: deforming")
    height.set_ylabel("height of box centre [m]")
    impulse.set_ylabel("impulse so far [kN s]")
    energy.set_ylabel("energy [kJ]")
    for axes in (speed, impulse, energy):
        if axes.lines:
            axes.legend(fontsize=7, frameon=False)
    for axes in (speed, height, impulse, energy):
        axes.set_xlabel("time [s]")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _captioned(image: Image, time: float) -> Image:
    import cv2

    picture = np.ascontiguousarray(image)
    for colour, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            picture, f"{time:.2f} s", (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, width, 16
        )
    return picture
