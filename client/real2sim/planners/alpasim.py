"""Planners made for AlpaSim (NVIDIA 2025), unchanged: gRPC, ``EgodriverService``.

AlpaSim's local frame is our world frame, shifted to the start of the episode, because AlpaSim uses
single precision. Its rig frame is the vehicle frame. Requires the ``alpasim`` extra.
"""

from __future__ import annotations

import importlib
import math
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import numpy as np

from real2sim_proto.plans import TrajectoryPlan

from .._alpasim import DRIVER, DRIVER_METHODS, GLOBAL_SHUTTER, MAX_MESSAGE_BYTES, Ftheta, messages
from .._session_state import Matrix, quaternion_of
from .follow_route import Comfort, Path, delays_of_poses
from .peer import (
    Look,
    PeerError,
    T_ego_camera,
    T_world_ego,
    cameras_for,
    checked_points,
    looks_in,
    looks_of,
    quoted_cameras,
    rgb_frames,
)
from .planner import Needs

if TYPE_CHECKING:
    from real2sim_proto.scenes import CameraInfo

    from ..images import Frame
    from ..observation import Observation

PATIENCE = 50
"""Maximum number of answers without a plan at the start of a session."""
WAYPOINTS, WAYPOINT_SPACING = 20, 80 / 19
"""Route points as AlpaSim sends them, and their spacing [m]; missing points are NaN."""
ALPASIM_CAMERAS = {
    "camera_front_wide_120fov": Look(0.0, math.radians(120)),
    "camera_front_tele_30fov": Look(0.0, math.radians(30)),
    "camera_cross_left_120fov": Look(math.radians(70), math.radians(120)),
    "camera_cross_right_120fov": Look(math.radians(-70), math.radians(120)),
    "camera_rear_left_70fov": Look(math.radians(150), math.radians(70)),
    "camera_rear_right_70fov": Look(math.radians(-150), math.radians(70)),
    "camera_rear_tele_30fov": Look(math.pi, math.radians(30)),
}
"""Camera names of AlpaSim's drivers; directions to about ten degrees."""


