"""Appearance of edits: ground under removed objects, contact shadows, lamps, lighting."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import replace
from functools import cache, lru_cache
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from real2sim_proto.drive import Lamp

from ..geometry import (
    Float,
    bottom_centres,
    invert_transform,
    transform_from,
    yaw_quaternion,
)
from ..render.types import Instance
from ..scene import UNSEEN, GaussianCloud, Ground, Scene
from ..scene.cloud import SH_C0
from ..scene.coverage import LOW, MARGIN
from .state import ObjectState, ScenarioState

Colour = tuple[float, float, float]

PARKED = 0.5
"""An object is parked if all its recorded positions are within this distance of each other [m];
tracks of stationary objects vary by some decimetres.
"""

AWAY = 0.5
"""An object at least this far from its parked position uncovers the ground there [m]."""

RIM = 1.2
"""Width of the ground around the box that represents the ground under it [m]."""

MIN_POINTS = 6
NEIGHBOURS = 48
"""Number of neighbours for the median colour; large enough to ignore lines and shadows next to the
box.
"""


def vacated_parking(state: ScenarioState, poses: Mapping[str, Float]) -> tuple[str, ...]:
    """Ids of recorded objects that were parked and are no longer in place.

    Args:
        state: state with the recorded objects.
        poses: ``T_world_object`` [4, 4] of all existing objects, by id, after edits and impacts.
    """
    return tuple(
        recorded.object_id
        for recorded in state.recorded.values()
        if _parked(recorded)
        and (
            _away(poses[recorded.object_id], recorded)
            if recorded.object_id in poses
            # An unedited object without a pose was not recorded at that time.
            else state.objects[recorded.object_id] is not recorded
        )
    )


def inpaint_ground(scene: Scene, background: GaussianCloud, left: Iterable[str]) -> GaussianCloud:
    """The background with the ground coloured like its surroundings where objects ``left`` stood.

    Gaussians inside a box and above its ground become invisible, because they belong to the object.
    Guessed colours get the uncertainty of unseen Gaussians.

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
    """Set ``sh`` of the ``unknown`` [N] bool to the median of their nearest ``known``, in place."""
    count = min(NEIGHBOURS, int(known.sum()))
    if count < MIN_POINTS or not bool(unknown.any()):
        return
    distances = torch.cdist(places[unknown], places[known])
    nearest = distances.topk(count, largest=False).indices
    sh[unknown] = sh[known][nearest].median(dim=1).values


# --- Contact shadows -----------------------------------------------------------------------------

# Shadows of recorded objects are part of the background. Edited objects share one cloud of flat
# dark Gaussians, scaled to each footprint.

SHADOW_MARGIN = 0.35
"""The shadow reaches this far beyond the footprint [m], fading."""

LIFT = 0.04
"""Height above the ground [m], in front of the ground's own Gaussians."""

DARKNESS = 0.22
"""Opacity of each Gaussian in full shadow. About three overlap at any point: half the light."""

FADE_HEIGHT = 1.0
"""Objects this high above the ground cast no contact shadow [m]."""

LEVELS = 8
"""Shades between none and full."""

CELLS = (20, 12)
COLOUR = (0.02, 0.02, 0.025)


def contact_shadow(
    T_world_object: Float,
    size: tuple[float, float, float],
    ground: Ground,
    *,
    device: torch.device,
) -> Instance | None:
    """The shadow of a box; None if the box is too far above the ground.

    Args:
        T_world_object: [4, 4] float64 pose of the box centre.
        size: (length, width, height) [m].
        ground: ground below the box.
        device: device of the shadow's Gaussians.
    """
    bottom = bottom_centres(T_world_object[None], size)[0]
    height = ground.height(float(bottom[0]), float(bottom[1]))
    clearance = max(0.0, float(bottom[2]) - height)
    level = round(LEVELS * (1 - clearance / FADE_HEIGHT))
    if level <= 0:
        return None
    forward = T_world_object[:3, 0]
    yaw = np.arctan2(forward[1], forward[0])
    level_ground = transform_from([bottom[0], bottom[1], height + LIFT], yaw_quaternion(float(yaw)))
    footprint = (size[0] + 2 * SHADOW_MARGIN, size[1] + 2 * SHADOW_MARGIN, 1.0)
    return Instance(_decal(level, str(device)), level_ground, instance_id=0, scale=footprint)


