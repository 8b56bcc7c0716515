"""Parts of synthetic vehicle bodies, their colours, and how light falls on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ...scene import Scene, SceneObject
from ...scene.sunlight import DISPLAY, light_of, relight
from ...synthetic.vehicles import VehicleShape, roof_heights
from .surfels import MIN_OBSERVED, modal_colour

Colours = NDArray[np.float32]
Light = Callable[[Float], Colours]
"""Light [N, 1] or [N, 3] on surfaces with unit normals [N, 3], see :func:`.sunlight.relight`."""

# Shading: paint is brighter where it faces the sun and the sky.
#
# Images show most vehicles from one side. The colour of the other sides follows from the paint and
# from the relative brightness of sides by direction, averaged over all vehicles of a log.

FROM_ABOVE = (0.0, 0.0, 0.25)
"""Prior slopes, used without evidence from vehicles."""
DOUBT = 2.0
"""Weight of the prior slopes, in vehicles."""
FEW = 100
"""Minimum number of seen points of a vehicle."""
ODD = 0.15
"""Points with a larger deviation of the log brightness get less weight (Huber): they show
reflections, cast shadows or no paint."""
ROUNDS = 10
DARKEST = 0.02
LIGHT = "vehicle_light"
"""Key of the slopes in a scene's reconstruction provenance."""


def fit_light(normals: Sequence[Float], colours: Sequence[NDArray[np.float32]]) -> Float:
    """Slopes [3] of the log brightness with respect to the surface normal, shared by all vehicles.

    Args:
        normals: by vehicle, [N, 3] unit, in a common frame.
        colours: by vehicle, [N, 3] of paint there.
    """
    members = [k for k, seen in enumerate(normals) if len(seen) >= FEW]
    prior = np.array(FROM_ABOVE)
    if not members:
        return prior
    owner = np.repeat(np.arange(len(members)), [len(normals[k]) for k in members])
    unit = np.concatenate([normals[k] for k in members])
    bright = np.concatenate([light_of(colours[k]).mean(axis=1) for k in members])
    rest = np.log((bright ** (1 / DISPLAY)).clip(DARKEST)) - unit @ prior
    share = np.concatenate([np.full(len(normals[k]), 1 / len(normals[k])) for k in members])
    # The paint of each vehicle is unknown.
    columns = np.concatenate([unit, np.eye(len(members))[owner]], axis=1)
    doubt = np.diag([DOUBT / 30] * 3 + [1e-6] * len(members))
    weight, found = share, np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        weighed = columns.T * weight
        found = np.linalg.solve(weighed @ columns + doubt, weighed @ rest)
        weight = share / np.maximum(1, np.abs(rest - columns @ found) / ODD)
    return np.asarray(prior + found[:3])


def slope_light(slopes: Float, normals: Float) -> NDArray[np.float32]:
    """Light [N, 1] on surfaces with unit ``normals`` [N, 3]; slopes as of :func:`fit_light`."""
    return np.exp(DISPLAY * (normals @ slopes))[:, None].astype(np.float32)


def light_on(item: SceneObject, scene: Scene) -> Light:
    """The light on an object of ``scene``, for normals in its frame at its middle pose.

    That of the sun, if it is known, otherwise the fitted slopes.
    """
    light_map = scene.light_map
    axes = item.trajectory.middle[:3, :3]
    if light_map is not None:
        light = light_map.light_along(item.trajectory)
        return lambda normals: light(normals @ axes.T)
    reconstruction = scene.provenance.get("reconstruction")
    known = reconstruction.get(LIGHT) if isinstance(reconstruction, dict) else None
    slopes = np.array(FROM_ABOVE if known is None else known, dtype=np.float64)
    return lambda normals: slope_light(slopes, normals @ axes.T)


# Parts and colours.
#
# Colours of glass, trim and tyres come from the log's own vehicles: they are darker in hard sun
# than under clouds.

PALETTE_DOUBT = 2.0
"""Weight of the default colour of a part, in vehicles that show the part."""
MAX_GLASS = 0.8
"""Maximum brightness of a vehicle's glass, relative to its paint."""
PARTS = "vehicle_parts"
"""Key of the colours of parts in a scene's reconstruction provenance."""
FRAME = 0.035
"""Width of the dark frame about side windows [m]."""
PILLAR = 0.05
"""Half the width of a pillar between side windows [m]."""


