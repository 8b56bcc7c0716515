"""A damaged vehicle as it is drawn: its Gaussians moved, folded, lit and broken."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...scene import GaussianCloud
from ..embedding import Deformed, Embedding, deform_cloud, replaced_rows
from .parts import Part, in_wheels, parts_of
from .sheet import Sheet

SH_0 = 0.28209479177387814
GLASS_DARKER = 0.7
"""Glass is what is darker than so much of the vehicle's paint, within a pane's place."""
OTHER_HUE = 0.05
"""Or what differs by so much in a channel's share of the light: glass that shows the sky."""
LEANING = 0.12
"""Of the width, by which side windows lean inwards."""
OF_GLASS = 0.1
"""A windscreen differs from paint by so much."""
SILLS = 0.3
"""Below this fraction of a vehicle's height there are wheels and shadow."""
OTHER_COLOUR = 0.22
"""A lamp is what differs by so much from the colour of most of the vehicle, within its place."""
LAMP_DARKER, LAMP_SHARE = 0.6, 0.6
"""And is not darker than so much of it, as grilles are; the most unlike of these, this share."""
LAMP_LEFT, PANE_LEFT = 0.22, 0.35
"""Light that comes from the hole where a lamp or a pane was."""
CRACKED = np.array([0.62, 0.67, 0.68])
"""What laminated glass shows where it is crazed."""
CRAZED = 0.55
"""Of a cracked windscreen that is crazed."""
BARE, SMEAR = np.array([0.55, 0.56, 0.57]), np.array([0.1, 0.1, 0.1])
"""Metal under scraped paint; rubber, plastic and dirt that scraping leaves."""
DROOP, DROOP_TIME = 0.16, 0.35
"""Angle by which a loose bumper hangs down at one end [rad], and in what time [s]."""
HANGS_STILL = 3 * DROOP_TIME
"""After so long a loose bumper has come to rest [s]: it would sink by less than 0.1 mm more."""
LOOSE = 0.25
"""How far its loose end stands off, against how far it hangs down."""
CLEARANCE = 0.04
"""Of a loose bumper above the road [m]."""
LEAST_MOVED = 8e-3
"""Particles that have moved less than this leave Gaussians where they are [m]: a body hit hard
bends elastically by several millimetres all along, and the slowest impact that deforms at all
dents by more than twice as much."""
CARRIED_ROUNDS, CARRIED_SCALE = 5, 0.01
"""How often weights are found anew, and what counts as little [m], where it is found how a vehicle
has moved as a whole."""
SPLIT = 1.5
"""Gaussians stretched by more are drawn as two, side by side."""


