"""Appearance of edits: ground that objects leave, and lamps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from real2sim_proto.drive import Lamp

from ..geometry import Float, invert_transform
from ..scene import UNSEEN, GaussianCloud, Scene
from ..scene.cloud import SH_C0
from ..scene.coverage import LOW, MARGIN, SEEN
from ..scene.ground_fit import Size, cell_means, pull_push, sample_cells
from ..scene.sunlight import LightMap, lasting_shadows
from .light import Colour, Recent
from .state import ObjectState, ScenarioState

PARKED = 0.5
"""An object is parked if all its recorded positions are within this distance of each other [m];
tracks of stationary objects vary by some decimetres.
"""

AWAY = 0.5
"""An object at least this far from its parked position uncovers the ground there [m]."""

TURNED = math.cos(math.radians(10))
"""Maximum cosine between the heading of a turned object and that of the parked one."""

HIDDEN = 3.0
"""Ground that no image shows is continued up to this far from the box [m]."""

SQUARE = 0.3
"""Edge of the squares in which ground is hidden if nothing was seen there [m]."""

RIM = 1.2
"""Width of the known ground from which hidden ground is continued [m]."""

FADING = 0.3
"""Distance over which differences from the continued lines fade [m]."""

CELL = 0.08
"""Edge of the cells from which the ground is continued [m]."""

MIN_POINTS, MIN_CELLS = 6, 3
"""Minimum number of known Gaussians, and of known cells in a strip."""

BRIEF = 0.1
"""Recorded shadows are removed where they are for more than this share of their object's time."""


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
        and _vacated(recorded, state.objects[recorded.object_id], poses.get(recorded.object_id))
    )


def off_track(state: ScenarioState) -> tuple[str, ...]:
    """Ids of recorded moving objects that are deleted or move elsewhere."""
    return tuple(
        recorded.object_id
        for recorded in state.recorded.values()
        if not _parked(recorded)
        and (now := state.objects[recorded.object_id]) is not recorded
        and (now.deleted or now.trajectory is not recorded.trajectory)
    )


def without_shadows(scene: Scene, background: GaussianCloud, left: Iterable[str]) -> GaussianCloud:
    """The background without the recorded shadows of objects ``left`` on the ground.

    Raises:
        UnknownObjectError: ``scene`` has no such object.
    """
    light_map = scene.light_map
    if light_map is None:
        return background
    sh, sun = background.sh.clone(), light_map.sun
    points = background.means.cpu().double().numpy()
    height = np.abs(points[:, 2] - scene.ground.height_at(points[:, :2]))
    level = np.flatnonzero(height <= LOW)
    for object_id in left:
        item = scene.object(object_id)
        dark = level[lasting_shadows([item], points[level], sun, share=BRIEF)]
        rows = torch.from_numpy(dark).to(sh.device)
        _relight(sh, rows, points[dark, :2], light_map)
    return replace(background, sh=sh)


def inpaint_ground(scene: Scene, background: GaussianCloud, left: Iterable[str]) -> GaussianCloud:
    """The background with the ground continued where objects ``left`` stood.

    Gaussians inside a box and above its ground become invisible, because they belong to the object.
    Guessed colours get the uncertainty of unseen Gaussians.

    Args:
        scene: has the objects.
        background: its background.
        left: ids of the objects.

    Raises:
        UnknownObjectError: ``scene`` has no such object.
    """
    opacities, sh = background.opacities.clone(), background.sh.clone()
    uncertainties = background.uncertainties
    if uncertainties is not None:
        uncertainties = uncertainties.clone()
    for object_id in left:
        parked = scene.object(object_id)
        T_world_box = parked.trajectory.middle
        to_box = torch.from_numpy(invert_transform(T_world_box)).to(background.means)
        local = background.means @ to_box[:3, :3].T + to_box[:3, 3]
        half = torch.tensor(parked.size).to(local) / 2
        beyond = (local[:, :2].abs() - half[:2]).amax(dim=1)
        height = local[:, 2] + half[2]
        level = height.abs() <= LOW
        opacities[(beyond <= 0) & (height > LOW) & (local[:, 2] <= half[2])] = 0.0
        # Gaussians below the ground would show through it.
        unknown = (height <= LOW) & (height > -half[2]) & (beyond <= MARGIN)
        known = level & ~unknown & (opacities > 0.1)
        if uncertainties is not None:
            near = level & (beyond <= HIDDEN)
            unknown[near] |= _hidden(local[near, :2], (known & (uncertainties < SEEN))[near])
            uncertainties[unknown] = UNSEEN
        _continue_ground(sh, local[:, :2], unknown, known & ~unknown)
    return replace(background, opacities=opacities, sh=sh, uncertainties=uncertainties)


@lru_cache(maxsize=4096)
def _parked(recorded: ObjectState) -> bool:
    low, high = recorded.bounds[:, :2]
    return bool((high - low - 2 * recorded.radius).max() <= PARKED)


def _vacated(parked: ObjectState, now: ObjectState, pose: Float | None) -> bool:
    if pose is None:
        # An unedited object without a pose was not recorded at that time.
        return now is not parked
    (low_x, low_y), (high_x, high_y) = parked.bounds[:, :2].tolist()
    x, y = float(pose[0, 3]), float(pose[1, 3])
    if math.hypot(x - (low_x + high_x) / 2, y - (low_y + high_y) / 2) > AWAY:
        return True
    # Headings of recorded tracks can be noisy.
    edited = now.trajectory is not parked.trajectory
    return edited and float(pose[:3, 0] @ parked.trajectory.middle[:3, 0]) < TURNED


