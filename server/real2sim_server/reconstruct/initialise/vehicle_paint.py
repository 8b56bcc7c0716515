"""Colours of the sides of vehicles that no camera saw: mirrored, of their parts, or in one paint.

All of it is done with the light taken off, and put on again where a side faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from .inpainting import GREY, MIN_OBSERVED, fill_from_mirror, modal_colour
from .vehicle_body import VehicleBody
from .vehicle_light import brightness, fit_light


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
        return self.seen & ~self.body.part_colours(self.points)[1]


def fill_vehicles(
    surfaces: Sequence[VehicleSurface],
) -> tuple[list[NDArray[np.float32]], Float]:
    """Colours [N, 3] of all points of each vehicle, and the light [3] that lies on them all.

    What was seen stays. The paint of a vehicle of which hardly anything was seen is the median of
    the others'.
    """
    painted = [s.seen_paint() for s in surfaces]
    light = fit_light(
        [s.normals[mine] for s, mine in zip(surfaces, painted, strict=True)],
        [s.colours[mine] for s, mine in zip(surfaces, painted, strict=True)],
    )
    known = [
        modal_colour(s.colours[mine] / brightness(light, s.normals[mine]))
        if mine.sum() >= MIN_OBSERVED
        else None
        for s, mine in zip(surfaces, painted, strict=True)
    ]
    found = [paint for paint in known if paint is not None]
    usual = np.median(found, axis=0).astype(np.float32) if found else GREY
    filled = [
        _filled(s, usual if paint is None else paint, light)
        for s, paint in zip(surfaces, known, strict=True)
    ]
    return filled, light


def _filled(
    surface: VehicleSurface, paint: NDArray[np.float32], light: Float
) -> NDArray[np.float32]:
    lit = brightness(light, surface.normals)
    mirrored, known = fill_from_mirror(surface.points, surface.colours / lit, surface.seen)
    part, is_part = surface.body.part_colours(surface.points)
    plain = np.where(is_part[:, None], part, paint)
    filled = np.where(known[:, None], mirrored, plain) * lit
    filled = np.where(surface.seen[:, None], surface.colours, filled)
    return np.clip(filled, 0, 1).astype(np.float32)
