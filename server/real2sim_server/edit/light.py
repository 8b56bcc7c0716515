"""Light of edits: shadows and shading of moved objects, and the light of assets.

Shadows of recorded objects are part of the recorded colours. Each edited object gets its own layer
of dark Gaussians on the ground: its silhouette along the sun, where the sun shines, and a soft
contact shadow around its footprint.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cache
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry import (
    Float,
    apply_transform,
    bottom_centres,
    transform_from,
    yaw_quaternion,
)
from ..render.types import Instance
from ..scene import GaussianCloud, Ground, Scene, SceneObject, Sunlight, TimeColour
from ..scene.cloud import SH_C0
from ..scene.ground_fit import Size
from ..scene.sunlight import LUMA, LightMap, relight

Colour = tuple[float, float, float]

CELL = 0.12
"""Spacing of a shadow's Gaussians [m]; wider for large shadows."""

MAX_CELLS = 2500
SPREAD = 0.7
"""Standard deviation of a shadow's Gaussians, relative to their spacing."""

SHADOW_MARGIN = 0.35
"""The contact shadow reaches this far beyond the footprint [m], fading."""

PENUMBRA = 0.08
"""Standard deviation of a silhouette's soft edge [m]."""

LIFT = 0.03
"""Height above the ground [m], in front of the ground's own Gaussians."""

DARKNESS = 0.5
"""Opacity of the contact shadow in the middle of the footprint."""

FADE_HEIGHT = 1.0
"""Objects this high above the ground cast no contact shadow [m]."""

MIN_OPACITY = 0.02
"""Cells with less shadow have no Gaussian."""

MAX_POINTS = 20_000
"""Maximum number of an object's Gaussians that form its silhouette."""

GAPS = 0.35
"""Gaps of a silhouette up to this wide are closed [m]."""

TURN = np.deg2rad(3.0)
"""Silhouettes are cached for directions of the sun in these steps [rad]."""

TINT = 0.45
"""Usual colour of sunlit ground; makes shadows as blue as in the log."""


KEPT_SILHOUETTES, KEPT_SHADINGS = 32, 4
"""Numbers of cached silhouettes and shadings per cloud."""

K = TypeVar("K")
V = TypeVar("V")


