"""Hand-made observations for planners."""

from __future__ import annotations

import math

import numpy as np

from real2sim.observation import Observation
from real2sim_proto.drive import AgentState, EgoState

STRAIGHT = np.stack([np.arange(0.0, 100.0), np.zeros(100)], axis=1)


def observation(
    route,
    *,
    speed=0.0,
    position=(0.0, 0.0, 0.0),
    yaw=0.0,
    agents=(),
    frames=None,
    t_us=1_000_000,
    acceleration=0.0,
    yaw_rate=0.0,
    warming_up=False,
) -> Observation:
    ego = EgoState(
        position=position,
        quaternion=(math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)),
        yaw=yaw,
        speed=speed,
        acceleration=acceleration,
        steering=0.0,
        yaw_rate=yaw_rate,
        size=(4.6, 1.9, 1.6),
    )
    return Observation(
        step=0,
        t_us=t_us,
        revision=0,
        frames=frames or {},
        ego=ego,
        route=np.asarray(route, float),
        command="straight",
        agents=agents,
        warming_up=warming_up,
    )


def agent(x, y, *, speed=0.0, yaw=0.0) -> AgentState:
    return AgentState(
        object_id="car",
        category="car",
        position=(x, y, 0.8),
        quaternion=(math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)),
        velocity=(speed * math.cos(yaw), speed * math.sin(yaw), 0.0),
        size=(4.6, 1.9, 1.6),
    )
