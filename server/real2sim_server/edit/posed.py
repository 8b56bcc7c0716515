"""A scene with objects where a request says, without an edit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from real2sim_proto.base import Pose

from ..render.types import Instance
from ..scene import Scene, Trajectory
from .compose import instances_at
from .operation import require_object
from .state import ObjectState, ScenarioState

Others = Literal["recorded", "parked", "none"]


def posed_instances(
    scene: Scene, t_us: int, poses: Mapping[str, Pose], *, others: Others = "recorded"
) -> list[Instance]:
    """What is drawn at an instant with objects at ``poses``, as :func:`instances_at` has it.

    Args:
        scene: without edits.
        t_us: instant, for the objects that are not posed and for colours [us].
        poses: ``T_world_object`` by id.
        others: what becomes of objects that are not posed: all as recorded, only those of them
            that are parked, or none.

    Raises:
        EditError: UNKNOWN_OBJECT, for an object that the scene lacks.
    """
    state = ScenarioState.of(scene)
    for object_id in poses:
        require_object(state, object_id)
    objects = {
        object_id: _posed(subject, poses[object_id], t_us)
        if object_id in poses
        else replace(subject, deleted=not _shown(subject, others))
        if others != "recorded"
        else subject
        for object_id, subject in state.objects.items()
    }
    return instances_at(scene, replace(state, objects=MappingProxyType(objects)), t_us)


def _posed(subject: ObjectState, pose: Pose, t_us: int) -> ObjectState:
    there = Trajectory(
        times_us=np.array([t_us], dtype=np.int64),
        positions=np.array([pose.position]),
        quaternions=np.array([pose.quaternion]),
    )
    return replace(subject, trajectory=there, edited=True)


def _shown(subject: ObjectState, others: Others) -> bool:
    return others == "parked" and not subject.trajectory.moves
