"""Planners made for AlpaSim (NVIDIA 2025), unchanged: gRPC, ``EgodriverService``.

AlpaSim's local frame is here the world, shifted so that an episode begins at its origin: its
numbers are single precision. Its rig frame is the vehicle frame. Needs the ``alpasim`` extra.
"""

from __future__ import annotations

import importlib
import math
import uuid
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim_proto.plans import TrajectoryPlan

from ._alpasim_messages import GLOBAL_SHUTTER, METHODS, SERVICE, messages
from .peer import Matrix, PeerError, T_ego_camera, T_world_ego, checked_points, rgb_frames
from .planner import Needs

if TYPE_CHECKING:
    from ..images import Frame
    from ..observation import Observation

MAX_MESSAGE_BYTES = 64 * 1024 * 1024


class AlpasimDriver:
    """Asks a planner behind AlpaSim's interface."""

    needs = Needs(modalities=("rgb",), all_cameras=True)

    def __init__(
        self,
        target: str = "127.0.0.1:6789",
        *,
        timeout: float = 60.0,
        step_us: int = 100_000,
        seed: int = 0,
    ) -> None:
        """Reach a driver; it may take ``timeout`` seconds to come up, and as long for an answer.

        Args:
            target: host and port.
            timeout: [s].
            step_us: when it will be asked again [us].
            seed: of the session; sent to the driver.

        Raises:
            PeerError: it does not come up, or the ``alpasim`` extra is not installed.
        """
        try:
            self._grpc, self._messages = importlib.import_module("grpc"), messages()
        except ImportError as error:
            raise PeerError(
                "AlpaSim drivers need the alpasim extra: pip install 'real2sim[alpasim]'"
            ) from error
        self.target, self._timeout = target, timeout
        self._step_us, self._seed = step_us, seed
        self._session, self._origin = "", np.zeros(3)
        sizes = ("grpc.max_send_message_length", "grpc.max_receive_message_length")
        options = [(name, MAX_MESSAGE_BYTES) for name in sizes]
        self._channel = self._grpc.insecure_channel(target, options=options)
        self._calls = {name: self._call_of(name, *pair) for name, pair in METHODS.items()}
        self.version = self._call("get_version", self._messages.Empty(), wait=True).version_id

    def reset(self, obs: Observation) -> None:
        """Begin a session of the driver, and end the one before. Raises PeerError."""
        self._end_session()
        self._origin = np.array(obs.ego.position)
        session = uuid.uuid4().hex
        request = self._messages.DriveSessionRequest(session_uuid=session, random_seed=self._seed)
        cameras = request.rollout_spec.vehicle.available_cameras
        cameras.extend(self._camera(n, f, obs) for n, f in rgb_frames(obs).items())
        self._call("start_session", request)
        self._session = session

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """Show the driver what its cameras see, its motion and route; where it wants to be.

        Raises:
            PeerError: it cannot be reached, ends the session, or answers with what is no way.
        """
        m = self._messages
        for name, frame in rgb_frames(obs).items():
            image = m.CameraImage(
                frame_start_us=frame.t_us,
                frame_end_us=frame.t_us,
                image_bytes=_encoded(frame),
                logical_id=name,
            )
            request = m.RolloutCameraImage(session_uuid=self._session, camera_image=image)
            self._call("submit_image_observation", request)
        self._call("submit_egomotion_observation", self._motion(obs))
        route = m.Route(timestamp_us=obs.t_us, waypoints=[self._vector((*p, 0)) for p in obs.route])
        self._call("submit_route", m.RouteRequest(session_uuid=self._session, route=route))
        request = m.DriveRequest(
            session_uuid=self._session,
            time_now_us=obs.t_us,
            time_query_us=obs.t_us + self._step_us,
        )
        return self._plan_in(self._call("drive", request), obs.t_us)

    def close(self) -> None:
        """End the session and close the connection."""
        self._end_session()
        self._channel.close()

    def _plan_in(self, answer: Any, t_us: int) -> TrajectoryPlan:
        if answer.terminate_session:
            raise PeerError(f"the driver at {self.target} ends the session at {t_us} us")
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
            raise PeerError(f"{what} is no plan: {error}") from error

    def _camera(self, name: str, frame: Frame, obs: Observation) -> Any:
        m = self._messages
        height, width = frame.array.shape[:2]
        pinhole = m.OpenCVPinholeCameraParam(
            principal_point_x=frame.K[0, 2],
            principal_point_y=frame.K[1, 2],
            focal_length_x=frame.K[0, 0],
            focal_length_y=frame.K[1, 1],
        )
        intrinsics = m.CameraSpec(
            opencv_pinhole_param=pinhole,
            logical_id=name,
            resolution_h=height,
            resolution_w=width,
            shutter_type=GLOBAL_SHUTTER,
        )
        # In spite of its name this is where the camera is in the rig; see AlpaSim's comment on it.
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
        )
        return m.RolloutEgoTrajectory(
            session_uuid=self._session,
            trajectory=m.Trajectory(poses=[now]),
            dynamic_states=[state],
        )

    def _pose(self, matrix: Matrix) -> Any:
        w, x, y, z = _quaternion(matrix[:3, :3])
        quat = self._messages.Quat(w=w, x=x, y=y, z=z)
        return self._messages.Pose(vec=self._vector(matrix[:3, 3]), quat=quat)

    def _vector(self, values: Iterable[float]) -> Any:
        x, y, z = values
        return self._messages.Vec3(x=x, y=y, z=z)

    def _call_of(self, name: str, request: str, answer: str) -> Any:
        return self._channel.unary_unary(
            f"/{SERVICE}/{name}",
            request_serializer=getattr(self._messages, request).SerializeToString,
            response_deserializer=getattr(self._messages, answer).FromString,
        )

    def _call(self, name: str, request: Any, *, wait: bool = False) -> Any:
        try:
            return self._calls[name](request, timeout=self._timeout, wait_for_ready=wait)
        except self._grpc.RpcError as error:
            raise PeerError(
                f"{name} of the driver at {self.target} failed: {error.code().name}, "
                f"{error.details()}"
            ) from error

    def _end_session(self) -> None:
        if self._session:
            session, self._session = self._session, ""
            self._call(
                "close_session", self._messages.DriveSessionCloseRequest(session_uuid=session)
            )


def _encoded(frame: Frame) -> bytes:
    """The image as jpeg or png."""
    if frame.codec in {"jpeg", "png"}:
        return frame.data
    import simplejpeg

    encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(frame.array), quality=92)
    return encoded


def _yaw(q: Any) -> float:
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def _quaternion(R: Matrix) -> tuple[float, float, float, float]:
    """wxyz of a rotation, by the largest eigenvector of Bar-Itzhack's matrix (2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    sign = -1.0 if w < 0 else 1.0
    return (sign * w, sign * x, sign * y, sign * z)