class DamagedVehicle:
    """An object whose Gaussians follow its particles.

    Args:
        cloud: its Gaussians at rest, object frame.
        rest: [N, 3] particles at rest, object frame [m].
        spacing: of the particles [m].
        category, size: of the object.
        object_id: by which folds differ from vehicle to vehicle.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        rest: Float,
        *,
        spacing: float,
        category: str,
        size: Sequence[float],
        object_id: str,
    ) -> None:
        self._cloud, self._size = cloud, size
        points = cloud.means.detach().cpu().numpy().astype(np.float64)
        self._points, self._rest = points, rest
        self._embedding = Embedding(rest, points, spacing=spacing)
        self._parts = {part.name: part for part in parts_of(category, size)}
        colours = np.clip(cloud.sh[:, 0].detach().cpu().numpy() * SH_0 + 0.5, 0.0, 1.0)
        self._brightness = colours.mean(axis=1)
        painted = self._painted()
        self._paint = float(np.median(self._brightness[painted]))
        hues = colours / np.maximum(3 * self._brightness, 0.05)[:, None]
        self._other_hue = np.abs(hues - np.median(hues[painted], axis=0)).max(axis=1)
        self._unlike_paint = np.abs(colours - np.median(colours[painted], axis=0)).max(axis=1)
        self._rows = {name: self._rows_of(part) for name, part in self._parts.items()}
        glass = np.zeros(len(points), dtype=bool)
        for name, part in self._parts.items():
            if part.kind in ("pane", "windscreen"):
                glass[self._rows[name]] = True
        self._seed = zlib.crc32(object_id.encode())
        self._sheet = Sheet(
            points,
            rest,
            spacing=spacing,
            size=size,
            smooth=glass | in_wheels(points, size),
            seed=self._seed,
        )

    def shortening(self, displacements: Float) -> Float:
        """[G, 3] by what fraction the sheet at each Gaussian is shorter along the vehicle's axes,
        with particles displaced [N, 3] [m]; the largest so far goes into :meth:`cloud`."""
        shorter = np.zeros((len(self._points), 3))
        rows = np.flatnonzero(self._embedding.near(_moved(displacements)))
        shorter[rows] = self._sheet.shortening(self._embedding.gradients(displacements, rows))
        return shorter

    def cloud(
        self, displacements: Float, most: Float, broken: Mapping[str, float]
    ) -> GaussianCloud:
        """What is drawn; Gaussians that nothing has moved stay as they are, bit for bit.

        Args:
            displacements: [N, 3] of its particles from rest [m].
            most: [G, 3] largest shortening so far.
            broken: names of parts that have broken, and how long ago [s].
        """
        changed = self._embedding.near(_moved(displacements)) | (most > 0).any(axis=1)
        if (changed & self._sheet.bonnet).any():
            changed |= self._sheet.bonnet
        rows = np.flatnonzero(changed)
        body = self._embedding.follow(displacements, rows)
        # Only what differs from how the vehicle as a whole has moved is seen as damage.
        turn, shift = _carried(self._rest, displacements)
        folded = self._sheet.fold(_without(body, turn, shift), most[rows], rows)
        index = torch.from_numpy(rows).to(self._cloud.device)
        part = deform_cloud(self._cloud.select(index), _with(folded.deformed, turn, shift))
        light = np.ones(len(self._points))
        light[rows] = folded.light
        for name in broken:
            kind = self._parts[name].kind
            if kind in ("lamp", "pane"):
                light[self._rows[name]] *= LAMP_LEFT if kind == "lamp" else PANE_LEFT
        moved = replaced_rows(self._cloud, index, part)
        sh = _lit(_scraped(moved.sh, index, folded.scraped), light)
        if "windscreen" in broken:
            sh = self._crazed(sh)
        means = moved.means
        for name, age in broken.items():
            if self._parts[name].kind == "bumper":
                means = self._drooped(name, means, age)
        return _split(replace(moved, means=means, sh=sh), rows, body.F)

    def _rows_of(self, part: Part) -> NDArray[np.int64]:
        """Gaussians that a part consists of: all at its place, without paint around it."""
        inside = part.holds(self._points)
        if part.kind == "pane" and part.outward[1]:
            inside |= self._leaning(part)
        if part.kind == "windscreen":
            # It shows the sky, brighter than paint at times; nothing else faces ahead up there.
            inside &= self._unlike_paint > OF_GLASS
        elif part.kind == "pane":
            dark = self._brightness < max(GLASS_DARKER * self._paint, 0.12)
            inside &= dark | (self._other_hue > OTHER_HUE)
        elif part.kind == "lamp":
            bright = self._brightness > LAMP_DARKER * self._paint
            inside &= bright & (self._unlike_paint > OTHER_COLOUR)
            if inside.any():
                least = np.quantile(self._unlike_paint[inside], 1 - LAMP_SHARE)
                inside &= self._unlike_paint >= least
        return np.flatnonzero(inside)

    def _leaning(self, part: Part) -> NDArray[np.bool_]:
        """[G] what belongs to side windows, which lean inwards further up, between the screens."""
        low, high = np.array(part.low), np.array(part.high)
        inwards = LEANING * self._size[1]
        low[1], high[1] = (low[1] - inwards, high[1]) if low[1] > 0 else (low[1], high[1] + inwards)
        high[0] = min(high[0], self._parts["windscreen"].low[0])
        if "rear window" in self._parts:
            low[0] = max(low[0], self._parts["rear window"].high[0])
        return replace(part, low=tuple(low), high=tuple(high)).holds(self._points)

    def _painted(self) -> NDArray[np.bool_]:
        """[G] what is neither glass nor below the sills; all where nothing is left."""
        height = self._points[:, 2] / self._size[2] + 0.5
        painted: NDArray[np.bool_] = height > SILLS
        for part in self._parts.values():
            if part.kind in ("pane", "windscreen"):
                painted = painted & ~part.holds(self._points)
        return painted if painted.any() else np.ones(len(painted), dtype=bool)

    def _drooped(self, name: str, means: torch.Tensor, age: float) -> torch.Tensor:
        """A bumper that hangs by one end; which one differs from vehicle to vehicle."""
        rows = self._rows[name]
        if not len(rows):
            return means
        places = means[rows].detach().cpu().numpy().astype(np.float64)
        side = 1.0 if (self._seed >> 3) % 2 else -1.0
        arm = places[:, 1] * side
        arm = arm - arm.min()
        fallen = 1 - np.exp(-3 * min(age, HANGS_STILL) / DROOP_TIME)
        sunk = np.tan(DROOP) * fallen * arm
        sunk = np.minimum(sunk, places[:, 2] + self._size[2] / 2 - CLEARANCE)
        sunk = np.maximum(sunk, 0.0)
        places[:, 2] -= sunk
        # It comes off forwards as well, where it is loose.
        places[:, 0] += np.sign(places[:, 0].mean()) * LOOSE * sunk
        moved = means.clone()
        moved[rows] = torch.from_numpy(places.astype(np.float32)).to(means.device)
        return moved

    def _crazed(self, sh: torch.Tensor) -> torch.Tensor:
        """Cracks all over the screen, denser along rays."""
        rows = self._rows["windscreen"]
        if not len(rows):
            return sh
        points = self._points[rows]
        middle = points.mean(axis=0) + np.array([0.0, 0.2, 0.0])
        angle = np.arctan2(points[:, 2] - middle[2], points[:, 1] - middle[1])
        rays = 0.5 + 0.5 * np.cos(11 * angle + 2 * np.sin(3 * angle))
        random = np.random.default_rng(self._seed).uniform(size=len(rows))
        weight = np.where(random < CRAZED * (0.4 + rays), 0.65, 0.12)
        weights = torch.from_numpy(weight.astype(np.float32))[:, None, None].to(sh.device)
        target = torch.zeros_like(sh[rows])
        colour = torch.from_numpy(((CRACKED - 0.5) / SH_0).astype(np.float32)).to(sh.device)
        target[:, 0] = colour
        cracked = sh.clone()
        cracked[rows] = (1 - weights) * sh[rows] + weights * target
        return cracked


def _moved(displacements: Float) -> NDArray[np.bool_]:
    """[N] particles that have moved by more than what leaves Gaussians where they are."""
    moved: NDArray[np.bool_] = np.linalg.norm(displacements, axis=1) > LEAST_MOVED
    return moved


def _carried(rest: Float, displacements: Float) -> tuple[Float, Float]:
    """Turn [3, 3] and shift [3] of most of a body's particles [N, 3]; what is crushed has little
    weight."""
    places = rest + displacements
    weights = np.ones(len(rest))
    for _ in range(CARRIED_ROUNDS):
        share = (weights / weights.sum())[:, None]
        before, after = (share * rest).sum(axis=0), (share * places).sum(axis=0)
        left, _, right = np.linalg.svd((places - after).T @ (share * (rest - before)))
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        turn = left @ right
        shift = after - turn @ before
        off = np.linalg.norm(places - rest @ turn.T - shift, axis=1)
        weights = 1 / (off + CARRIED_SCALE)
    return turn, shift


def _without(body: Deformed, turn: Float, shift: Float) -> Deformed:
    """A body's points before it was turned and shifted."""
    return Deformed((body.positions - shift) @ turn, turn.T @ body.F, turn.T @ body.rotations)


