"""Stress in plain torch, batched over particles: test oracle and differentiable path.

Uses matrix form instead of the scalars and principal values of ``stress.stress_update``:
logarithms by repeated square roots, flow by matrix exponentials. It does not divide by differences
of principal values, so gradients are also valid at rest. Only snow needs singular values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .. import stress
from ..colliders import Box, Capsule, Collider, Cylinder, HeightField, Plane, Solid, TriangleMesh
from ..contact import LOOKS, MISSES, ON_SURFACE, SINK, TOUCHING
from ..errors import ColliderError, MaterialError
from ..materials import law_of_code
from ..stress import SLACK, STRETCH_MIN, UNFOLDED, VOLUME_MIN

PACKED = (stress.SNOW, stress.CRUSH)
NEWTON_STEPS = 8
SQUARE_ROOTS = 3
SERIES_TERMS = 12


def stress_update(
    F: Tensor, history: Tensor, rows: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(elastic F, tau, energy density, history) of trial deformation gradients.

    Args:
        F: [N, 3, 3] trial F_elastic.
        history: [N], see ``stress.stress_update``.
        rows: [N, MATERIAL_ROW]; gradients flow to all columns but those of the law.
        dt: time since the last call [s].
    """
    codes = rows[:, stress.LAW].detach().round().long()
    parts = []
    for code in sorted(set(codes.tolist())):
        index = torch.nonzero(codes == code)[:, 0]
        answer = _stress_of_law(code, F[index], history[index], rows[index], dt)
        parts.append((index, answer))
    order = torch.argsort(torch.cat([index for index, _ in parts]))
    columns = zip(*(answer for _, answer in parts), strict=True)
    elastic, tau, energy, memory = (torch.cat(c)[order] for c in columns)
    return elastic, tau, energy, memory


