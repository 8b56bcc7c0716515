"""Colours of the sides of vehicles that no camera saw: mirrored, of their parts, or in one paint.

All of it is done with the light taken off, and put on again where a side faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from .inpainting import GREY, fill_from_mirror
from .vehicle_body import PAINT_REACH, VehicleBody
from .vehicle_parts import Part, brightness, fit_light, fit_palette, shown_paints, with_paints

ON_PART = 0.06
"""Points this near to a body show the colour of its part there [m]; others lie behind its glass."""


@dataclass(frozen=True, eq=False)
class VehicleSurface:
    """What cameras saw of one vehicle.

    Attributes:
        points: [N, 3] float32 in the frame of its box [m].
        normals: [N, 3] float64 unit, outwards, in the world.
        colours: [N, 3] float32 where ``seen``.
        seen: [N] bool.
        body: that fits it.
    """

    points: NDArray[np.float32]
    normals: Float
    colours: NDArray[np.float32]
    seen: NDArray[np.bool_]
    body: VehicleBody

    def seen_paint(self) -> NDArray[np.bool_]:
        """[N] bool: seen, and no lamp, glass or tyre."""
        return np.asarray(self.seen & (self.parts() == Part.PAINT))

    def parts(self, *, reach: float = PAINT_REACH) -> NDArray[np.uint8]:
        """Parts [N] of the body at the points, see :meth:`.VehicleBody.parts_at`."""
        return self.body.parts_at(*self.closest, reach=reach)

    @cached_property
    def closest(self) -> tuple[Float, NDArray[np.int64]]:
        """Of the points, see :meth:`.VehicleBody.closest`."""
        return self.body.closest(self.points)


def fill_vehicles(
    surfaces: Sequence[VehicleSurface],
) -> tuple[list[NDArray[np.float32]], Float, NDArray[np.float32]]:
    """Colours [N, 3] of all points of each vehicle, the light [3] and the palette [10, 3] of all.

    What was seen stays. The paint of a vehicle of which hardly anything was seen is a grey, as
    bright as the median of the others': the median of their colours is a colour that none has.
    """
    painted = [s.seen_paint() for s in surfaces]
    light = fit_light(
        [s.normals[mine] for s, mine in zip(surfaces, painted, strict=True)],
        [s.colours[mine] for s, mine in zip(surfaces, painted, strict=True)],
    )
    paints = [_shown_paints(s, light) for s in surfaces]
    palette = _shown_palette(surfaces, light)
    found = [p[Part.PAINT] for p in paints if Part.PAINT in p]
    usual = np.full(3, np.median(np.mean(found, axis=1)), np.float32) if found else GREY
    filled = [
        _filled(s, light, with_paints(palette, mine, usual))
        for s, mine in zip(surfaces, paints, strict=True)
    ]
    return filled, light, palette


def _shown_paints(surface: VehicleSurface, light: Float) -> dict[Part, NDArray[np.float32]]:
    seen = surface.seen
    return shown_paints(
        surface.parts()[seen], surface.colours[seen] / brightness(light, surface.normals[seen])
    )


def _shown_palette(surfaces: Sequence[VehicleSurface], light: Float) -> NDArray[np.float32]:
    parts, colours = [], []
    for surface in surfaces:
        parts.append(surface.parts(reach=ON_PART)[surface.seen])
        lit = brightness(light, surface.normals[surface.seen])
        colours.append(surface.colours[surface.seen] / lit)
    return fit_palette(parts, colours)


def _filled(
    surface: VehicleSurface, light: Float, palette: NDArray[np.float32]
) -> NDArray[np.float32]:
    lit = brightness(light, surface.normals)
    mirrored, known = fill_from_mirror(surface.points, surface.colours / lit, surface.seen)
    own = surface.body.colours(palette)[surface.closest[1]]
    plain = np.where((surface.parts() != Part.PAINT)[:, None], own, palette[Part.PAINT])
    filled = np.where(known[:, None], mirrored, plain) * lit
    filled = np.where(surface.seen[:, None], surface.colours, filled)
    return np.clip(filled, 0, 1).astype(np.float32)