class AlpasimDriver:
    """A planner behind AlpaSim's driver interface.

    It sends the images of the cameras that the driver requires, under the driver's names. NVIDIA's
    own service lists them when a session lacks them. Other drivers receive every camera, unless
    ``cameras`` selects some. While a driver has no plan yet, because it needs more images or more
    history, the vehicle follows its route at its current speed.
    """

    def __init__(
        self,
        target: str = "127.0.0.1:6789",
        *,
        timeout: float = 60.0,
        step_us: int | None = None,
        seed: int = 0,
        cameras: Mapping[str, str] | Sequence[str] = (),
        patience: int = PATIENCE,
    ) -> None:
        """Connect to a driver; ``timeout`` limits its startup and each answer.

        Args:
            target: host and port; the suffix ``?cameras=NAME:CAMERA,NAME`` has the meaning of
                ``cameras``.
            timeout: [s].
            step_us: time until the next request [us]; default: the time between the last two
                observations.
            seed: seed of the session; sent to the driver.
            cameras: the driver's camera names; as a mapping, to the scene's cameras.
            patience: maximum number of answers without a plan at the start of a session.

        Raises:
            PeerError: it does not start in time, or the ``alpasim`` extra is not installed.
            ValueError: an unknown option in the target.
        """
        try:
            self._grpc, self._messages = importlib.import_module("grpc"), messages()
        except ImportError as error:
            raise PeerError(
                "AlpaSim drivers need the alpasim extra: pip install 'real2sim[alpasim]'"
            ) from error
        self.target, options = _split(target)
        self._timeout, self._patience = timeout, patience
        self._step_us, self._seed = step_us, seed
        self._session, self._origin, self._last_us = "", np.zeros(3), -1
        self._shown: dict[str, str] = {}
        self._without_plan = 0
        self._planned = self._in_ftheta = False
        sizes = ("grpc.max_send_message_length", "grpc.max_receive_message_length")
        self._channel = self._grpc.insecure_channel(
            self.target, options=[(name, MAX_MESSAGE_BYTES) for name in sizes]
        )
        self._calls = {name: self._call_of(name, *pair) for name, pair in DRIVER_METHODS.items()}
        self.version = self._call("get_version", self._messages.Empty(), wait=True).version_id
        given = dict(cameras) if isinstance(cameras, Mapping) else dict.fromkeys(cameras, "")
        given |= options
        names = tuple(given) or self._asked_for()
        self._given = {name: camera for name, camera in given.items() if camera}
        self.needs: Needs = _DriverNeeds(
            modalities=("rgb",), all_cameras=not names, names=names, given=self._given
        )

    def reset(self, obs: Observation) -> None:
        """Begin a session of the driver, and end the previous one. Raises PeerError."""
        self._end_session()
        self._origin = np.array(obs.ego.position)
        self._last_us, self._without_plan, self._planned = -1, 0, False
        there, names = looks_in(obs), getattr(self.needs, "names", ())
        self._shown = cameras_for(names or there, there, known=ALPASIM_CAMERAS, given=self._given)
        self._begin_session(obs)

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """Send the driver its images, motion and route; return its plan.

        Raises:
            PeerError: it is unreachable, ends the session, or returns an invalid trajectory.
        """
        self._show_images(obs)
        self._call("submit_egomotion_observation", self._motion(obs))
        self._call("submit_route", self._route(obs))
        request = self._messages.DriveRequest(
            session_uuid=self._session,
            time_now_us=obs.t_us,
            time_query_us=obs.t_us + self._until_next(obs.t_us),
        )
        try:
            answer = self._call("drive", request)
        except _RefusalError as refusal:
            # NVIDIA's models report this while their history is too short.
            if refusal.status != "FAILED_PRECONDITION" or self._planned:
                raise
            return self._continue_on_route(obs, refusal.details)
        if answer.terminate_session:
            raise PeerError(f"the driver at {self.target} ends the session at {obs.t_us} us")
        if not answer.trajectory.poses and not self._planned:
            return self._continue_on_route(obs, "an empty trajectory")
        self._planned = True
        return self._plan_in(answer, obs.t_us)

    def close(self) -> None:
        """End the session and close the connection."""
        try:
            self._end_session()
        finally:
            self._channel.close()

    def _asked_for(self) -> tuple[str, ...]:
        """Names of the cameras that the driver reports missing in a session without cameras."""
        session = uuid.uuid4().hex
        try:
            self._call(
                "start_session",
                self._messages.DriveSessionRequest(session_uuid=session, random_seed=self._seed),
            )
        except _RefusalError as refusal:
            return tuple(quoted_cameras(refusal.details))
        self._call("close_session", self._messages.DriveSessionCloseRequest(session_uuid=session))
        return ()

    def _begin_session(self, obs: Observation) -> None:
        session = uuid.uuid4().hex
        request = self._messages.DriveSessionRequest(session_uuid=session, random_seed=self._seed)
        frames = rgb_frames(obs)
        request.rollout_spec.vehicle.available_cameras.extend(
            self._camera(name, frames[camera], obs) for name, camera in self._shown.items()
        )
        self._call("start_session", request)
        self._session = session

    def _end_session(self) -> None:
        if self._session:
            session, self._session = self._session, ""
            self._call(
                "close_session", self._messages.DriveSessionCloseRequest(session_uuid=session)
            )

    def _show_images(self, obs: Observation) -> None:
        try:
            self._send_images(obs)
        except _RefusalError as refusal:
            if self._in_ftheta or "f-theta" not in refusal.details:
                raise
            # A driver that rectifies images reports this at the first image, not at the session
            # start.
            self._in_ftheta = True
            self._end_session()
            self._begin_session(obs)
            self._send_images(obs)

    def _send_images(self, obs: Observation) -> None:
        m, frames = self._messages, rgb_frames(obs)
        encoded: dict[str, bytes] = {}
        for name, camera in self._shown.items():
            frame = frames.get(camera)
            # A slower camera has no image in every observation.
            if frame is None or (frame.t_us != obs.t_us):
                continue
            image = m.CameraImage(
                frame_start_us=frame.t_us,
                frame_end_us=frame.t_us,
                image_bytes=encoded.get(camera) or encoded.setdefault(camera, _encoded(frame)),
                logical_id=name,
            )
            request = m.RolloutCameraImage(session_uuid=self._session, camera_image=image)
            self._call("submit_image_observation", request)

    def _continue_on_route(self, obs: Observation, said: str) -> TrajectoryPlan:
        """A plan along the route at the current speed."""
        if not obs.warming_up:
            self._without_plan += 1
        if self._without_plan > self._patience:
            raise PeerError(
                f"the driver at {self.target} has no plan after {self._without_plan} "
                f"observations: {said}",
                hint="check which context it needs, and the time between observations (--dt-us)",
            )
        delays = delays_of_poses(speed=1.0, horizon=3.0, spacing=0.25)
        path = Path.along(obs.route)
        poses = path.poses(max(obs.ego.speed, 0.0) * delays, Comfort().recovery)
        return TrajectoryPlan(
            times_us=[obs.t_us + round(delay * 1e6) for delay in delays],
            poses=[tuple(pose) for pose in poses.tolist()],
        )

    def _plan_in(self, answer: Any, t_us: int) -> TrajectoryPlan:
        ahead = [p for p in answer.trajectory.poses if p.timestamp_us > t_us]
        if not ahead:
            raise PeerError(f"the driver at {self.target} plans nothing after {t_us} us")
        rows = [(p.pose.vec.x, p.pose.vec.y, _yaw(p.pose.quat)) for p in ahead]
        what = f"the trajectory of {self.target}"
        x, y, _ = self._origin
        poses = checked_points(rows, columns=3, what=what) + np.array([x, y, 0.0])
        times = [p.timestamp_us for p in ahead]
        try:
            return TrajectoryPlan(times_us=times, poses=poses, frame="world")
        except ValueError as error:
            raise PeerError(f"{what} is not a plan: {error}") from error

    def _until_next(self, t_us: int) -> int:
        before, self._last_us = self._last_us, t_us
        if self._step_us is not None:
            return self._step_us
        return t_us - before if 0 <= before < t_us else 100_000

    def _camera(self, name: str, frame: Frame, obs: Observation) -> Any:
        m = self._messages
        height, width = frame.shape[:2]
        intrinsics = m.CameraSpec(
            logical_id=name,
            resolution_h=height,
            resolution_w=width,
            shutter_type=GLOBAL_SHUTTER,
        )
        centre = {"principal_point_x": frame.K[0, 2], "principal_point_y": frame.K[1, 2]}
        if self._in_ftheta:
            lens = Ftheta.of(frame.K, width, height)
            intrinsics.ftheta_param.CopyFrom(
                m.FthetaCameraParam(
                    **centre,
                    reference_poly=ANGLE_TO_PIXELS,
                    pixeldist_to_angle_poly=lens.pixels_to_angle,
                    angle_to_pixeldist_poly=lens.angle_to_pixels,
                    max_angle=lens.max_angle,
                    linear_cde=m.LinearCde(linear_c=lens.stretch),
                )
            )
        else:
            focal = {"focal_length_x": frame.K[0, 0], "focal_length_y": frame.K[1, 1]}
            intrinsics.opencv_pinhole_param.CopyFrom(m.OpenCVPinholeCameraParam(**centre, **focal))
        # Despite its name this is the camera's pose in the rig; see AlpaSim's comment on it.
        pose = self._pose(T_ego_camera(obs, frame))
        return m.AvailableCamera(intrinsics=intrinsics, rig_to_camera=pose, logical_id=name)

    def _motion(self, obs: Observation) -> Any:
        m, ego = self._messages, obs.ego
        T_local_rig = T_world_ego(ego)
        T_local_rig[:3, 3] -= self._origin
        now = m.PoseAtTime(pose=self._pose(T_local_rig), timestamp_us=obs.t_us)
        state = m.DynamicState(
            angular_velocity=self._vector((0, 0, ego.yaw_rate)),
            linear_velocity=self._vector((ego.speed, ego.lateral_speed, 0)),
            linear_acceleration=self._vector((ego.acceleration, ego.speed * ego.yaw_rate, 0)),
        )
        return m.RolloutEgoTrajectory(
            session_uuid=self._session,
            trajectory=m.Trajectory(poses=[now]),
            dynamic_states=[state],
        )

    def _route(self, obs: Observation) -> Any:
        m = self._messages
        points = _spaced(obs.route)
        route = m.Route(timestamp_us=obs.t_us, waypoints=[self._vector(p) for p in points.tolist()])
        return m.RouteRequest(session_uuid=self._session, route=route)

    def _pose(self, matrix: Matrix) -> Any:
        w, x, y, z = quaternion_of(matrix[:3, :3])
        quat = self._messages.Quat(w=w, x=x, y=y, z=z)
        return self._messages.Pose(vec=self._vector(matrix[:3, 3]), quat=quat)

    def _vector(self, values: Iterable[float]) -> Any:
        x, y, z = values
        return self._messages.Vec3(x=x, y=y, z=z)

    def _call_of(self, name: str, request: str, answer: str) -> Any:
        return self._channel.unary_unary(
            f"/{DRIVER}/{name}",
            request_serializer=getattr(self._messages, request).SerializeToString,
            response_deserializer=getattr(self._messages, answer).FromString,
        )

    def _call(self, name: str, request: Any, *, wait: bool = False) -> Any:
        try:
            return self._calls[name](request, timeout=self._timeout, wait_for_ready=wait)
        except self._grpc.RpcError as error:
            raise _RefusalError(
                f"{name} of the driver at {self.target} failed",
                status=error.code().name,
                details=error.details() or "",
            ) from error


