"""The sun of a scene: where it shines on the ground, and how bright it makes surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, invert_transform
from .cloud import SH_C0, GaussianCloud
from .coverage import LOW, SEEN
from .errors import SceneError
from .ground import Ground
from .ground_fit import Size, Standing, cell_means, pull_push, sample_cells
from .trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Sunlight:
    """The sun of a drive, from the shadows of its vehicles.

    Attributes:
        towards: [3] float64, unit vector towards the sun, in the world; above the horizon.
        shade: [3] float64 in (0, 1), RGB of ground in a vehicle's shadow relative to sunlit ground.

    Raises:
        SceneError: ``towards`` is no unit vector above the horizon, or ``shade`` is out of range.
    """

    towards: Float
    shade: Float

    def __post_init__(self) -> None:
        towards, shade = (np.array(v, dtype=np.float64) for v in (self.towards, self.shade))
        if towards.shape != (3,) or not abs(np.linalg.norm(towards) - 1) < 1e-3 or towards[2] <= 0:
            raise SceneError(f"towards the sun must be a unit vector with z > 0, not {towards}")
        if shade.shape != (3,) or not ((shade > 0) & (shade < 1)).all():
            raise SceneError(f"shade must be three values between 0 and 1, not {shade}")
        for name, value in (("towards", towards), ("shade", shade)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def hidden_by(
        self, T_world_box: Float, size: Size, points: Float, *, margin: float = 0.0
    ) -> NDArray[np.bool_]:
        """[N] bool, ``points`` [N, 3] in the shadow of a box enlarged by ``margin`` [m]."""
        halves = (np.array(size) / 2 + margin)[None]
        return boxes_hit(points, self.towards, invert_transform(T_world_box)[None], halves)

    def on(self, normals: Float, lit: Float | float) -> NDArray[np.float32]:
        """Light [N, 3] on surfaces, 1 on sunlit level ground; see :func:`relight`.

        In the shade, surfaces that face up have the hue of the sky. The others also get light that
        the ground reflects, which is white.

        Args:
            normals: [N, 3] unit, outwards, in the world.
            lit: share of the sun that reaches them, for all or [N].
        """
        up = normals[:, 2:]
        # Cameras clip the light and the dark; vehicles have less contrast than their shadows.
        grey = float(self.shade @ LUMA)
        shade = (self.shade * max(1.0, MIN_SHADE / grey)) ** DISPLAY
        grey = max(grey, MIN_SHADE) ** DISPLAY
        facing = (normals @ self.towards).clip(0)[:, None] / self.towards[2]
        hue = (shade / grey) ** (0.5 + 0.5 * up)
        direct = np.reshape(lit, (-1, 1)) * facing * (1 - shade)
        light = (SIDE_LIGHT + (1 - SIDE_LIGHT) * up) * grey * hue + direct
        return np.asarray(light, np.float32)


def light_of(colours: NDArray[Any]) -> NDArray[Any]:
    """Light [N, 3] that display values [N, 3] show, 1 for white; below 0 counts as 0.

    Cameras compress bright light (Reinhard et al. 2002).
    """
    power = np.clip(colours, 0, MAX_PAINT) ** DISPLAY
    return np.asarray(power / (1 + SHOULDER * (1 - power)))


def relight(colours: NDArray[Any], gain: NDArray[Any] | float) -> NDArray[np.float32]:
    """Display values of ``colours`` [N, 3] in ``gain`` times the light.

    A white car changes less than a dark one. Values of paint in full light can be above 1.

    Args:
        colours: [N, 3] display values; below 0 counts as 0.
        gain: factor on the light, for all, [N, 1] or [N, 3].
    """
    light = gain * light_of(colours)
    power = (1 + SHOULDER) * light / (1 + SHOULDER * light)
    return np.asarray(power ** (1 / DISPLAY), np.float32)


def boxes_hit(points: Float, rays: Float, boxes: Float, halves: Float) -> NDArray[np.bool_]:
    """[N] bool, whether rays from points hit a box.

    Args:
        points: [N, 3], world [m].
        rays: directions [3] or [N, 3].
        boxes: ``T_box_world`` [B, 4, 4].
        halves: [B, 3] half of the sizes [m].
    """
    found = np.zeros(len(points), np.bool_)
    for T_box_world, half in zip(boxes, halves, strict=True):
        axes = T_box_world[:3, :3].T
        starts, directions = points @ axes + T_box_world[:3, 3], rays @ axes
        enter, leave = np.full(len(points), -np.inf), np.full(len(points), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for axis in range(3):
                a = (-half[axis] - starts[:, axis]) / directions[..., axis]
                b = (half[axis] - starts[:, axis]) / directions[..., axis]
                enter = np.fmax(enter, np.fmin(a, b))
                leave = np.fmin(leave, np.fmax(a, b))
        found |= (leave > 0) & (enter < leave)
    return found


CELL = 0.4
"""Edge of the cells in which ground counts as sunlit or not [m]."""

SHADOW_REACH = 0.3
"""Margin around the shadows of boxes, for their soft edges [m]."""

LASTING = 0.3
"""A shadow that is at a place for more than this share of its object's time is part of the recorded
ground: that of a parked car, or of a car in a traffic jam."""

POSES = 16
"""Number of compared poses of a moving object."""

MAX_SHADOW = 10.0
"""Maximum length of a shadow [m]."""

MIN_CONTRAST = 0.5
"""Minimum contrast of dark and bright ground for shade, relative to the contrast of shadows."""

MIN_CELLS = 100
"""Minimum number of cells with ground for shade."""

MAX_BRIGHTNESS = 1.1
"""Maximum brightness of ground without its shadow, relative to the usual one."""

LUMA = np.array([0.2126, 0.7152, 0.0722])

DISPLAY = 2.2
"""Exponent from display values to light."""

SHOULDER = 0.5
"""How strongly cameras compress bright light; 0 for not at all."""

MAX_PAINT = 1.5
"""Maximum display value of paint in full light."""

MIN_SHADE = 0.4
"""Minimum brightness of upward surfaces in the shade, relative to the sun."""

SIDE_LIGHT = 0.7
"""Light of the sky on upright surfaces, relative to level ground."""


class LightMap:
    """Sunlit and shaded ground of a scene, from the brightness of the ground.

    Attributes:
        sun: the sun.

    Args:
        sun: the sun.
        places: [N, 2] of ground outside of the shadows of vehicles, world [m].
        colours: [N, 3] there.
    """

    def __init__(self, sun: Sunlight, places: Float, colours: NDArray[np.float32]) -> None:
        self.sun = sun
        self._low = places.min(axis=0) if len(places) else np.zeros(2)
        at = ((places - self._low) / CELL).astype(np.int64)
        shape = tuple(at.max(axis=0) + 1) if len(places) else (1, 1)
        cells = np.asarray(np.ravel_multi_index(at.T, shape))
        mean, counts = cell_means(colours, cells, shape)
        weights = np.minimum(counts / 3, 1).astype(np.float32)
        self._usual = pull_push(mean.astype(np.float32), weights)
        self._lit = _lit(self._usual, counts > 0, sun)

    @classmethod
    def of(
        cls, sun: Sunlight, background: GaussianCloud, ground: Ground, objects: Iterable[Standing]
    ) -> LightMap:
        """The map of a scene, without the lasting shadows of its objects."""
        means = background.means.cpu().double().numpy()
        shown = (background.opacities > 0.3).cpu().numpy() & ground.covers(means[:, :2])
        shown &= np.abs(means[:, 2] - ground.height_at(means[:, :2])) < LOW
        if background.uncertainties is not None:
            shown &= background.uncertainties.cpu().numpy() < SEEN
        colours = (background.sh[:, 0].cpu().numpy()[shown] * SH_C0 + 0.5).clip(0, 1)
        points = means[shown]
        clear = ~lasting_shadows(objects, points, sun)
        return cls(sun, points[clear, :2], colours[clear])

    def lit(self, places: Float) -> Float:
        """Share [N] of the sun that reaches the ground at ``places`` [N, 2] [m]."""
        return self._at(self._lit[..., None], places)[:, 0]

    def lit_above(self, points: Float, heights: Float) -> Float:
        """Share [N] of the sun that reaches ``points`` [N, 3], ``heights`` [N] above the ground."""
        along = self.sun.towards[:2] / self.sun.towards[2]
        return self.lit(points[:, :2] - heights[:, None] * along)

    def light_along(self, trajectory: Trajectory) -> Callable[[Float], NDArray[np.float32]]:
        """Light [N, 3] on surfaces of an object, the mean over its path, by their normals [N, 3] in
        the world; see :meth:`Sunlight.on`.
        """
        lit = float(self.lit(trajectory.positions[:, :2]).mean())
        return partial(self.sun.on, lit=lit)

    def without_shadow(self, colours: Float, places: Float) -> Float:
        """Colours [N, 3] of ground at ``places`` [N, 2] in the shadow of an object, without it.

        Ground that is as bright as usual there does not change. The rest gets the usual hue.
        """
        usual = self._at(self._usual, places)
        ratio = np.log((colours @ LUMA).clip(0.01) / (usual @ LUMA).clip(0.01))
        dark = ratio / np.log(float(self.sun.shade @ LUMA))
        share = (np.clip((dark - 0.25) / 0.5, 0, 1) * self.lit(places))[:, None]
        lit = usual * ((colours / self.sun.shade) @ LUMA / (usual @ LUMA).clip(0.01))[:, None]
        # In the soft edge, only a part of the light is missing.
        limit = np.maximum(colours, MAX_BRIGHTNESS * usual)
        return np.asarray(np.minimum(colours * (1 - share) + lit * share, limit))

    def _at(self, values: NDArray[np.float32], places: Float) -> Float:
        return sample_cells(values, (places - self._low) / CELL)


def _lit(
    usual: NDArray[np.float32], known: NDArray[np.bool_], sun: Sunlight
) -> NDArray[np.float32]:
    """[X, Y] share of the sun: 1 on bright ground and 0 on dark ground (Otsu 1979)."""
    import cv2

    bright = np.log((usual @ LUMA.astype(np.float32)).clip(0.01))
    smooth = np.asarray(cv2.GaussianBlur(bright, (0, 0), 1.0)).reshape(bright.shape)
    values = np.sort(smooth[known].astype(np.float64))
    contrast = -float(np.log(sun.shade @ LUMA))
    if len(values) < MIN_CELLS:
        return np.ones_like(bright)
    count = np.arange(1, len(values))
    sums = np.cumsum(values)[:-1]
    dark, rest = sums / count, (values.sum() - sums) / (len(values) - count)
    best = int((count * (len(values) - count) * (rest - dark) ** 2).argmax())
    if rest[best] - dark[best] < MIN_CONTRAST * contrast:
        return np.ones_like(bright)
    edge = (rest[best] + dark[best]) / 2
    return np.asarray(np.clip((smooth - edge) / (0.4 * contrast) + 0.5, 0, 1), np.float32)


def lasting_shadows(
    objects: Iterable[Standing], points: Float, sun: Sunlight, *, share: float = LASTING
) -> NDArray[np.bool_]:
    """[N] bool, ``points`` [N, 3] on the ground in or near the shadow of one of the objects for
    more than ``share`` of its recorded time.
    """
    found = np.zeros(len(points), np.bool_)
    for item in objects:
        track = item.trajectory
        poses = track.spread(POSES)
        reach = float(np.hypot(*item.size[:2])) / 2 + MAX_SHADOW
        centres = np.array([T[:2, 3] for T in poses])
        low, high = centres.min(axis=0) - reach, centres.max(axis=0) + reach
        near = np.flatnonzero(((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1))
        counts = np.zeros(len(near))
        for T in poses:
            counts += sun.hidden_by(T, item.size, points[near], margin=SHADOW_REACH)
        found[near[counts > share * len(poses)]] = True
    return found