class Part(IntEnum):
    """Part of a vehicle body.

    The colours of paint and cargo (the box of a truck) differ between vehicles. ``OTHER`` has the
    colour that the vehicle builder assigned.
    """

    PAINT = 0
    GLASS = 1
    TRIM = 2
    TYRE = 3
    RIM = 4
    WHITE_LAMP = 5
    RED_LAMP = 6
    PLATE = 7
    CARGO = 8
    OTHER = 9


DEFAULT_COLOURS: dict[Part, tuple[float, float, float]] = {
    Part.GLASS: (0.2, 0.23, 0.27),
    Part.TRIM: (0.13, 0.13, 0.14),
    Part.TYRE: (0.1, 0.1, 0.1),
    Part.RIM: (0.5, 0.5, 0.51),
    Part.WHITE_LAMP: (0.65, 0.65, 0.65),
    Part.RED_LAMP: (0.45, 0.1, 0.1),
    Part.PLATE: (0.6, 0.6, 0.58),
}
"""Default sRGB of parts in the light of a surface that faces the horizon."""
FITTED = (Part.GLASS, Part.TRIM, Part.TYRE)
"""Parts that are similar on all vehicles and large enough to be seen. Lamps can be on or off, and
rims appear together with the dark gaps between their spokes.
"""
PAINTED = (Part.PAINT, Part.CARGO)
"""Parts with a paint per vehicle."""


def default_palette() -> Colours:
    """Default colours [10, 3] by part; 0 for parts without a default."""
    palette = np.zeros((len(Part), 3), dtype=np.float32)
    for part, colour in DEFAULT_COLOURS.items():
        palette[part] = colour
    return palette


def fit_palette(
    parts: Sequence[NDArray[np.uint8]], colours: Sequence[NDArray[np.float32]], light: float
) -> Colours:
    """Colours [10, 3] by part, with FITTED parts as observed on the vehicles of a log.

    Args:
        parts: per vehicle, [N] parts of the seen points.
        colours: per vehicle, [N, 3] of these points, without the light.
        light: usual light on surfaces that face the horizon.
    """
    palette = relight(default_palette(), 1 / light)
    for part in FITTED:
        members = [c[p == part] for p, c in zip(parts, colours, strict=True)]
        shown = [modal_colour(c) for c in members if len(c) >= MIN_OBSERVED]
        if shown:
            total = PALETTE_DOUBT * palette[part] + np.sum(shown, axis=0)
            palette[part] = total / (PALETTE_DOUBT + len(shown))
    return palette


def shown_paints(
    parts: NDArray[np.uint8], colours: NDArray[np.float32]
) -> dict[Part, NDArray[np.float32]]:
    """The most common colour [3] of each PAINTED part with enough points.

    Args:
        parts: [N] of the points.
        colours: [N, 3] of the points, without the light.
    """
    members = {part: colours[parts == part] for part in PAINTED}
    return {part: modal_colour(c) for part, c in members.items() if len(c) >= MIN_OBSERVED}


def with_paints(
    palette: Colours, paints: dict[Part, NDArray[np.float32]], usual: NDArray[np.float32]
) -> Colours:
    """The palette [10, 3] of one vehicle.

    A paint that the vehicle does not show defaults to the other one, otherwise to ``usual`` [3].
    Glass is darker than the paint.
    """
    known = [paints[part] for part in PAINTED if part in paints]
    own = palette.copy()
    for part in PAINTED:
        own[part] = paints.get(part, known[0] if known else usual)
    most = MAX_GLASS * own[Part.PAINT].mean()
    own[Part.GLASS] *= min(1.0, most / max(float(own[Part.GLASS].mean()), 1e-3))
    return own


def palette_of(scene: Scene) -> Colours:
    """The palette [10, 3] in a scene's provenance; the default one if it is missing."""
    reconstruction = scene.provenance.get("reconstruction")
    known = reconstruction.get(PARTS) if isinstance(reconstruction, dict) else None
    palette = default_palette()
    if known is not None:
        palette[: len(known)] = np.asarray(known, dtype=np.float32)
    return palette