def _stress_of_law(
    code: int, F: Tensor, history: Tensor, rows: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    if code == stress.COROTATED:
        return F, *_corotated(F, rows), history
    if code == stress.NEO_HOOKEAN:
        return F, *_neo_hookean(F, rows), history
    if code in PACKED:
        return _snow(F, history, rows)
    return _hencky(code, F, history, rows, dt)


def _corotated(F: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    mu, lam = rows[:, stress.MU], rows[:, stress.LAMBDA]
    J = torch.linalg.det(F).clamp(min=float(VOLUME_MIN))
    d = F - polar_rotation(F)
    eye = torch.eye(3, dtype=F.dtype)
    tau = 2 * mu[:, None, None] * d @ F.mT + (lam * J * (J - 1))[:, None, None] * eye
    return tau, mu * d.square().sum((1, 2)) + lam / 2 * (J - 1) ** 2


def polar_rotation(F: Tensor) -> Tensor:
    """Rotations [N, 3, 3] of the polar decomposition, by Newton's iteration (Higham 1986)."""
    R = F
    for _ in range(NEWTON_STEPS):
        R = (R + inverse(R).mT) / 2
    return R


def inverse(a: Tensor) -> Tensor:
    """Inverses [N, 3, 3] by cross products; much faster than factorisation."""
    x, y, z = a.unbind(-2)
    yz = torch.linalg.cross(y, z)
    columns = torch.stack([yz, torch.linalg.cross(z, x), torch.linalg.cross(x, y)], dim=-1)
    inverted: Tensor = columns / (x * yz).sum(-1)[:, None, None]
    return inverted


def _neo_hookean(F: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    mu, lam = rows[:, stress.MU], rows[:, stress.LAMBDA]
    log_J = torch.linalg.det(F).clamp(min=float(VOLUME_MIN)).log()
    b = F @ F.mT
    eye = torch.eye(3, dtype=F.dtype)
    tau = mu[:, None, None] * (b - eye) + (lam * log_J)[:, None, None] * eye
    energy = mu / 2 * (_trace(b) - 3) - mu * log_J + lam / 2 * log_J**2
    return tau, energy


def _hencky(
    code: int, F: Tensor, history: Tensor, rows: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    mu, lam = rows[:, stress.MU], rows[:, stress.LAMBDA]
    eye = torch.eye(3, dtype=F.dtype)
    b = F @ F.mT
    e = log_symmetric(b) / 2
    if code == stress.VON_MISES:
        taken, history = _von_mises(e, history, rows)
    elif code == stress.VISCOPLASTIC:
        taken = _viscoplastic(e, b, rows, dt)
    elif code == stress.DRUCKER_PRAGER:
        taken, history = _drucker_prager(e, history, rows)
    else:
        raise MaterialError(f"the reference has no flow rule for {law_of_code(code).name!r}")
    left = e - taken
    trace = _trace(left)
    tau = 2 * mu[:, None, None] * left + (lam * trace)[:, None, None] * eye
    energy = mu * left.square().sum((1, 2)) + lam / 2 * trace**2
    # The flow is coaxial with e, so removing strain is a matrix product.
    return torch.linalg.matrix_exp(-taken) @ F, tau, energy, history


def log_symmetric(b: Tensor) -> Tensor:
    """Matrix logarithm [N, 3, 3] of positive definite matrices, differentiable everywhere.

    Inverse scaling and squaring: square roots by Denman and Beavers (1976), then the series of
    ln((1 + x) / (1 - x)).
    """
    eye = torch.eye(3, dtype=b.dtype).expand_as(b)
    for _ in range(SQUARE_ROOTS):
        root, other = b, eye
        for _ in range(NEWTON_STEPS):
            root, other = (root + inverse(other)) / 2, (other + inverse(root)) / 2
        b = root
    x = inverse(b + eye) @ (b - eye)
    square, power, total = x @ x, x, x
    for term in range(1, SERIES_TERMS):
        power = power @ square
        total = total + power / (2 * term + 1)
    logarithm: Tensor = 2 ** (SQUARE_ROOTS + 1) * total
    return logarithm


def _deviator(e: Tensor) -> tuple[Tensor, Tensor]:
    d = e - (_trace(e) / 3)[:, None, None] * torch.eye(3, dtype=e.dtype)
    square = d.square().sum((1, 2))
    # The root of zero has no gradient; such particles do not flow.
    safe = torch.where(square > 0, square, torch.ones_like(square))
    return d, torch.where(square > 0, safe.sqrt(), torch.zeros_like(square))


def _von_mises(e: Tensor, history: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    d, norm = _deviator(e)
    two_mu, hardening = 2 * rows[:, stress.MU], rows[:, stress.B]
    root = (2 / 3) ** 0.5
    excess = (two_mu * norm - root * (rows[:, stress.A] + history)).clamp(min=0)
    flow = excess / (two_mu + 2 / 3 * hardening)
    fraction = torch.where(excess > 0, flow / norm.clamp(min=1e-300), torch.zeros_like(flow))
    return fraction[:, None, None] * d, history + root * hardening * flow


def _viscoplastic(e: Tensor, b: Tensor, rows: Tensor, dt: float) -> Tensor:
    d, norm = _deviator(e)
    mu = rows[:, stress.MU]
    excess = (2 * mu * norm - (2 / 3) ** 0.5 * rows[:, stress.A]).clamp(min=0)
    if dt <= 0:
        return torch.zeros_like(e)
    rate = dt / (dt + rows[:, stress.B] / (2 * mu * _trace(b) / 3))
    part = torch.where(excess > 0, rate * excess / (2 * mu * norm.clamp(min=1e-300)), 0 * norm)
    return part[:, None, None] * d


def _drucker_prager(e: Tensor, history: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    mu, lam, alpha = rows[:, stress.MU], rows[:, stress.LAMBDA], rows[:, stress.A]
    given_back = (history / 3)[:, None, None] * torch.eye(3, dtype=e.dtype)
    shifted = e + given_back
    trace = _trace(shifted)
    d, norm = _deviator(shifted)
    excess = (norm + (3 * lam + 2 * mu) / (2 * mu) * trace * alpha).clamp(min=0)
    fraction = torch.where(excess > 0, excess / norm.clamp(min=1e-300), torch.zeros_like(norm))
    apart = (trace >= 0)[:, None, None]
    left = torch.where(apart, torch.zeros_like(e), shifted - fraction[:, None, None] * d)
    return e - left, torch.where(trace >= 0, trace, torch.zeros_like(trace))


def _snow(F: Tensor, history: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    U, S, Vh = torch.linalg.svd(F)
    S = S.clamp(min=float(STRETCH_MIN))
    low, high = (
        1 - rows[:, stress.A : stress.A + 1],
        1 + rows[:, stress.B : stress.B + 1],
    )
    crushed = (rows[:, stress.LAW] == stress.CRUSH) & (history < 0)
    holds = (rows[:, stress.B] * (1 + float(UNFOLDED) * history)).clamp(min=float(SLACK))
    high = torch.where(crushed[:, None], 1 + holds[:, None], high)
    s = torch.minimum(torch.maximum(S, low), high)
    history = history + (S.prod(1) / s.prod(1)).log()
    hard = (rows[:, stress.C] * (1 - history.exp())).clamp(-3, 3).exp()
    mu, lam, J = rows[:, stress.MU] * hard, rows[:, stress.LAMBDA] * hard, s.prod(1)
    principal = 2 * mu[:, None] * (s - 1) * s + (lam * J * (J - 1))[:, None]
    tau = U @ torch.diag_embed(principal) @ U.mT
    energy = mu * (s - 1).square().sum(1) + lam / 2 * (J - 1) ** 2
    return U @ torch.diag_embed(s) @ Vh, tau, energy, history


def wave_hardening(history: Tensor, rows: Tensor) -> Tensor:
    """[N] stiffening of particles by plastic flow; see ``stress.stress_update``."""
    codes = rows[:, stress.LAW]
    packed = (codes == stress.SNOW) | (codes == stress.CRUSH)
    hardening = (rows[:, stress.C] * (1 - history.exp())).clamp(-3, 3).exp()
    return torch.where(packed, hardening, torch.ones_like(hardening))


def _trace(a: Tensor) -> Tensor:
    return a.diagonal(dim1=-2, dim2=-1).sum(-1)


# Distances to colliders, as in ``contact.collider_distance``.


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
    """Brute force over all triangles."""
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
    """Nearest points [N, T, 3] on triangles, and the feature [N, T] that they belong to.

    The nearest of the face (if the point is above it), the three edges and the three corners.
    """
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
    """Fraction [N] of each displacement until a particle touches a solid, or MISSES; normals.

    See ``contact.resolve_particle_collider``.
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
    pending = ~at_once
    found = torch.where(at_once, t, torch.full_like(t, MISSES))
    for _ in range(LOOKS):
        inward = -(way * n).sum(-1)
        reached = pending & (gap <= near)
        met = reached & (inward > 0)
        found = torch.where(met, t, found)
        n = torch.where(met[:, None], _face_on(solid, way / length[:, None], n, half), n)
        pending = pending & ~reached
        t = torch.where(pending, t + gap / length, t)
        pending = pending & (t <= 1.0)
        distance, ahead = collider_distance(solid, x + t[:, None] * way)
        n = torch.where(pending[:, None], ahead, n)
        gap = torch.where(pending, distance - half, gap)
    return torch.where(pending, t, found), n


def _face_on(solid: Solid, along: Tensor, n: Tensor, half: Tensor) -> Tensor:
    """See ``contact.face_on``; ``along`` is the direction of motion."""
    if not isinstance(solid, Cylinder | Capsule):
        return n
    own = (solid.radius / half).clamp(max=1.0)[:, None]
    return torch.nn.functional.normalize(own * n - (1 - own) * along, dim=-1)


def _touch_of_box(box: Box, x: Tensor, way: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """``first_touch`` for a box, whose faces extend half a spacing beyond its edges."""
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