def _relight(sh: Tensor, rows: Tensor, places: Float, light_map: LightMap) -> None:
    """Take an object's shadow out of ``sh`` of the ground's Gaussians ``rows`` [M], in place."""
    colours = (sh[rows, 0] * SH_C0 + 0.5).cpu().double().numpy()
    lit = torch.from_numpy(light_map.without_shadow(colours, places)).to(sh)
    gain = lit / (sh[rows, 0] * SH_C0 + 0.5).clamp(min=0.01)
    sh[rows] = sh[rows] * gain[:, None]
    sh[rows, 0] = (lit - 0.5) / SH_C0


def _hidden(places: Tensor, seen: Tensor) -> Tensor:
    """[N] bool, ``places`` [N, 2] that are not ``seen`` [N], in or next to a square without seen
    ones. Single unseen Gaussians between seen ones do not count.
    """
    if not len(places):
        return seen
    row, column = ((places - places.amin(dim=0)) / SQUARE).long().T
    count = torch.zeros(int(row.max()) + 1, int(column.max()) + 1).to(places)
    count.index_put_((row, column), seen.to(places), accumulate=True)
    near = torch.nn.functional.max_pool2d((count == 0).to(places)[None], 3, 1, 1)[0] > 0
    return ~seen & near[row, column]


def _continue_ground(sh: Tensor, places: Tensor, unknown: Tensor, known: Tensor) -> None:
    """Set ``sh`` of the ``unknown`` [N] bool from the ``known`` around them, in place.

    Opposite sides of the rectangle around the unknown ones are joined by straight lines along the
    axis on which they look more alike, so that kerbs and markings go on. What still differs at the
    border fades inwards; it makes nothing brighter than 95 % of the ground around.

    Args:
        sh: [N, K, 3].
        places: [N, 2] in the frame of the rectangle [m].
        unknown: Gaussians without a colour.
        known: Gaussians with one; only those up to RIM around the unknown ones count.
    """
    import cv2

    if not bool(unknown.any()):
        return
    low, high = places[unknown].amin(dim=0) - RIM, places[unknown].amax(dim=0) + RIM
    known = known & ((places >= low) & (places <= high)).all(dim=1)
    if int(known.sum()) < MIN_POINTS:
        return
    corner, size = (v.cpu().double().numpy() for v in (low, high - low))
    rows, columns = np.ceil(size / CELL).astype(int)
    shape = int(rows), int(columns)
    at = np.floor((places[known].cpu().double().numpy() - corner) / CELL).astype(int)
    cells = np.ravel_multi_index(at.clip(0, np.array(shape) - 1).T, shape)
    colours = (sh[known, 0] * SH_C0 + 0.5).clamp(0, 1).cpu().double().numpy()
    mean, counts = cell_means(colours, cells, shape)
    joined = [_join(mean, counts > 0, axis) for axis in (0, 1)]
    lines, _ = min(joined, key=lambda pair: pair[1])
    rest = np.where((counts > 0)[..., None], mean - lines, 0).astype(np.float32)
    away = cv2.distanceTransform((counts == 0).astype(np.uint8), cv2.DIST_L2, 5)[..., None] * CELL
    fading = np.exp(-away / FADING)
    guess = lines + fading * pull_push(rest, np.minimum(counts, 1).astype(np.float32))
    guess = np.minimum(guess, np.maximum(lines, np.quantile(colours, 0.95, axis=0)))
    colour = sample_cells(guess, (places[unknown].cpu().double().numpy() - corner) / CELL)
    sh[unknown] = 0
    sh[unknown, 0] = torch.from_numpy((colour - 0.5) / SH_C0).to(sh)


def _join(mean: Float, known: NDArray[np.bool_], axis: int) -> tuple[Float, float]:
    """Colours [X, Y, 3] joined between both ends of an axis, which are RIM wide, and how much the
    ends differ.
    """
    mean, known = np.moveaxis(mean, axis, 0), np.moveaxis(known, axis, 0)
    along = (np.arange(len(mean)) + 0.5) * CELL
    length = len(mean) * CELL
    ends = []
    for end in (along < RIM, along > length - RIM):
        seen = np.where(known[end][..., None], mean[end], np.nan)
        enough = known[end].sum(axis=0) >= MIN_CELLS
        seen[:, ~enough] = 0
        strip = np.nanmedian(seen, axis=0).astype(np.float32)
        filled = pull_push(strip[None], enough[None].astype(np.float32))[0]
        ends.append((filled, enough))
    (first, a), (last, b) = ends
    first, last = (first if a.any() else last), (last if b.any() else first)
    share = np.clip((along - RIM) / max(length - 2 * RIM, CELL), 0, 1)[:, None, None]
    joined = np.moveaxis(first * (1 - share) + last * share, 0, axis)
    both = a & b
    differ = float(np.abs(first - last)[both].mean()) if both.any() else np.inf
    return joined, differ


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

KEPT_LAMPS = 8
"""Number of cached combinations of lit lamps per body."""

BEYOND_BODY = 0.03
"""Distance of lamps from the surface of the body [m]."""

_lamp_clouds: Recent[GaussianCloud, GaussianCloud] = Recent(KEPT_LAMPS)


def lamp_cloud(
    body: GaussianCloud, scale: Size, size: Size, lamps: tuple[Lamp, ...]
) -> GaussianCloud:
    """The light of ``lamps`` in the frame of the object, already scaled. Cached.

    Args:
        body: Gaussians of the object.
        scale: scale of the body.
        size: (length, width, height) of the scaled box [m].
        lamps: the lit lamps.
    """
    return _lamp_clouds.get(body, (scale, size, lamps), lambda: _glow(body, scale, size, lamps))


def _glow(body: GaussianCloud, scale: Size, size: Size, lamps: tuple[Lamp, ...]) -> GaussianCloud:
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
    return light.to(body.device)


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
