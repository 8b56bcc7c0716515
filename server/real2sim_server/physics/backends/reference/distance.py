"""Distances to colliders, and ways to them, in plain torch; see ``contact.collider_distance``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ...colliders import Box, Capsule, Collider, Cylinder, HeightField, Plane, Solid
from ...contact.collider_distance import ON_SURFACE
from ...contact.particle import LOOKS, MISSES, SINK, TOUCHING
from ...errors import ColliderError
from ...triangle_mesh import TriangleMesh


def collider_distance(collider: Collider, points: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance [U] [m] and outward normal [U, 3]."""
    if isinstance(collider, Plane):
        n = torch.as_tensor(collider.normal)
        return (points - torch.as_tensor(collider.point)) @ n, n.expand_as(points)
    if isinstance(collider, Box):
        return _box_distance(collider, points)
    if isinstance(collider, HeightField):
        return _height_distance(collider, points)
    if isinstance(collider, Cylinder | Capsule | TriangleMesh):
        pose = torch.as_tensor(collider.pose)
        distance, n = _LOCAL[type(collider)](collider, (points - pose[:3, 3]) @ pose[:3, :3])
        return distance, n @ pose[:3, :3].T
    raise ColliderError(f"no distance to a {type(collider).__name__}")


def _box_distance(box: Box, points: Tensor) -> tuple[Tensor, Tensor]:
    pose = torch.as_tensor(box.T_world_box)
    q = (points - pose[:3, 3]) @ pose[:3, :3]
    d = q.abs() - torch.as_tensor(box.size) / 2
    outer = d.clamp(min=0)
    far = outer.norm(dim=-1)
    nearest = torch.nn.functional.one_hot(d.argmax(-1), 3).to(q.dtype)
    outside = (far > 0)[:, None]
    n = torch.where(outside, outer / far.clamp(min=1e-300)[:, None], nearest)
    n = torch.copysign(n, q) @ pose[:3, :3].T
    return torch.where(far > 0, far, d.max(-1).values), n


def _height_distance(field: HeightField, points: Tensor) -> tuple[Tensor, Tensor]:
    heights = torch.as_tensor(field.heights)
    at = (points[:, :2] - torch.as_tensor(field.origin)) / field.spacing
    last = torch.tensor(heights.shape) - 1
    at = torch.minimum(at.clamp(min=0), last.to(at.dtype))
    i, j = torch.minimum(at.floor().long(), last - 1).unbind(-1)
    a, b = at[:, 0] - i, at[:, 1] - j
    h00, h01, h10, h11 = heights[i, j], heights[i, j + 1], heights[i + 1, j], heights[i + 1, j + 1]
    slope_x = ((h10 - h00) * (1 - b) + (h11 - h01) * b) / field.spacing
    slope_y = ((h01 - h00) * (1 - a) + (h11 - h10) * a) / field.spacing
    height = (h00 * (1 - a) + h10 * a) * (1 - b) + (h01 * (1 - a) + h11 * a) * b
    n = torch.stack([-slope_x, -slope_y, torch.ones_like(a)], dim=-1)
    n = n / n.norm(dim=-1, keepdim=True)
    return (points[:, 2] - height) * n[:, 2], n


def _cylinder_distance(cylinder: Cylinder, q: Tensor) -> tuple[Tensor, Tensor]:
    across = q[:, :2].norm(dim=-1)
    radial = q[:, :2] / across.clamp(min=1e-300)[:, None]
    radial = torch.where((across > 0)[:, None], radial, radial.new_tensor([1.0, 0.0]))
    over = torch.stack([across - cylinder.radius, q[:, 2].abs() - cylinder.height / 2], dim=-1)
    outer = over.clamp(min=0)
    far = outer.norm(dim=-1)
    side = torch.stack([over[:, 0] > over[:, 1], over[:, 0] <= over[:, 1]], dim=-1).to(q.dtype)
    out = torch.where((far > 0)[:, None], outer / far.clamp(min=1e-300)[:, None], side)
    up = torch.copysign(torch.ones_like(far), q[:, 2])
    n = torch.cat([out[:, :1] * radial, (out[:, 1] * up)[:, None]], dim=-1)
    return torch.where(far > 0, far, over.max(-1).values), n


def _capsule_distance(capsule: Capsule, q: Tensor) -> tuple[Tensor, Tensor]:
    half = capsule.length / 2
    away = torch.cat([q[:, :2], q[:, 2:] - q[:, 2:].clamp(-half, half)], dim=-1)
    length = away.norm(dim=-1)
    n = away / length.clamp(min=1e-300)[:, None]
    return length - capsule.radius, torch.where(
        (length > 0)[:, None], n, n.new_tensor([1.0, 0.0, 0.0])
    )


def _mesh_distance(mesh: TriangleMesh, q: Tensor) -> tuple[Tensor, Tensor]:
    """By every triangle: slow, obvious."""
    surface = mesh.surface
    corners, normals = torch.as_tensor(surface.corners), torch.as_tensor(surface.normals)
    places, parts = _nearest_of_triangles(corners, q)
    squares = (q[:, None] - places).square().sum(-1)
    own = squares.argmin(dim=1)
    rows = torch.arange(len(q))
    away = q - places[rows, own]
    n = normals[own, parts[rows, own]]
    distance = squares[rows, own].sqrt()
    sheet = (surface.thickness or 0.0) / 2
    if sheet == 0.0:
        distance = torch.where((away * n).sum(-1) < 0, -distance, distance)
    clear = distance.abs() > ON_SURFACE
    straight = away / torch.where(clear, distance, torch.ones_like(distance))[:, None]
    return distance - sheet, torch.where(clear[:, None], straight, n)