@cache
def _decal(level: int, device: str) -> GaussianCloud:
    """A unit square of flat Gaussians, darkest in the middle and invisible at the rim."""
    columns, rows = CELLS
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) / columns - 0.5,
        (np.arange(rows) + 0.5) / rows - 0.5,
        indexing="ij",
    )
    inside = np.clip((0.5 - np.maximum(np.abs(x), np.abs(y))) / 0.2, 0.0, 1.0)
    corner = np.clip((0.62 - np.hypot(x, y)) / 0.2, 0.0, 1.0)
    shade = (inside * inside * (3 - 2 * inside) * corner).ravel()
    count = len(shade)
    means = np.stack([x.ravel(), y.ravel(), np.zeros(count)], axis=1)
    spread = [0.7 / columns, 0.7 / rows, 0.004]
    colour = (torch.tensor(COLOUR) - 0.5) / SH_C0
    decal = GaussianCloud(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.tensor(spread).repeat(count, 1),
        opacities=torch.from_numpy(shade * DARKNESS * level / LEVELS).float(),
        sh=colour.expand(count, 1, 3).contiguous(),
    )
    return decal.to(device)


# --- Lamps ---------------------------------------------------------------------------------------

# A lit lamp is a few Gaussians of its colour on the surface of the body, with a bright core.

GLOW: Mapping[Lamp, tuple[Colour, Colour]] = {
    "brake": ((1.0, 0.03, 0.02), (1.0, 0.45, 0.35)),
    "indicator_left": ((1.0, 0.42, 0.0), (1.0, 0.8, 0.35)),
    "indicator_right": ((1.0, 0.42, 0.0), (1.0, 0.8, 0.35)),
}
"""Colour of a lamp, and of its core."""

BRAKE_INSET, INDICATOR_INSET = 0.28, 0.12
"""Distance of the centre of a lamp from the side of the box [m]."""

LAMP_HEIGHT = 0.55, 0.9
"""Height of lamps above the bottom of the box: part of its height, and the most [m]."""

LAMP_SPREAD = (0.025, 0.065, 0.05)
"""Standard deviations of a lamp along the axes of the object [m]."""

BEYOND_BODY = 0.03
"""Distance of lamps from the surface of the body [m]."""

_lamp_clouds: WeakKeyDictionary[GaussianCloud, dict[Hashable, GaussianCloud]] = WeakKeyDictionary()


def lamp_cloud(
    body: GaussianCloud,
    scale: tuple[float, float, float],
    size: tuple[float, float, float],
    lamps: tuple[Lamp, ...],
) -> GaussianCloud:
    """The light of ``lamps`` in the frame of the object, already scaled. Cached.

    Args:
        body: Gaussians of the object.
        scale: scale of the body.
        size: (length, width, height) of the scaled box [m].
        lamps: the lit lamps.
    """
    known, key = _lamp_clouds.setdefault(body, {}), (scale, size, lamps)
    if key in known:
        return known[key]
    points = (
        body.means[body.opacities > 0.5].cpu().double() * torch.tensor(scale).double()
    ).numpy()
    means, spreads, colours = [], [], []
    for lamp in lamps:
        for end, side in _corners(lamp):
            inset = BRAKE_INSET if lamp == "brake" else INDICATOR_INSET
            y = side * max(size[1] / 2 - inset, size[1] / 8)
            z = min(LAMP_HEIGHT[0] * size[2], LAMP_HEIGHT[1]) - size[2] / 2
            x = end * (_surface(points, end, y, z, size[0]) + BEYOND_BODY)
            for core, colour in enumerate(GLOW[lamp]):
                means.append((x + end * 0.01 * core, y, z))
                spreads.append(np.array(LAMP_SPREAD) / (1 + core))
                colours.append(colour)
    count = len(means)
    light = GaussianCloud(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.from_numpy(np.array(spreads)).float(),
        opacities=torch.full((count,), 0.99),
        sh=((torch.tensor(colours) - 0.5) / SH_C0)[:, None].contiguous(),
    )
    known[key] = light.to(body.device)
    return known[key]


def _corners(lamp: Lamp) -> list[tuple[float, float]]:
    """Signs of the corners of a lamp: front 1 or rear -1, left 1 or right -1."""
    if lamp == "brake":
        return [(-1.0, 1.0), (-1.0, -1.0)]
    side = 1.0 if lamp == "indicator_left" else -1.0
    return [(1.0, side), (-1.0, side)]


