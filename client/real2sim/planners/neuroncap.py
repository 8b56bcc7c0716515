"""Planners made for NeuroNCAP (Ljungbergh et al. 2024), unchanged: HTTP with ``/infer``.

The planner serves ``GET /alive``, ``POST /reset`` and ``POST /infer``. It expects images as
tensors written by ``torch.save``, so torch must be installed here.
"""

from __future__ import annotations

import base64
import importlib
import io
import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import httpx2
import numpy as np

from real2sim_proto.plans import TrajectoryPlan

from .peer import (
    PeerError,
    T_ego_camera,
    T_world_ego,
    checked_points,
    headings,
    named_as,
    rgb_frames,
)
from .planner import Needs

if TYPE_CHECKING:
    from ..images import Frame
    from ..observation import Observation

SPACING_US = 500_000
"""Time between the points of an answer."""
COMMANDS = {"right": 0, "left": 1, "straight": 2}
NUSCENES_CAMERAS = {
    "CAM_FRONT": 0.0,
    "CAM_FRONT_LEFT": math.radians(55),
    "CAM_FRONT_RIGHT": math.radians(-55),
    "CAM_BACK_LEFT": math.radians(110),
    "CAM_BACK_RIGHT": math.radians(-110),
    "CAM_BACK": math.pi,
}
"""Directions of nuScenes' cameras, positive to the left [rad]."""
NUSCENES_LIDAR = (
    (0.0, 1.0, 0.0, 0.94),
    (-1.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 1.84),
    (0.0, 0.0, 0.0, 1.0),
)
"""T_ego_lidar of nuScenes, rounded to a centimetre: x right, y forward. Planners use this frame."""


class NeuroNcap:
    """A planner behind NeuroNCAP's interface.

    Cameras with a nuScenes name keep it; others receive the name with the most similar direction.
    """

    needs = Needs(modalities=("rgb",), all_cameras=True)

    def __init__(
        self,
        url: str = "http://127.0.0.1:9000",
        *,
        timeout: float = 60.0,
        T_ego_lidar: Sequence[Sequence[float]] = NUSCENES_LIDAR,
    ) -> None:
        """Connect to a planner; ``timeout`` [s] limits its startup and each answer.

        Raises:
            PeerError: it does not start in time.
        """
        self.url = url.rstrip("/")
        self._http = httpx2.Client(base_url=self.url, timeout=timeout)
        self._T_ego_lidar = [list(row) for row in T_ego_lidar]
        self._names: dict[str, str] = {}
        self._wait(timeout)

    def reset(self, obs: Observation) -> None:
        """Reset the planner. Raises PeerError."""
        self._names = named_as(rgb_frames(obs), obs, NUSCENES_CAMERAS)
        self._post("/reset", {})

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """The planner's trajectory, with headings along it.

        Raises:
            PeerError: it is unreachable, or returns an invalid trajectory.
        """
        answer = self._post("/infer", self._inputs(obs))
        given = answer.get("trajectory") if isinstance(answer, dict) else None
        points = checked_points(given, columns=2, what=f"the trajectory of {self.url}")
        yaws = headings(points)
        return TrajectoryPlan(
            times_us=[obs.t_us + SPACING_US * (k + 1) for k in range(len(points))],
            poses=[(x, y, yaw) for (x, y), yaw in zip(points.tolist(), yaws, strict=True)],
        )

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def _inputs(self, obs: Observation) -> dict[str, Any]:
        frames = {
            self._names[name]: frame
            for name, frame in rgb_frames(obs).items()
            if name in self._names
        }
        return {
            "images": {name: _saved_tensor(frame) for name, frame in frames.items()},
            "ego2world": T_world_ego(obs.ego).tolist(),
            "canbus": _canbus(obs),
            "timestamp": obs.t_us,
            "command": COMMANDS[obs.command],
            "calibration": {
                "camera2image": {name: frame.K.tolist() for name, frame in frames.items()},
                "camera2ego": {n: T_ego_camera(obs, f).tolist() for n, f in frames.items()},
                "lidar2ego": self._T_ego_lidar,
            },
        }

    def _wait(self, timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while True:
            try:
                if self._http.get("/alive").status_code == httpx2.codes.OK:
                    return
                reason = "it does not say that it is alive"
            except httpx2.HTTPError as error:
                reason = str(error)
            if time.monotonic() > deadline:
                raise PeerError(f"no planner answers at {self.url}: {reason}")
            time.sleep(0.2)

    def _post(self, path: str, content: dict[str, Any]) -> Any:
        where = f"{self.url}{path}"
        try:
            answer = self._http.post(path, json=content)
            answer.raise_for_status()
            return answer.json()
        except httpx2.HTTPStatusError as error:
            said = error.response.text[:300]
            raise PeerError(f"{where} answers {error.response.status_code}: {said}") from error
        except (httpx2.HTTPError, ValueError) as error:
            raise PeerError(f"{where} does not answer as a planner does: {error}") from error


def _canbus(obs: Observation) -> list[float]:
    """nuScenes' vehicle bus in these planners' conventions.

    Position [m], orientation wxyz, acceleration [m/s^2], rotation rate [rad/s], velocity [m/s],
    the last three in the vehicle frame.
    """
    ego = obs.ego
    sideways = ego.speed * ego.yaw_rate
    return [
        *ego.position,
        *ego.quaternion,
        *(ego.acceleration, sideways, 9.81),
        *(0.0, 0.0, ego.yaw_rate),
        *(ego.speed, ego.lateral_speed, 0.0),
    ]


def _saved_tensor(frame: Frame) -> str:
    """A uint8 tensor [H, W, 3] by torch.save, in base64."""
    try:
        torch = importlib.import_module("torch")
    except ImportError as error:
        raise PeerError("NeuroNCAP planners take torch tensors: pip install torch") from error
    file = io.BytesIO()
    torch.save(torch.from_numpy(np.array(frame.array, dtype=np.uint8)), file)
    return base64.b64encode(file.getvalue()).decode()
