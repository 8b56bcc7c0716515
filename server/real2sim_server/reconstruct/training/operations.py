"""What is done to a set of Gaussians while it trains: duplicate, split, prune, relocate, reset.

Every operation takes the optimiser along, so that its moments stay with their rows. Rows stay
sorted by owner.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from .gaussians import FIELDS, OBJECT_FIELDS, Gaussians
from .optimizer import SelectiveAdam

SPLIT_SHRINK = 1.6
"""By which the halves of a split Gaussian are smaller (Kerbl et al. 2023)."""
RESET_OPACITY = 0.01
MAX_COPIES = 51
"""More copies of one Gaussian are shared out as if there were so many."""


def step_generator(seed: int, iteration: int) -> np.random.Generator:
    """Noise that depends on seed and iteration alone, so that a resumed run draws the same."""
    return np.random.Generator(np.random.Philox(key=[seed, (1 << 40) + iteration]))


@torch.no_grad()
def refine(
    gaussians: Gaussians,
    optimizer: SelectiveAdam,
    *,
    duplicate: Tensor,
    split: Tensor,
    prune: Tensor,
    rng: np.random.Generator,
) -> Gaussians:
    """Duplicate, split and prune at once (Kerbl et al. 2023); every tensor is gathered once.

    Args:
        duplicate: [N] bool, get a copy with moments of zero.
        split: [N] bool, become two smaller ones, placed at random within the one.
        prune: [N] bool, removed; none of them is in the others.
        rng: places the halves.
    """
    kept = (~prune & ~split).nonzero()[:, 0]
    copies, halves = duplicate.nonzero()[:, 0], split.nonzero()[:, 0].repeat(2)
    source = torch.cat([kept, copies, halves])
    place = torch.arange(len(source), device=source.device)
    is_new, is_half = place >= len(kept), place >= len(kept) + len(copies)
    order = torch.argsort(gaussians.owners[source], stable=True)
    refined = select_rows(gaussians, optimizer, source[order], is_new[order])
    _scatter(refined, is_half[order].nonzero()[:, 0], rng)
    return refined


def _scatter(gaussians: Gaussians, halves: Tensor, rng: np.random.Generator) -> None:
    """Draw the places of ``halves`` from the Gaussians they came from, and shrink them."""
    scales = gaussians.log_scales[halves].exp()
    noise = rng.standard_normal((len(halves), 3), dtype=np.float32)
    offset = torch.from_numpy(noise).to(scales.device) * scales
    rotated = torch.einsum("nij,nj->ni", rotation_matrices(gaussians.quats[halves]), offset)
    gaussians.means[halves] += rotated
    gaussians.log_scales[halves] -= float(np.log(SPLIT_SHRINK))


@torch.no_grad()
def prune(gaussians: Gaussians, optimizer: SelectiveAdam, mask: Tensor) -> Gaussians:
    """Without the Gaussians of ``mask`` [N] bool."""
    kept = (~mask).nonzero()[:, 0]
    return select_rows(gaussians, optimizer, kept, torch.zeros_like(kept, dtype=torch.bool))


@torch.no_grad()
def relocate(
    gaussians: Gaussians,
    optimizer: SelectiveAdam,
    dead: Tensor,
    *,
    count: int,
    min_opacity: float,
    rng: np.random.Generator,
) -> Gaussians:
    """Replace dead Gaussians by copies of live ones, drawn by opacity (Kheradmand et al. 2024).

    Copies look together like the one they were made from.

    Args:
        dead: [N] bool.
        count: of Gaussians afterwards; never fewer than live ones.
        min_opacity: of copies.
        rng: draws which ones are copied.
    """
    live = (~dead).nonzero()[:, 0]
    if len(live) == 0:
        return gaussians
    opacities = gaussians.logits.sigmoid()
    drawn = sample_by_weight(opacities[live], max(0, count - len(live)), rng)
    source = torch.cat([live, live[drawn]])
    copies = torch.bincount(source, minlength=len(gaussians))
    source = source[torch.argsort(gaussians.owners[source], stable=True)]
    relocated = select_rows(gaussians, optimizer, source, copies[source] > 1)
    copied = (copies[source] > 1).nonzero()[:, 0]
    opacity, factor = compute_relocation(
        relocated.logits[copied].sigmoid(), copies[source][copied], min_opacity
    )
    relocated.logits[copied] = torch.logit(opacity)
    relocated.log_scales[copied] += factor.log()[:, None]
    return relocated


def sample_by_weight(weights: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """``count`` indices [count] int64 drawn with probability proportional to ``weights`` [N]."""
    sums = np.cumsum(weights.double().cpu().numpy())
    chosen = np.searchsorted(sums, rng.random(count) * sums[-1], side="right")
    return torch.from_numpy(np.minimum(chosen, len(sums) - 1)).to(weights.device)


def compute_relocation(
    opacities: Tensor, copies: Tensor, min_opacity: float
) -> tuple[Tensor, Tensor]:
    """Opacity [M] of each of ``copies`` [M] that look together like one, and factor on its size.

    Kheradmand et al. 2024, eq. 9.
    """
    n = copies.clamp(max=MAX_COPIES)
    opacities = opacities.clamp(max=1 - 1e-6).double()
    each = 1 - (1 - opacities) ** (1 / n)
    total = torch.zeros_like(each)
    for i in range(1, int(n.max()) + 1 if len(n) else 1):
        inner = torch.zeros_like(each)
        for k in range(i):
            inner += math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * each ** (k + 1)
        total += torch.where(i <= n, inner, 0.0)
    factor = opacities / total
    return each.clamp(min_opacity, 1 - 1e-6).float(), factor.float()


@torch.no_grad()
def inject_noise(
    gaussians: Gaussians,
    *,
    rate: float,
    strength: float,
    min_opacity: float,
    rng: np.random.Generator,
) -> None:
    """Move the means by noise along each Gaussian's own shape, in place.

    Kheradmand et al. 2024, eq. 8: the more transparent a Gaussian, the more it moves.

    Args:
        rate: learning rate of the means [m].
        strength: of the noise, relative to that.
        min_opacity: about which the noise ceases.
    """
    drawn = rng.standard_normal((len(gaussians), 3), dtype=np.float32)
    noise = torch.from_numpy(drawn).to(gaussians.means.device)
    opacity = gaussians.logits.sigmoid()
    freedom = torch.sigmoid(-100 * (opacity - min_opacity))
    rotations = rotation_matrices(gaussians.quats)
    along = torch.einsum("nji,nj->ni", rotations, noise) * (2 * gaussians.log_scales).exp()
    step = torch.einsum("nij,nj->ni", rotations, along)
    gaussians.means.add_(step * (freedom * rate * strength)[:, None])


@torch.no_grad()
def reset_opacity(gaussians: Gaussians, optimizer: SelectiveAdam) -> None:
    """Lower all opacities to RESET_OPACITY in place, so that only what is needed comes back."""
    limit = float(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    gaussians.logits.clamp_(max=limit)
    optimizer.reset_moments("logits")


def select_rows(
    gaussians: Gaussians, optimizer: SelectiveAdam, source: Tensor, fresh: Tensor
) -> Gaussians:
    """Rows ``source`` [M] (sorted by owner) of Gaussians and of all moments.

    Args:
        fresh: [M] bool, rows that start with moments of zero.
    """
    of_objects = source >= gaussians.counts[0]
    for name in FIELDS:
        fresh_rows = fresh[of_objects] if name in OBJECT_FIELDS else fresh
        optimizer.gather(name, gaussians.rows(name, source), fresh_rows)
    return gaussians.select(source)


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 3, 3] of quaternions [N, 4] wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