def wheel_parts(uv: Float) -> NDArray[np.uint8]:
    """Tyre, rim, or the gap between spokes, at positions [N, 2] relative to the radius."""
    radius, angle = np.hypot(uv[:, 0], uv[:, 1]), np.arctan2(uv[:, 1], uv[:, 0])
    between = (radius > 0.22) & (radius < 0.6) & (np.cos(5 * angle) < -0.1)
    return np.where((radius < 0.68) & ~between, Part.RIM, Part.TYRE).astype(np.uint8)


def shell_parts(shape: VehicleShape, points: Float, normals: Float) -> NDArray[np.uint8]:
    """Parts [N] at points [N, 3] of the shell, z over the ground, with normals [N, 3] outwards."""
    width, height = shape.size[1:]
    x, side, z = points[:, 0], np.abs(points[:, 1]), points[:, 2]
    nx, flank = normals[:, 0], np.abs(normals[:, 1]) > 0.4
    parts = np.full(len(points), Part.PAINT, dtype=np.uint8)
    parts[z < shape.clearance + 0.1] = Part.TRIM
    _set_side_windows(parts, shape, x, z, flank)
    for axle in shape.axles:
        arch = np.hypot(x - axle * shape.size[0], z - shape.wheel_radius)
        parts[flank & (arch < shape.wheel_radius + 0.055)] = Part.TYRE
    half = 0.5 * width * (0.9 if height > 2 else 0.8)
    above = ~flank & (z > shape.belt) & (z < height - 0.05) & (side < half)
    foot, top = (a * shape.size[0] for a in shape.windscreen)
    parts[above & (nx > 0.2) & (x > top) & (x < foot)] = Part.GLASS
    low, high = (a * shape.size[0] for a in shape.rear_window)
    parts[above & (nx < -0.2) & (x > low) & (x < high)] = Part.GLASS
    _set_ends(parts, shape, x, side, z, nx)
    return parts


def _set_side_windows(
    parts: NDArray[np.uint8], shape: VehicleShape, x: Float, z: Float, flank: NDArray[np.bool_]
) -> None:
    """Windows between dark frames and pillars, in place."""
    length, _, height = shape.size
    heights = roof_heights(shape)
    roof = np.interp(x, np.linspace(-0.5, 0.5, len(heights)) * length, heights)
    edge = 0.1 if height < 2 else 0.28
    rear, front = (a * length for a in shape.side_glass)

    def within(margin: float) -> NDArray[np.bool_]:
        tall = (z > shape.belt + 0.03 - margin) & (z < roof - edge + margin)
        return np.asarray(flank & tall & (x > rear - margin) & (x < front + margin))

    parts[within(FRAME)] = Part.TRIM
    glass = within(0.0)
    step = (front - rear) / (shape.pillars + 1)
    for k in range(1, shape.pillars + 1):
        glass &= np.abs(x - rear - k * step) > PILLAR
    parts[glass] = Part.GLASS


def _set_ends(  # noqa: PLR0917
    parts: NDArray[np.uint8], shape: VehicleShape, x: Float, side: Float, z: Float, nx: Float
) -> None:
    """Lamps and plates at nose and tail, in place."""
    length, width, height = shape.size
    big = height > 2
    lamp = 0.78 if big else 0.47 * shape.belt + 0.2
    nose = (nx > 0.35) & (x > length / 2 - 0.6) & (z < shape.belt)
    parts[nose & (side < 0.42) & (np.abs(z - lamp + 0.02) < 0.08)] = Part.TRIM
    outer = (side > width / 2 - 0.52) & (side < width / 2 - 0.1)
    parts[nose & outer & (np.abs(z - lamp) < 0.08)] = Part.WHITE_LAMP
    intake = np.abs(z - shape.clearance - 0.14) < 0.06
    parts[nose & intake & (side < 0.3 * width)] = Part.TRIM
    parts[nose & (side < 0.26) & (np.abs(z - lamp + 0.21) < 0.055)] = Part.PLATE
    tail = (nx < -0.35) & (x < 0.4 - length / 2) & (z < max(shape.belt, 0.7 * height))
    low, high, inner = shape.belt - 0.33, shape.belt - 0.12, width / 2 - 0.42
    if big:
        low, high, inner = shape.belt - 0.4, shape.belt - 0.02, width / 2 - 0.24
    parts[tail & (side > inner) & (z > low) & (z < high)] = Part.RED_LAMP
    parts[tail & (side < 0.26) & (np.abs(z - low - 0.05) < 0.055)] = Part.PLATE
