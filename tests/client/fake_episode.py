"""The world of the fake worker: a straight road, one vehicle and one camera."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import simplejpeg

from real2sim_proto.drive import Action, ResetSpec

ROUTE_LENGTH = 60.0
IMAGE = np.tile(np.arange(64, dtype=np.uint8)[None, :, None] * 3, (48, 1, 3))
CAMERA = {
    "name": "front",
    "width": 64,
    "height": 48,
    "K": [[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]],
    "T_vehicle_camera": np.eye(4).tolist(),
}


class Episode:
    """A straight road along x. The vehicle follows its plans exactly."""

    def __init__(self) -> None:
        self.spec = ResetSpec()
        self.revision = 0
        self.count = 0
        self.pose = (0.0, 0.0, 0.0)
        self.speed = 0.0
        self.cached: tuple[Any, dict[str, Any]] | None = None

    @property
    def t_us(self) -> int:
        return self.count * self.spec.dt_us

    def reset(self, spec: ResetSpec) -> dict[str, Any]:
        self.spec, self.count, self.pose, self.speed = spec, 0, (0.0, 1.0, 0.0), 0.0
        return self.obs()

    def step(self, action: Action) -> dict[str, Any]:
        if action.step == self.count - 1 and self.cached and self.cached[0] == action.plan:
            return self.cached[1]
        x, y, yaw = self.pose
        self.count += 1
        if action.plan.kind == "trajectory":
            times = np.array([self.t_us - self.spec.dt_us, *action.plan.times_us], float)
            poses = np.array([(0.0, 0.0, 0.0), *action.plan.poses])
            dx, dy, dyaw = (np.interp(self.t_us, times, poses[:, k]) for k in range(3))
            c, s = math.cos(yaw), math.sin(yaw)
            self.pose = (x + c * dx - s * dy, y + s * dx + c * dy, yaw + dyaw)
            self.speed = math.hypot(dx, dy) / (self.spec.dt_us * 1e-6)
        elif action.plan.kind == "control":
            dt = self.spec.dt_us * 1e-6
            self.speed += action.plan.acceleration * dt
            self.pose = (x + self.speed * dt, y, yaw)
        self.cached = (action.plan, self.obs())
        return self.cached[1]

    def obs(self) -> dict[str, Any]:
        x, y, yaw = (float(v) for v in self.pose)
        along = np.arange(x, ROUTE_LENGTH + 0.5, 1.0)
        c, s = math.cos(yaw), math.sin(yaw)
        route = np.stack([along - x, np.full_like(along, -y)], axis=1) @ np.array([[c, -s], [s, c]])
        done = x >= ROUTE_LENGTH - 2.0
        return {
            "type": "obs",
            "step": self.count,
            "t_us": self.t_us,
            "revision": self.revision,
            "ego": {
                "position": [x, y, 0.0],
                "quaternion": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)],
                "yaw": yaw,
                "speed": float(self.speed),
                "acceleration": 0.0,
                "steering": 0.0,
                "yaw_rate": 0.0,
                "size": [4.6, 1.9, 1.6],
            },
            "command": "straight",
            "route": route,
            "frames": [frame(s.codec, t_us=self.t_us) for s in self.spec.sensors],
            "truncated": done,
            "reason": "horizon" if done else None,
            "timing": {"render": 1.5, "total": 2.0},
        }


def frame(codec: str, *, t_us: int = 0) -> dict[str, Any]:
    """The only image, as a wire frame."""
    data = IMAGE.tobytes() if codec == "raw" else simplejpeg.encode_jpeg(IMAGE, quality=95)
    return {
        "sensor": "front",
        "modality": "rgb",
        "t_us": t_us,
        "T_world_sensor": np.eye(4),
        "K": np.array(CAMERA["K"]),
        "codec": codec,
        "dtype": "uint8",
        "shape": list(IMAGE.shape),
        "data": data,
    }
