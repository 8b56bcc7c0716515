"""One sweep of a LiDAR through a scenario."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from fastapi import Depends, Header, Query, Response

from real2sim_proto.base import Identifier, Microseconds
from real2sim_proto.ranging import LidarSpec

from ...edit import ScenarioState
from ...geometry.transform import apply_transform
from ...world.ranging import Cloud, MountedLidar, mounted_sensors
from ..http.responses import choose_among, etag
from ..rendering.clouds import cloud_parts

MSGPACK = "application/msgpack"
POINTS = "application/octet-stream"
SWEEP_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "a point cloud as on the drive socket; or x, y, z in the world [m] and "
        "intensity of each return, float32, little-endian",
        "content": {
            media_type: {"schema": {"type": "string", "format": "binary"}}
            for media_type in (MSGPACK, POINTS)
        },
    }
}


@dataclass(frozen=True)
class SweepQuery:
    """Query and headers of a sweep."""

    lidar: Annotated[Identifier, Query(description="name in the catalogue")] = "synthetic-64"
    t_us: Annotated[
        Microseconds | None, Query(description="when it ends; default: start of the scenario")
    ] = None
    accept: Annotated[str | None, Header(description=f"{MSGPACK} or {POINTS}")] = None

    def media_type(self) -> str:
        """Form of the answer. Raises ServiceError: NOT_ACCEPTABLE."""
        return choose_among([MSGPACK, POINTS], self.accept, of="a sweep")

    def mounted(self) -> MountedLidar:
        """The sensor. Raises WorldError: INVALID_REQUEST for one that the catalogue does not
        have."""
        return mounted_sensors([LidarSpec(lidar=self.lidar)], [], 1).lidars[0]

    def instant(self, state: ScenarioState) -> int:
        """When the sweep ends [us]."""
        return state.clock[0] if self.t_us is None else self.t_us


def sweep_response(cloud: Cloud, media_type: str, *, revision: int) -> Response:
    """The cloud as msgpack, or its points alone."""
    if media_type == MSGPACK:
        content = b"".join(cloud_parts(cloud))
    else:
        rows = np.empty((cloud.count, 4), "<f4")
        rows[:, :3] = apply_transform(cloud.T_world_sensor, cloud.columns["points"])
        rows[:, 3] = cloud.columns["intensity"]
        content = rows.tobytes()
    headers = {
        "Vary": "Accept",
        "Cache-Control": "no-store",
        "X-Real2Sim-Revision": etag(revision),
        "X-Real2Sim-Points": str(cloud.count),
    }
    return Response(content, media_type=media_type, headers=headers)


SweepQueryOf = Annotated[SweepQuery, Depends()]