ANGLE_TO_PIXELS = 2
"""AlpaSim's enum value for the reference polynomial of an f-theta camera."""


class _RefusalError(PeerError):
    """A failed call to the driver.

    Attributes:
        status: gRPC's status name.
        details: the driver's message.
    """

    def __init__(self, what: str, *, status: str, details: str) -> None:
        super().__init__(f"{what}: {status}, {details}")
        self.status, self.details = status, details


@dataclass(frozen=True)
class _DriverNeeds(Needs):
    """Needs of a driver that has its own camera names.

    Attributes:
        names: the driver's camera names; empty: every camera under its own name.
        given: cameras of the scene by these names.
    """

    names: tuple[str, ...] = ()
    given: Mapping[str, str] = field(default_factory=dict)

    def sensors(self, cameras: Sequence[CameraInfo]) -> list[dict[str, Any]]:
        """Specs of the matching cameras. Raises PeerError if no camera matches a name."""
        if not self.names:
            return super().sensors(cameras)
        chosen = cameras_for(self.names, looks_of(cameras), known=ALPASIM_CAMERAS, given=self.given)
        return [
            {"camera": camera, "modalities": list(self.modalities), "width": self.width}
            for camera in dict.fromkeys(chosen.values())
        ]


def _split(target: str) -> tuple[str, dict[str, str]]:
    """Split ``HOST:PORT?cameras=NAME:CAMERA,NAME`` into the address and the cameras by name."""
    address, _, query = target.partition("?")
    cameras: dict[str, str] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key != "cameras":
            raise ValueError(f"option {key!r} of {target!r} is unknown; there is: cameras")
        pairs = [part.partition(":") for part in value.split(",") if part]
        cameras |= {name: camera for name, _, camera in pairs}
    return address, cameras


def _spaced(route: Matrix) -> Matrix:
    """[20, 3] waypoints ahead of the vehicle, with AlpaSim's spacing; NaN past the route's end."""
    path = Path.along(route)
    wanted = np.arange(WAYPOINTS) * WAYPOINT_SPACING
    found = np.full((WAYPOINTS, 3), np.nan)
    here = wanted <= path.arc[-1] + 1e-9
    for axis in (0, 1):
        found[here, axis] = np.interp(wanted[here], path.arc, path.points[:, axis])
    found[here, 2] = 0.0
    return found


def _encoded(frame: Frame) -> bytes:
    """The image as jpeg or png."""
    if frame.codec in {"jpeg", "png"}:
        return frame.data
    import simplejpeg

    encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(frame.array), quality=92)
    return encoded


def _yaw(q: Any) -> float:
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