def _surface(points: Float, end: float, y: float, z: float, length: float) -> float:
    """Distance of the body's surface from its centre towards an ``end`` at y, z [m].

    That of the box where the body has no Gaussians.
    """
    x = end * points[:, 0]
    near = (abs(points[:, 1:] - (y, z)) < 0.12).all(axis=1) & (x > length / 6)
    return min(float(np.quantile(x[near], 0.95)), length / 2) if near.any() else length / 2


# --- Lighting ------------------------------------------------------------------------------------

AROUND = 20.0
"""Distance around the ego's path in which the background gives the ambient light [m]."""

HEIGHTS = (-2.0, 6.0)
"""The same below and above the path, to include the street but not the tree tops [m]."""

GAIN_RANGE = (0.5, 2.0)
"""Limits of colour factors; larger corrections are more likely to be errors of the estimate."""

LUMA = (0.2126, 0.7152, 0.0722)


def ambient_colour(scene: Scene) -> Colour:
    """Mean colour of the street around the ego's path, weighted by the Gaussians' visible area."""
    cloud = scene.background
    path = torch.from_numpy(scene.ego.positions).to(cloud.means)
    low, high = path.min(dim=0).values, path.max(dim=0).values
    reach = torch.tensor([AROUND, AROUND, 0.0]).to(cloud.means)
    below, above = (torch.tensor([0.0, 0.0, h]).to(cloud.means) for h in HEIGHTS)
    near = (cloud.means >= low - reach + below) & (cloud.means <= high + reach + above)
    chosen = near.all(dim=1)
    mean = mean_colour(cloud.select(chosen)) if bool(chosen.any()) else mean_colour(cloud)
    return mean or (0.5, 0.5, 0.5)


def mean_colour(cloud: GaussianCloud) -> Colour | None:
    """Mean RGB of a cloud, each Gaussian weighted by opacity and area; None if it is invisible."""
    if not len(cloud):
        return None
    largest = cloud.scales.double().topk(2, dim=1).values.prod(dim=1)
    weights = cloud.opacities.double() * largest
    if float(weights.sum()) <= 0:
        return None
    rgb = (cloud.sh[:, 0].double() * SH_C0 + 0.5).clamp(0.0, 1.0)
    red, green, blue = ((rgb * weights[:, None]).sum(dim=0) / weights.sum()).tolist()
    return (red, green, blue)


def relighting_gain(scene: Scene, cloud: GaussianCloud, ambient: Colour | None) -> Colour:
    """Factors on the colours of an asset that adapt it to the light of ``scene``.

    If the light of the asset's recording is known, they are the ratio of the two ambient colours.
    Otherwise the brightness is matched to the scene's own objects; the tint does not change.

    Args:
        scene: scene that receives the asset.
        cloud: Gaussians of the asset.
        ambient: ambient colour of the asset's source, see :func:`ambient_colour`.
    """
    if ambient is not None:
        here = ambient_colour(scene)
        red, green, blue = (_bounded(h / max(a, 1e-3)) for h, a in zip(here, ambient, strict=True))
        return (red, green, blue)
    own = mean_colour(cloud)
    others = [mean_colour(o.cloud) for o in scene.objects.values()]
    lumas = [_luma(colour) for colour in others if colour is not None]
    if own is None or not lumas:
        return (1.0, 1.0, 1.0)
    factor = _bounded(float(np.median(lumas)) / max(_luma(own), 1e-3))
    return (factor, factor, factor)


def relit(cloud: GaussianCloud, gain: Colour) -> GaussianCloud:
    """The cloud with its colours multiplied by ``gain``; the same object if ``gain`` is 1."""
    if gain == (1.0, 1.0, 1.0):
        return cloud
    factors: Tensor = torch.tensor(gain).to(cloud.sh)
    sh = cloud.sh * factors
    # The renderer adds 0.5 to the harmonics; this constant must be multiplied too.
    sh[:, 0] += (factors - 1.0) * 0.5 / SH_C0
    return replace(cloud, sh=sh)


def _luma(colour: Colour) -> float:
    return sum(w * c for w, c in zip(LUMA, colour, strict=True))


def _bounded(factor: float) -> float:
    low, high = GAIN_RANGE
    return min(high, max(low, factor))
