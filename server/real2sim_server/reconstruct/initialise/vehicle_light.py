"""How light and shade lie on vehicles: one paint is brighter where it faces sun and sky.

Images show most vehicles from one side. What the others look like follows from the paint and from
how much brighter, on all vehicles of a log, the sides are that face one way than those that face
another.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...scene import SceneObject, Trajectory

FROM_ABOVE = (0.0, 0.0, 0.25)
"""Slopes that hold where vehicles say nothing."""
DOUBT = 2.0
"""Weight of these, in vehicles."""
FEW = 100
"""Vehicles of which fewer points are seen do not count."""
ODD = 0.15
"""Logarithms of brightness that differ more are of reflections, cast shadows, or no paint."""
ROUNDS = 10
DARKEST = 0.02
LIGHT = "vehicle_light"
"""Where a scene's reconstruction keeps the slopes."""


def fit_light(normals: Sequence[Float], colours: Sequence[NDArray[np.float32]]) -> Float:
    """Slopes [3] of the logarithm of brightness over a surface's normal, the same on all vehicles.

    Args:
        normals: by vehicle, [N, 3] unit, in a frame that all share.
        colours: by vehicle, [N, 3] of paint there.
    """
    members = [k for k, seen in enumerate(normals) if len(seen) >= FEW]
    prior = np.array(FROM_ABOVE)
    if not members:
        return prior
    owner = np.repeat(np.arange(len(members)), [len(normals[k]) for k in members])
    unit = np.concatenate([normals[k] for k in members])
    bright = np.concatenate([colours[k].mean(axis=1) for k in members])
    rest = np.log(bright.clip(DARKEST)) - unit @ prior
    share = np.concatenate([np.full(len(normals[k]), 1 / len(normals[k])) for k in members])
    # Each vehicle has a paint of its own, of which nothing is known.
    columns = np.concatenate([unit, np.eye(len(members))[owner]], axis=1)
    doubt = np.diag([DOUBT / 30] * 3 + [1e-6] * len(members))
    weight, found = share, np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        weighed = columns.T * weight
        found = np.linalg.solve(weighed @ columns + doubt, weighed @ rest)
        weight = share / np.maximum(1, np.abs(rest - columns @ found) / ODD)
    return np.asarray(prior + found[:3])


def brightness(light: Float, normals: Float) -> NDArray[np.float32]:
    """How bright [N, 1] paint is on surfaces of unit ``normals`` [N, 3], 1 on average."""
    return np.exp(normals @ light)[:, None].astype(np.float32)


def light_on(item: SceneObject, reconstruction: object) -> Float:
    """The slopes [3] in the frame of an object, as it stands in the middle of its time.

    Args:
        reconstruction: of the scene's provenance; of one without slopes light comes from above.
    """
    known = reconstruction.get(LIGHT) if isinstance(reconstruction, dict) else None
    light = np.array(FROM_ABOVE if known is None else known, dtype=np.float64)
    return np.asarray(light @ pose_amid(item.trajectory)[:3, :3])


def pose_amid(trajectory: Trajectory) -> Float:
    """``T_world_object`` [4, 4] in the middle of its time: light is taken as it lies there."""
    return trajectory.transform((trajectory.start_us + trajectory.end_us) // 2)