class Recent(Generic[K, V]):
    """The most recent results for each owner. Owners are held weakly; threads may share it.

    Args:
        limit: number of results per owner.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._lock = limit, threading.Lock()
        self._held: WeakKeyDictionary[K, OrderedDict[Hashable, V]] = WeakKeyDictionary()

    def get(self, owner: K, key: Hashable, make: Callable[[], V]) -> V:
        """The result for ``key``; ``make`` makes it if it is not held."""
        with self._lock:
            held = self._held.setdefault(owner, OrderedDict())
            if key not in held:
                held[key] = make()
            held.move_to_end(key)
            while len(held) > self._limit:
                held.popitem(last=False)
            return held[key]


@dataclass(frozen=True, eq=False)
class _Silhouette:
    """Shadow of an object on level ground, in the level frame of its bottom's centre.

    Attributes:
        low: [2], corner of cell (0, 0) [m].
        cell: edge of a cell [m].
        covered: [X, Y] share of the sun that the object hides.
        contact: [X, Y] contact shadow, from 0 to 1.
    """

    low: Float
    cell: float
    covered: NDArray[np.float32]
    contact: NDArray[np.float32]

    def places(self) -> Float:
        """Centres [X, Y, 2] of the cells."""
        return _centres(self.low, self.cell, self.covered.shape)


def cast_shadow(
    T_world_object: Float,
    cloud: GaussianCloud,
    scale: Size,
    size: Size,
    ground: Ground,
    *,
    light_map: LightMap | None = None,
) -> Instance | None:
    """The shadow of an object on the ground; None if there is none.

    Args:
        T_world_object: [4, 4] float64 pose of the box centre.
        cloud: Gaussians of the object, in its frame before scaling.
        scale: scale of the cloud.
        size: (length, width, height) of the scaled box [m].
        ground: ground below the box.
        light_map: of the scene; None casts only a contact shadow.
    """
    bottom = bottom_centres(T_world_object[None], size)[0]
    clearance = max(0.0, float(bottom[2]) - ground.height(float(bottom[0]), float(bottom[1])))
    contact = DARKNESS * max(0.0, 1 - clearance / FADE_HEIGHT)
    forward = T_world_object[:3, 0]
    heading = float(np.arctan2(forward[1], forward[0]))
    level = transform_from([*bottom[:2], 0.0], yaw_quaternion(heading))
    sun = None if light_map is None else light_map.sun
    found = _silhouette(cloud, scale, size, sun, heading)
    if sun is not None:
        # The shadow of an object in the air is away from it.
        level[:2, 3] -= clearance * sun.towards[:2] / sun.towards[2]
    places = found.places().reshape(-1, 2)
    world = apply_transform(level, np.column_stack([places, np.zeros(len(places))]))
    dark = np.asarray(contact * found.contact.ravel(), np.float64)
    if light_map is not None:
        shade = float(light_map.sun.shade.min())
        hidden = (1 - shade) * found.covered.ravel() * light_map.lit(world[:, :2])
        dark = 1 - (1 - dark) * (1 - hidden)
    kept = dark > MIN_OPACITY
    if not kept.any():
        return None
    places, dark = places[kept], dark[kept]
    heights = ground.height_at(world[kept, :2]) + LIFT
    spread = SPREAD * found.cell
    tint = np.full(3, 0.02)
    if sun is not None:
        tint += TINT * (sun.shade - sun.shade.min()) / (1 - sun.shade.min())
    count = len(places)
    layer = GaussianCloud(
        means=torch.from_numpy(np.column_stack([places, heights])).float(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.tensor([spread, spread, 0.004]).repeat(count, 1),
        opacities=torch.from_numpy(_opacities(dark)).float(),
        sh=torch.from_numpy((tint - 0.5) / SH_C0).float().expand(count, 1, 3).contiguous(),
    )
    return Instance(layer.to(cloud.device), level, instance_id=0)


def _opacities(dark: Float) -> Float:
    """Opacities [N] of Gaussians on a grid that together hide the shares ``dark`` [N]."""
    peaks, total = _overlap()
    return np.asarray(np.interp(dark, total, peaks))


@cache
def _overlap() -> tuple[Float, Float]:
    """Opacities [P] of equal Gaussians on a grid, and the share [P] that they hide together."""
    peaks = np.linspace(0, 0.98, 99)
    offsets = np.arange(-4, 5)
    inside = (np.arange(4) + 0.5) / 4 - 0.5
    along = (offsets[:, None] + inside) ** 2
    squares = along[:, None, :, None] + along[None, :, None, :]
    weights = np.exp(-0.5 * squares / SPREAD**2).reshape(len(offsets) ** 2, -1)
    clear = np.log1p(-peaks[:, None, None] * weights).sum(axis=1)
    return peaks, 1 - np.exp(clear).mean(axis=1)


_silhouettes: Recent[GaussianCloud, _Silhouette] = Recent(KEPT_SILHOUETTES)


def _silhouette(
    cloud: GaussianCloud, scale: Size, size: Size, sun: Sunlight | None, heading: float
) -> _Silhouette:
    turn, way = None, np.zeros(2)
    if sun is not None:
        turn = round((np.arctan2(sun.towards[1], sun.towards[0]) - heading) / TURN)
        length = float(np.hypot(*sun.towards[:2]) / sun.towards[2])
        way = -length * np.array([np.cos(turn * TURN), np.sin(turn * TURN)])

    def make() -> _Silhouette:
        points = None if sun is None else _points(cloud, scale, size)
        return _made(points, size, way)

    return _silhouettes.get(cloud, (scale, size, *way), make)


def _points(cloud: GaussianCloud, scale: Size, size: Size) -> Float:
    """Centres [N, 3] of the visible Gaussians in the box, z above its bottom."""
    points = cloud.means[cloud.opacities > 0.3].cpu().double().numpy() * np.array(scale)
    half = np.array(size) / 2
    points = points[(np.abs(points) < 1.1 * half).all(axis=1)] + [0, 0, half[2]]
    points[:, 2] = points[:, 2].clip(0)
    return np.asarray(points[:: -(-len(points) // MAX_POINTS) or 1])


def _made(points: Float | None, size: Size, way: Float) -> _Silhouette:
    """Silhouette of ``points``; a point at height h shades the ground ``way`` [2] * h away."""
    import cv2

    half = np.array(size[:2]) / 2
    spots = np.zeros((0, 2)) if points is None else points[:, :2] + points[:, 2:] * way
    ends = np.concatenate([spots, [-half - SHADOW_MARGIN, half + SHADOW_MARGIN]])
    low, high = ends.min(axis=0) - 3 * PENUMBRA, ends.max(axis=0) + 3 * PENUMBRA
    cell = max(CELL, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
    shape = np.ceil((high - low) / cell).astype(int)
    covered = np.zeros(shape, np.float32)
    if len(spots):
        covered[tuple(((spots - low) / cell).astype(int).T)] = 1
        width = 2 * round(GAPS / 2 / cell) + 1
        closing = np.ones((width, width), np.uint8)
        closed = cv2.morphologyEx(np.pad(covered, width), cv2.MORPH_CLOSE, closing)
        soft = cv2.GaussianBlur(closed, (0, 0), PENUMBRA / cell)
        covered = np.asarray(soft[width:-width, width:-width], np.float32)
    outline = 2 * half + 2 * SHADOW_MARGIN
    x, y = (np.abs(_centres(low, cell, covered.shape)) / outline).transpose(2, 0, 1)
    inside = np.clip((0.5 - np.maximum(x, y)) / 0.2, 0.0, 1.0)
    corner = np.clip((0.62 - np.hypot(x, y)) / 0.2, 0.0, 1.0)
    contact = (inside * inside * (3 - 2 * inside) * corner).astype(np.float32)
    return _Silhouette(low, cell, covered, contact)


def _centres(low: Float, cell: float, shape: tuple[int, ...]) -> Float:
    x, y = (np.arange(n) + 0.5 for n in shape)
    return np.asarray(low + cell * np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))


# --- Shading -------------------------------------------------------------------------------------

NEIGHBOURS = 24
"""Number of neighbours that give the normal of a Gaussian."""

PLACE = 0.25
"""Shadings are cached for positions in these steps [m]."""

POSES = 16
"""Number of recorded poses that give the light in which an object was seen."""

SHADING_RANGE = (0.1, 10.0)
"""Limits of the change of light."""

DARKEST = 0.02
"""Darker colours change by the same factor as this one."""

MOMENTS = 64
"""Shadings are cached for this many moments of a recording, if its colours vary."""


_shadings: Recent[GaussianCloud, tuple[GaussianCloud, TimeColour | None]] = Recent(KEPT_SHADINGS)
_surfaces: Recent[GaussianCloud, tuple[Float, Float]] = Recent(1)


def shaded(
    item: SceneObject, T_world_object: Float, t_us: int, light_map: LightMap
) -> tuple[GaussianCloud, TimeColour | None]:
    """The Gaussians of a recorded object at another pose in its light, and their change over time.

    Args:
        item: recorded object.
        T_world_object: [4, 4] float64 pose of the box centre.
        t_us: time [us].
        light_map: of the scene.
    """
    cloud, track = item.cloud, item.trajectory
    # The light on a parked object does not change: its colours vary with the direction of view.
    colour = item.colour if track.moves else None
    step_us = max(1, (track.end_us - track.start_us) // MOMENTS)
    moment_us = 0
    if colour is not None:
        moment_us = track.start_us + round((t_us - track.start_us) / step_us) * step_us
    recorded = track.transform(min(max(t_us, track.start_us), track.end_us))
    steps = tuple(_step(pose) for pose in (recorded, T_world_object))
    if steps[0] == steps[1]:
        return cloud, item.colour

    def make() -> tuple[GaussianCloud, TimeColour | None]:
        points = cloud.means.cpu().double().numpy()
        height = item.size[2] / 2

        def lit(pose: Float) -> Float:
            return light_map.lit_above(apply_transform(pose, points), points[:, 2] + height)

        def surface() -> tuple[Float, Float]:
            """Normals, and the share [T, N] of the sun over the recording."""
            return _outward(cloud), np.array([lit(pose) for pose in track.spread(POSES)])

        normals, shares = _surfaces.get(cloud, light_map, surface)
        was = shares.mean(axis=0)
        if colour is not None:
            # The colours follow the light as far as their few basis functions can. Sides that no
            # image shows have the mean light at all times.
            varies = (colour.coefficients != 0).flatten(1).any(1).cpu().numpy()
            tones = colour.tones_of(track.spread_times(POSES)) @ colour.tones(moment_us).numpy()
            weights = (1 + 2 * tones) / len(tones)
            was[varies] = (weights @ shares[:, varies] / max(weights.sum(), 0.5)).clip(0, 1)
        sun = light_map.sun
        before = sun.on(normals @ recorded[:3, :3].T, was)
        after = sun.on(normals @ T_world_object[:3, :3].T, lit(T_world_object))
        shown = (cloud.sh[:, 0].cpu().numpy() * SH_C0 + 0.5).clip(DARKEST, 1)
        factors = relight(shown, np.clip(after / before, *SHADING_RANGE)) / shown
        gain = torch.from_numpy(factors).to(cloud.sh)
        if colour is None:
            return relit(cloud, gain), None
        return relit(cloud, gain), replace(colour, coefficients=colour.coefficients * gain[:, None])

    return _shadings.get(cloud, (light_map, moment_us, *steps), make)


def _step(pose: Float) -> tuple[int, ...]:
    heading = np.arctan2(pose[1, 0], pose[0, 0])
    return (*(round(x / PLACE) for x in pose[:3, 3]), round(heading / TURN))


def _outward(cloud: GaussianCloud) -> Float:
    """Unit normals [N, 3] of an object's surface at its Gaussians, outwards."""
    from scipy.spatial import cKDTree

    means = cloud.means.cpu().double().numpy()
    solid = means[(cloud.opacities > 0.3).cpu().numpy()]
    if len(solid) <= NEIGHBOURS:
        return np.tile([0.0, 0, 1], (len(means), 1))
    _, near = cKDTree(solid).query(means, k=NEIGHBOURS, workers=-1)
    offsets = solid[near] - solid[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    normals = axes[:, :, 0]
    # Outwards is away from the middle of the body.
    half = np.abs(solid).max(axis=0)
    middle = means.copy()
    middle[:, 0] = means[:, 0].clip(-0.7 * half[0], 0.7 * half[0])
    middle[:, 1], middle[:, 2] = 0, means[:, 2].clip(-0.7 * half[2], 0.2 * half[2])
    inwards = (normals * (means - middle)).sum(axis=1) < 0
    normals[inwards] *= -1
    return np.asarray(normals)


# --- Light of assets -----------------------------------------------------------------------------

AROUND = 20.0
"""Distance around the ego's path in which the background gives the ambient light [m]."""

HEIGHTS = (-2.0, 6.0)
"""The same below and above the path, to include the street but not the tree tops [m]."""

GAIN_RANGE = (0.5, 2.0)
"""Limits of colour factors; larger corrections are more likely to be errors of the estimate."""


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


def relit(cloud: GaussianCloud, gain: Colour | Tensor) -> GaussianCloud:
    """The cloud with its colours multiplied by ``gain``, for all or [N, 3] for each Gaussian; the
    same object if ``gain`` is 1.
    """
    factors = torch.as_tensor(gain).to(cloud.sh)
    if bool((factors == 1).all()):
        return cloud
    sh = cloud.sh * factors.unsqueeze(-2)
    # The renderer adds 0.5 to the harmonics; this constant must be multiplied too.
    sh[:, 0] += (factors - 1.0) * 0.5 / SH_C0
    return replace(cloud, sh=sh)


def _luma(colour: Colour) -> float:
    return float(LUMA @ colour)


def _bounded(factor: float) -> float:
    low, high = GAIN_RANGE
    return min(high, max(low, factor))
