"""Stress in plain torch, batched over particles: the oracle, and the differentiable path.

Written in matrix form where ``constitutive.stress`` works with scalars and principal values:
logarithms by repeated square roots, flow by matrix exponentials. Nothing here divides by
differences of principal values, so gradients are right at rest, too. Only snow needs singular
values.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...constitutive import material_row
from ...constitutive.law import law_of_code
from ...constitutive.stress import SLACK, STRETCH_MIN, UNFOLDED, VOLUME_MIN
from ...errors import MaterialError

PACKED = (material_row.SNOW, material_row.CRUSH)
NEWTON_STEPS = 8
SQUARE_ROOTS = 3
SERIES_TERMS = 12


def stress_update(
    F: Tensor, history: Tensor, rows: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(elastic F, tau, energy density, history) of trial deformation gradients.

    Args:
        F: [N, 3, 3] trial F_elastic.
        history: [N], see ``constitutive.stress``.
        rows: [N, MATERIAL_ROW]; gradients flow to all columns but those of the law.
        dt: time since the last call [s].
    """
    codes = rows[:, material_row.LAW].detach().round().long()
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
    if code == material_row.COROTATED:
        return F, *_corotated(F, rows), history
    if code == material_row.NEO_HOOKEAN:
        return F, *_neo_hookean(F, rows), history
    if code in PACKED:
        return _snow(F, history, rows)
    return _hencky(code, F, history, rows, dt)


def _corotated(F: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    mu, lam = rows[:, material_row.MU], rows[:, material_row.LAMBDA]
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
    """Inverses [N, 3, 3] by cross products, which is many times faster than by factorising."""
    x, y, z = a.unbind(-2)
    yz = torch.linalg.cross(y, z)
    columns = torch.stack([yz, torch.linalg.cross(z, x), torch.linalg.cross(x, y)], dim=-1)
    inverted: Tensor = columns / (x * yz).sum(-1)[:, None, None]
    return inverted


def _neo_hookean(F: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    mu, lam = rows[:, material_row.MU], rows[:, material_row.LAMBDA]
    log_J = torch.linalg.det(F).clamp(min=float(VOLUME_MIN)).log()
    b = F @ F.mT
    eye = torch.eye(3, dtype=F.dtype)
    tau = mu[:, None, None] * (b - eye) + (lam * log_J)[:, None, None] * eye
    energy = mu / 2 * (_trace(b) - 3) - mu * log_J + lam / 2 * log_J**2
    return tau, energy


def _hencky(
    code: int, F: Tensor, history: Tensor, rows: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    mu, lam = rows[:, material_row.MU], rows[:, material_row.LAMBDA]
    eye = torch.eye(3, dtype=F.dtype)
    b = F @ F.mT
    e = log_symmetric(b) / 2
    if code == material_row.VON_MISES:
        taken, history = _von_mises(e, history, rows)
    elif code == material_row.VISCOPLASTIC:
        taken = _viscoplastic(e, b, rows, dt)
    elif code == material_row.DRUCKER_PRAGER:
        taken, history = _drucker_prager(e, history, rows)
    else:
        raise MaterialError(f"the reference has no flow rule for {law_of_code(code).name!r}")
    left = e - taken
    trace = _trace(left)
    tau = 2 * mu[:, None, None] * left + (lam * trace)[:, None, None] * eye
    energy = mu * left.square().sum((1, 2)) + lam / 2 * trace**2
    # The flow is coaxial with e, so taking strain away is a product.
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
    two_mu, hardening = 2 * rows[:, material_row.MU], rows[:, material_row.B]
    root = (2 / 3) ** 0.5
    excess = (two_mu * norm - root * (rows[:, material_row.A] + history)).clamp(min=0)
    flow = excess / (two_mu + 2 / 3 * hardening)
    fraction = torch.where(excess > 0, flow / norm.clamp(min=1e-300), torch.zeros_like(flow))
    return fraction[:, None, None] * d, history + root * hardening * flow


def _viscoplastic(e: Tensor, b: Tensor, rows: Tensor, dt: float) -> Tensor:
    d, norm = _deviator(e)
    mu = rows[:, material_row.MU]
    excess = (2 * mu * norm - (2 / 3) ** 0.5 * rows[:, material_row.A]).clamp(min=0)
    if dt <= 0:
        return torch.zeros_like(e)
    rate = dt / (dt + rows[:, material_row.B] / (2 * mu * _trace(b) / 3))
    part = torch.where(excess > 0, rate * excess / (2 * mu * norm.clamp(min=1e-300)), 0 * norm)
    return part[:, None, None] * d


def _drucker_prager(e: Tensor, history: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    mu, lam, alpha = rows[:, material_row.MU], rows[:, material_row.LAMBDA], rows[:, material_row.A]
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
        1 - rows[:, material_row.A : material_row.A + 1],
        1 + rows[:, material_row.B : material_row.B + 1],
    )
    crushed = (rows[:, material_row.LAW] == material_row.CRUSH) & (history < 0)
    holds = (rows[:, material_row.B] * (1 + float(UNFOLDED) * history)).clamp(min=float(SLACK))
    high = torch.where(crushed[:, None], 1 + holds[:, None], high)
    s = torch.minimum(torch.maximum(S, low), high)
    history = history + (S.prod(1) / s.prod(1)).log()
    hard = (rows[:, material_row.C] * (1 - history.exp())).clamp(-3, 3).exp()
    mu, lam, J = rows[:, material_row.MU] * hard, rows[:, material_row.LAMBDA] * hard, s.prod(1)
    principal = 2 * mu[:, None] * (s - 1) * s + (lam * J * (J - 1))[:, None]
    tau = U @ torch.diag_embed(principal) @ U.mT
    energy = mu * (s - 1).square().sum(1) + lam / 2 * (J - 1) ** 2
    return U @ torch.diag_embed(s) @ Vh, tau, energy, history


def wave_hardening(history: Tensor, rows: Tensor) -> Tensor:
    """[N] by how much plastic flow has stiffened particles; see ``constitutive.stress``."""
    codes = rows[:, material_row.LAW]
    packed = (codes == material_row.SNOW) | (codes == material_row.CRUSH)
    hardening = (rows[:, material_row.C] * (1 - history.exp())).clamp(-3, 3).exp()
    return torch.where(packed, hardening, torch.ones_like(hardening))


def _trace(a: Tensor) -> Tensor:
    return a.diagonal(dim1=-2, dim2=-1).sum(-1)
