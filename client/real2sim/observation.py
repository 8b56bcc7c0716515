"""Observations of the drive loop, and views rendered between its steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.base import Named

from ._handles import Handle
from .clouds import LidarCloud, PointCloud, RadarCloud, clouds_by_sensor
from .errors import MalformedReplyError
from .images import Frame, frames_by_camera

if TYPE_CHECKING:
    from real2sim_proto.drive import AgentState, EgoState, Event, LaneShown, Obs, SignalShown
    from real2sim_proto.drive import Frame as WireFrame
    from real2sim_proto.drive import PointCloud as WireCloud

C = TypeVar("C", bound=PointCloud)

Frames = Mapping[str, Mapping[str, Frame]]
"""Frames by camera, then by modality."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View(Handle):
    """Images of one committed instant.

    Attributes:
        t_us: time of the images.
        revision: revision of the session's edits.
        frames: frames by camera and modality.
        clouds: point clouds by LiDAR or radar.
        timing: milliseconds by stage, measured by the worker.

    Examples:
        >>> client = real2sim.connect()
        >>> with client.session(scene="street") as session:
        ...     obs = session.reset()
        ...     view = session.render(["left"])
        >>> sorted(view.frames), view.t_us
        (['left'], 0)
    """

    _instead: ClassVar = {
        "cameras": "obs.frames",
        "depth": 'obs.image("front", "depth"), with modalities=["depth"] of the sensor',
        "images": 'obs.frames, or obs.image("front")',
        "instance": 'obs.image("front", "instance"), with modalities=["instance"] of the sensor',
        "points": 'obs.lidar("vlp-16").points',
        "rgb": 'obs.image("front")',
        "semantic": 'obs.image("front", "semantic"), with modalities=["semantic"] of the sensor',
        "sensors": "obs.frames and obs.clouds",
        "t": "obs.t_us / 1e6 (seconds)",
        "time": "obs.t_us (microseconds)",
        "timestamp": "obs.t_us (microseconds)",
    }

    t_us: int
    revision: int
    frames: Frames = field(repr=False)
    clouds: Mapping[str, PointCloud] = field(default_factory=dict, repr=False)
    timing: Mapping[str, float] = field(default_factory=dict, repr=False)

    def image(self, camera: str | None = None, modality: str = "rgb") -> NDArray[Any]:
        """The decoded image of a camera, e.g. rgb: uint8 [H, W, 3]; ``obs["front"]`` is its rgb.

        Args:
            camera: its name; default: the only one.
            modality: a modality of the sensor.

        Raises:
            KeyError: no such frame; the message names the available ones.

        Examples:
            >>> view.image("left").shape
            (64, 96, 3)
        """
        if camera is None and len(self.frames) == 1:
            (camera,) = self.frames
        try:
            return self.frames[str(camera)][modality].array
        except KeyError:
            there = ", ".join(f"{c}/{m}" for c, ms in self.frames.items() for m in ms) or "none"
            raise KeyError(
                f"no frame {camera}/{modality} at {self.t_us} us; there: {there}. Pass "
                "sensors=[...] to reset; in a planner class for `real2sim drive`, write "
                f"`needs = Needs(modalities=({modality!r},))` (from real2sim.planners)"
            ) from None

    def __getitem__(self, sensor: str) -> Any:
        """The rgb image of a camera, or the points of a LiDAR or radar: [N, 3] in its frame."""
        cloud = self.clouds.get(sensor)
        return self.image(sensor) if cloud is None else cloud.points

    def __contains__(self, sensor: object) -> bool:
        return sensor in self.frames or sensor in self.clouds

    def __iter__(self) -> Iterator[str]:
        raise TypeError(
            f"a step gives one {type(self).__name__}; real2sim.make_env(...) makes an environment "
            "whose step gives Gymnasium's obs, reward, terminated, truncated, info"
        )

    def lidar(self, name: str | None = None) -> LidarCloud:
        """The sweep of a LiDAR; default: the only LiDAR.

        Raises:
            KeyError: no such LiDAR; the message names the available ones.

        Examples:
            >>> with real2sim.connect() as other, other.session(scene="street") as driven:
            ...     seen = driven.reset(lidars=["vlp-16"])
            >>> seen.lidar("vlp-16").frame
            'sensor'
        """
        return self._cloud(name, LidarCloud)

    def radar(self, name: str | None = None) -> RadarCloud:
        """The scan of a radar. Name and KeyError as in :meth:`lidar`.

        Examples:
            >>> with real2sim.connect() as other, other.session(scene="street") as driven:
            ...     seen = driven.reset(radars=["corner"])
            >>> bool((seen.radar("corner").range > 0).all())
            True
        """
        return self._cloud(name, RadarCloud)

    def _cloud(self, name: str | None, kind: type[C]) -> C:
        of_kind = [cloud for cloud in self.clouds.values() if isinstance(cloud, kind)]
        if name is None and len(of_kind) == 1:
            return of_kind[0]
        found = self.clouds.get(str(name))
        if not isinstance(found, kind):
            there = ", ".join(f"{n} ({c.modality})" for n, c in self.clouds.items()) or "none"
            raise KeyError(f"no such cloud {name!r} at {self.t_us} us; there: {there}")
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation(View):
    """The vehicle's perception at step ``step``.

    Attributes:
        step: number of the step; 0 after reset.
        ego: state of the controlled vehicle; ``position`` is the rear axle's centre on the ground.
        route: [R, 2] float64, x and y of the route ahead in the vehicle frame [m].
        command: ``straight``, ``left`` or ``right``.
        agents: other road users in the world frame, by number or ``object_id``; requires a reset
            with ``privileged=True``.
        lanes: sections of the map's lanes near the vehicle, nearest first; requires a reset with
            ``privileged=True`` on a scene with a map.
        signals: traffic signals of the storyboard.
        events: events of this step.
        metrics: scores so far, by name.
        terminated: the episode ended because of an event.
        truncated: the episode ended because its time was over.
        reason: reason for the end.
        warming_up: whether the vehicle still follows the recording; plans have no effect yet.
        lap: completed laps of a loop.
        drawn: values sampled from the seed in this step, by name.
        ego_truth: true state of the vehicle, if the episode is privileged and ``ego`` is a noisy
            estimate; else None.

    Examples:
        >>> client = real2sim.connect()
        >>> with client.session(scene="street") as session:
        ...     obs = session.reset(sensors=["front"], privileged=True)
        >>> obs.step, obs.command, len(obs.agents), round(obs.ego.speed, 2)
        (0, 'straight', 3, 5.0)
    """

    _instead: ClassVar = {
        "actors": "obs.agents, which session.reset(privileged=True) fills",
        "boxes": "obs.agents, which session.reset(privileged=True) fills",
        "collision": "[e for e in obs.events if e.type == 'collision'], or obs.metrics",
        "done": "obs.over",
        "info": "obs.metrics and obs.events",
        "map": "obs.lanes, which session.reset(privileged=True) fills",
        "objects": "obs.agents, which session.reset(privileged=True) fills",
        "position": "obs.ego.position",
        "reward": "obs.metrics; real2sim.make_env(...) has rewards",
        "scores": "obs.metrics",
        "speed": "obs.ego.speed",
        "state": "obs.ego",
        "vehicles": "obs.agents, which session.reset(privileged=True) fills",
        "waypoints": "obs.route",
    }

    step: int
    ego: EgoState
    route: NDArray[np.float64] = field(repr=False)
    command: str
    agents: Named[AgentState] = field(default_factory=Named, repr=False)
    lanes: Sequence[LaneShown] = field(default=(), repr=False)
    signals: Sequence[SignalShown] = ()
    events: Sequence[Event] = ()
    metrics: Mapping[str, float] = field(default_factory=dict, repr=False)
    terminated: bool = False
    truncated: bool = False
    reason: str | None = None
    warming_up: bool = False
    lap: int = 0
    drawn: Mapping[str, float] = field(default_factory=dict, repr=False)
    ego_truth: EgoState | None = field(default=None, repr=False)

    @property
    def over(self) -> bool:
        """Whether the episode has ended, terminated or truncated.

        Examples:
            >>> obs.over
            False
        """
        return self.terminated or self.truncated