def _with(body: Deformed, turn: Float, shift: Float) -> Deformed:
    """A body's points after it was turned and shifted."""
    return Deformed(body.positions @ turn.T + shift, turn @ body.F, turn @ body.rotations)


def _lit(sh: torch.Tensor, light: Float) -> torch.Tensor:
    """Harmonics of Gaussians whose colours are multiplied by ``light`` [G]."""
    factor = torch.from_numpy(light.astype(np.float32)).to(sh.device)
    lit = sh * factor[:, None, None]
    lit[:, 0] += ((factor - 1) * 0.5 / SH_0)[:, None]
    return lit


def _scraped(sh: torch.Tensor, rows: torch.Tensor, scraped: Float) -> torch.Tensor:
    """Harmonics with the paint of ``rows`` [R] scraped and smeared by ``scraped`` [R, 2]."""
    found = sh.clone()
    for colour, share in zip((BARE, SMEAR), scraped.T, strict=True):
        weight = torch.from_numpy(share.astype(np.float32))[:, None, None].to(sh.device)
        target = torch.zeros_like(found[rows])
        target[:, 0] = torch.from_numpy(((colour - 0.5) / SH_0).astype(np.float32)).to(sh.device)
        found[rows] = (1 - weight) * found[rows] + weight * target
    return found


def _split(cloud: GaussianCloud, changed: NDArray[np.int64], F: Float) -> GaussianCloud:
    """The cloud with those Gaussians split in two that were stretched far, so that none is a needle
    and nothing opens between them; F [R, 3, 3] is of those that were ``changed`` [R]."""
    stretch = np.linalg.norm(F, axis=1).max(axis=1)
    rows = torch.from_numpy(changed[stretch > SPLIT]).to(cloud.device)
    if not len(rows):
        return cloud
    part = cloud.select(rows)
    longest = part.scales.argmax(dim=1)
    axes = _axes(part.quats)
    each = torch.arange(len(rows), device=cloud.device)
    along = axes[each, :, longest] * part.scales[each, longest][:, None] * 0.6
    scales = part.scales.clone()
    scales[each, longest] *= 0.7
    means, sizes = cloud.means.clone(), cloud.scales.clone()
    means[rows], sizes[rows] = part.means + along, scales
    other = replace(part, means=part.means - along, scales=scales)
    return GaussianCloud.concatenate([replace(cloud, means=means, scales=sizes), other])


def _axes(quats: torch.Tensor) -> torch.Tensor:
    """[K, 3, 3] axes of Gaussians, as columns."""
    from ...geometry.rotation import quaternion_to_matrix

    matrices = quaternion_to_matrix(quats.detach().cpu().numpy())
    return torch.from_numpy(matrices.astype(np.float32)).to(quats.device)