def _nearest_of_triangles(corners: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest places [N, T, 3] on triangles, and parts [N, T] that they lie on: the least of the
    face, where the point is above it, of the three edges and of the three corners."""
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    square = normal.square().sum(-1)
    found, inside = [], torch.ones(len(q), len(a), dtype=torch.bool)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        s = ((q[:, None] - start) * along).sum(-1) / along.square().sum(-1)
        place = start + s.clamp(0, 1)[..., None] * along
        found.append((place, (s > 0) & (s < 1)))
        inward = torch.linalg.cross(normal, along)
        inside &= ((q[:, None] - start) * inward).sum(-1) > 0
    height = ((q[:, None] - a) * normal).sum(-1) / square
    face = q[:, None] - height[..., None] * normal
    places = [face, *[place for place, _ in found], *[k.expand_as(face) for k in (a, b, c)]]
    allowed = [inside, *[on for _, on in found], *[torch.ones_like(inside)] * 3]
    squares = torch.stack(
        [
            torch.where(ok, (q[:, None] - place).square().sum(-1), torch.inf)
            for place, ok in zip(places, allowed, strict=True)
        ]
    )
    part = squares.argmin(dim=0)
    chosen = torch.stack(places).gather(0, part[None, :, :, None].expand(1, -1, -1, 3))[0]
    return chosen, part


_LOCAL: dict[type[Solid], Callable[[Any, Tensor], tuple[Tensor, Tensor]]] = {
    Cylinder: _cylinder_distance,
    Capsule: _capsule_distance,
    TriangleMesh: _mesh_distance,
}


def first_touch(solid: Solid, x: Tensor, way: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Fraction [N] of each way until a particle touches a solid, MISSES where none; normals.

    See ``contact.particle``.
    """
    if isinstance(solid, Box):
        return _touch_of_box(solid, x, way, half)
    length = way.norm(dim=-1).clamp(min=1e-30)
    near = TOUCHING * half
    distance, n = collider_distance(solid, x)
    gap, t = distance - half, torch.zeros_like(distance)
    at_once = gap < -near
    if not solid.separable:
        at_once = at_once | (gap <= near)
    open_ways = ~at_once
    found = torch.where(at_once, t, torch.full_like(t, MISSES))
    for _ in range(LOOKS):
        inward = -(way * n).sum(-1)
        reached = open_ways & (gap <= near)
        met = reached & (inward > 0)
        found = torch.where(met, t, found)
        n = torch.where(met[:, None], _face_on(solid, way / length[:, None], n, half), n)
        open_ways = open_ways & ~reached
        t = torch.where(open_ways, t + gap / length, t)
        open_ways = open_ways & (t <= 1.0)
        distance, ahead = collider_distance(solid, x + t[:, None] * way)
        n = torch.where(open_ways[:, None], ahead, n)
        gap = torch.where(open_ways, distance - half, gap)
    return torch.where(open_ways, t, found), n


def _face_on(solid: Solid, along: Tensor, n: Tensor, half: Tensor) -> Tensor:
    """See ``contact.particle.face_on``; ``along`` is the direction of the way."""
    if not isinstance(solid, Cylinder | Capsule):
        return n
    own = (solid.radius / half).clamp(max=1.0)[:, None]
    return torch.nn.functional.normalize(own * n - (1 - own) * along, dim=-1)


def _touch_of_box(box: Box, x: Tensor, way: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """The same for a box, whose faces reach half a spacing beyond its edges."""
    pose = torch.as_tensor(box.T_world_box)
    size = torch.as_tensor(box.size) / 2
    q, w = (x - pose[:3, 3]) @ pose[:3, :3], way @ pose[:3, :3]
    sign = torch.where(q > 0, 1.0, -1.0).to(q.dtype)
    gap = q.abs() - size - SINK * half[:, None]
    inward, near = -w * sign, TOUCHING * half[:, None]
    enters = (gap >= -near) & (inward > 0) & (gap <= inward)
    t = gap.clamp(min=0) / torch.where(enters, inward, torch.ones_like(inward))
    if not box.separable:
        held = gap.abs() <= near
        enters, t = enters | held, torch.where(held, torch.zeros_like(t), t)
    there = q[:, None] + t[:, :, None] * w[:, None]
    within = there.abs() <= size + half[:, None, None]
    within = (within | torch.eye(3, dtype=torch.bool)).all(-1)
    t = torch.where(enters & within, t, torch.full_like(t, MISSES))
    first, axis = t.min(-1)
    inside = gap.max(-1).values < -near[:, 0]
    first = torch.where(inside, torch.zeros_like(first), first)
    axis = torch.where(inside, gap.argmax(-1), axis)
    face = torch.nn.functional.one_hot(axis, 3).to(q.dtype)
    return first, (sign * face) @ pose[:3, :3].T
