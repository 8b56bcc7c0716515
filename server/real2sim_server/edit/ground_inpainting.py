"""Ground under parked objects that an edit took away.

No picture shows it while they stand there, so that training leaves a smear of their own colours.
The ground beside them is what is known best about it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor

from ..geometry.transform import invert_transform
from ..scene import UNSEEN, GaussianCloud, Scene
from .state import ObjectState, ScenarioState
from .tracks import Float

PARKED = 0.5
"""An object whose recorded places are all within this of each other is parked; tracks of objects
that stand still waver by some decimetres [m]."""

AWAY = 0.5
"""An object this far from its parking place uncovers the ground there [m]."""

MARGIN = 0.25
"""Colours reach this far beyond a box [m]."""

RIM = 1.2
"""Ground up to this far beyond the box is taken for what is under it [m]."""

LOW = 0.25
"""The ground's Gaussians are less than this above or below the box's bottom [m]."""

FEWEST = 6
NEIGHBOURS = 48
"""Of so many the middle colour counts, so that neither a line nor a shadow beside the box is drawn
out into what was under it."""


def vacated_parking(state: ScenarioState, poses: Mapping[str, Float]) -> tuple[str, ...]:
    """Ids of recorded objects that were parked and are not at their places.

    Args:
        state: knows what was recorded.
        poses: ``T_world_object`` [4, 4] of all objects that exist, by id; where an edit or impact
            has brought them.
    """
    return tuple(
        recorded.object_id
        for recorded in state.recorded.values()
        if _parked(recorded)
        and (
            _away(poses[recorded.object_id], recorded)
            if recorded.object_id in poses
            # What is unedited and not there was not recorded at that time.
            else state.objects[recorded.object_id] is not recorded
        )
    )


def inpaint_ground(scene: Scene, background: GaussianCloud, left: Iterable[str]) -> GaussianCloud:
    """The background with the ground coloured like that around it where objects ``left`` stood.

    Gaussians inside a box and above its ground become invisible: they belonged to the object. What
    is coloured by guess has the uncertainty of what was never seen.

    Raises:
        UnknownObjectError: ``scene`` has no such object.
    """
    opacities, sh = background.opacities.clone(), background.sh.clone()
    known = background.uncertainties
    uncertainties = None if known is None else known.clone()
    for object_id in left:
        parked = scene.object(object_id)
        track = parked.trajectory
        T_world_box = track.transform((track.start_us + track.end_us) // 2)
        to_box = torch.from_numpy(invert_transform(T_world_box)).to(background.means)
        local = background.means @ to_box[:3, :3].T + to_box[:3, 3]
        half = torch.tensor(parked.size).to(local) / 2
        beyond = (local[:, :2].abs() - half[:2]).amax(dim=1)
        height = local[:, 2] + half[2]
        level = height.abs() <= LOW
        opacities[(beyond <= 0) & (height > LOW) & (local[:, 2] <= half[2])] = 0.0
        around = level & (beyond > MARGIN) & (beyond <= RIM) & (opacities > 0.1)
        beneath = level & (beyond <= MARGIN)
        _recolour(sh, local[:, :2], beneath, around)
        if uncertainties is not None:
            uncertainties[beneath] = UNSEEN
    return replace(background, opacities=opacities, sh=sh, uncertainties=uncertainties)


@lru_cache(maxsize=4096)
def _parked(recorded: ObjectState) -> bool:
    low, high = recorded.bounds[:, :2]
    return bool((high - low - 2 * recorded.radius).max() <= PARKED)


def _away(pose: Float, parked: ObjectState) -> bool:
    (low_x, low_y), (high_x, high_y) = parked.bounds[:, :2].tolist()
    x, y = float(pose[0, 3]), float(pose[1, 3])
    return math.hypot(x - (low_x + high_x) / 2, y - (low_y + high_y) / 2) > AWAY


def _recolour(sh: Tensor, places: Tensor, unknown: Tensor, known: Tensor) -> None:
    """Give those of ``unknown`` [N] bool the median ``sh`` of the nearest ``known``, in place."""
    count = min(NEIGHBOURS, int(known.sum()))
    if count < FEWEST or not bool(unknown.any()):
        return
    distances = torch.cdist(places[unknown], places[known])
    nearest = distances.topk(count, largest=False).indices
    sh[unknown] = sh[known][nearest].median(dim=1).values