def observation_from_wire(obs: Obs, pixels: Sequence[memoryview | None] = ()) -> Observation:
    """Parse the observation in a message.

    Args:
        obs: the message.
        pixels: one entry per image: its bytes in shared memory, or None; default: no image is in
            shared memory.

    Raises:
        MalformedReplyError: a route or matrix has the wrong shape.
    """
    route = np.asarray(obs.route, dtype=np.float64)
    if route.size == 0:
        route = route.reshape(0, 2)
    if route.ndim != 2 or route.shape[1] != 2:
        raise MalformedReplyError(f"the route has shape {route.shape}, not [R, 2]")
    return Observation(
        step=obs.step,
        t_us=obs.t_us,
        revision=obs.revision,
        ego=obs.ego,
        route=route,
        command=obs.command,
        frames=frames_by_camera(obs.frames, pixels),
        clouds=clouds_by_sensor(obs.clouds),
        agents=Named(obs.agents, filled_by="session.reset(privileged=True) fills agents;"),
        lanes=tuple(obs.lanes),
        signals=tuple(obs.signals),
        events=tuple(obs.events),
        metrics=obs.metrics,
        terminated=obs.terminated,
        truncated=obs.truncated,
        reason=obs.reason,
        warming_up=obs.warming_up,
        lap=obs.lap,
        drawn=obs.drawn,
        ego_truth=obs.ego_truth,
        timing=obs.timing,
    )


def view_from_frames(
    frames: Sequence[WireFrame],
    *,
    t_us: int,
    revision: int,
    timing: Mapping[str, float],
    pixels: Sequence[memoryview | None] = (),
    clouds: Sequence[WireCloud] = (),
) -> View:
    """Parse the view in a message; ``pixels`` as in :func:`observation_from_wire`."""
    return View(
        t_us=t_us,
        revision=revision,
        frames=frames_by_camera(frames, pixels),
        clouds=clouds_by_sensor(clouds),
        timing=timing,
    )
