"""Where Gaussians are added and removed: by gradients on the image, or by moving dead ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...render import ScreenStatistics
from . import relocation
from .gaussians import FIELDS, OBJECT_FIELDS, Gaussians
from .optimizer import SelectiveAdam
from .schedule import DensifyOptions

SPLIT_SHRINK = 1.6
"""By which the halves of a split Gaussian are smaller (Kerbl et al. 2023)."""
RESET_OPACITY = 0.01
BOX_MARGIN = 1.15
"""Objects' Gaussians may stick out of their boxes by this factor: mirrors, antennas, bad boxes."""


@dataclass(frozen=True, eq=False)
class ScreenSums:
    """What was seen on images since the last round.

    Attributes:
        gradients: [N, 2] float32 sums, see ScreenStatistics.
        views: [N] float32, in how many images each Gaussian was drawn.
    """

    gradients: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, count: int) -> ScreenSums:
        """For ``count`` Gaussians that were not seen yet."""
        return cls(torch.zeros(count, 2), torch.zeros(count))

    def add(self, rows: list[slice], screen: ScreenStatistics) -> None:
        """Add one image; ``rows`` are those of each drawn instance."""
        for part, radii, gradients in zip(rows, screen.radii, screen.gradients, strict=True):
            self.gradients[part] += gradients
            self.views[part] += (radii > 0).any(0)


class Densifier:
    """Changes the set of Gaussians and keeps the optimiser's moments in step with it.

    Args:
        options: see there.
        half_sizes: [I, 3] half the sizes of the objects' boxes [m].
        seed: of all noise, together with the iteration.
        iterations: of the whole training.
    """

    def __init__(
        self, options: DensifyOptions, half_sizes: Tensor, *, seed: int, iterations: int
    ) -> None:
        self.options = options
        self._half_sizes = half_sizes
        self._seed = seed
        self._first = round(options.start * iterations)
        self._last = round(options.stop * iterations)
        self._prior_round = round(options.prior_round * iterations)
        self._hidden_rounds = {round(fraction * iterations) for fraction in options.hidden_rounds}

    def is_due(self, iteration: int) -> bool:
        """Whether a round follows the step ``iteration``."""
        options = self.options
        return (
            options.method != "none"
            and self._first <= iteration < self._last
            and (iteration + 1) % options.every == 0
        )

    def resets_opacity(self, iteration: int) -> bool:
        """Whether opacities are lowered after the step ``iteration``."""
        every = self.options.reset_every
        gradient = self.options.method == "gradient"
        return gradient and 0 < every <= iteration + 1 < self._last and (iteration + 1) % every == 0

    def drops_hidden(self, iteration: int) -> bool:
        """Whether Gaussians that images hardly show go after the step ``iteration``."""
        return iteration + 1 in self._hidden_rounds

    def inserts_priors(self, iteration: int) -> bool:
        """Whether priors take their places after the step ``iteration``."""
        return iteration + 1 == self._prior_round

    @torch.no_grad()
    def round(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, sums: ScreenSums, iteration: int
    ) -> Gaussians:
        """The Gaussians after one round; the moments in ``optimizer`` follow."""
        rng = generator(self._seed, iteration)
        if self.options.method == "mcmc":
            return self._relocate(gaussians, optimizer, rng)
        return self._grow_and_prune(gaussians, optimizer, sums, rng)

    def _grow_and_prune(
        self,
        gaussians: Gaussians,
        optimizer: SelectiveAdam,
        sums: ScreenSums,
        rng: np.random.Generator,
    ) -> Gaussians:
        dead = self._dead(gaussians)
        growing = self._growing(gaussians, sums, dead)
        large = gaussians.log_scales.amax(-1).exp() > self.options.split_scale
        split, clone = growing & large, growing & ~large
        kept = (~dead & ~split).nonzero()[:, 0]
        cloned, halves = clone.nonzero()[:, 0], split.nonzero()[:, 0].repeat(2)
        source = torch.cat([kept, cloned, halves])
        kind = torch.zeros(len(source), dtype=torch.int64)
        kind[len(kept) :] = 1
        kind[len(kept) + len(cloned) :] = 2
        order = torch.argsort(gaussians.owners[source], stable=True)
        source, kind = source[order], kind[order]
        grown = rearrange(gaussians, optimizer, source, kind > 0)
        half = (kind == 2).nonzero()[:, 0]
        return _spread(grown, half, rng)

    def _dead(self, gaussians: Gaussians) -> Tensor:
        """[N] bool: transparent, too large, or outside the box of their object."""
        options, background = self.options, gaussians.counts[0]
        dead = gaussians.logits.sigmoid() < options.min_opacity
        dead[:background] |= gaussians.log_scales[:background].amax(-1).exp() > options.max_scale
        if len(gaussians) > background:
            half = torch.repeat_interleave(
                self._half_sizes, torch.tensor(gaussians.counts[1:]), dim=0
            )
            outside = gaussians.means[background:].abs() > half * BOX_MARGIN + 0.1
            dead[background:] |= outside.any(-1)
        return dead

    def _growing(self, gaussians: Gaussians, sums: ScreenSums, dead: Tensor) -> Tensor:
        options, background = self.options, gaussians.counts[0]
        mean = sums.gradients / sums.views.clamp(min=1)[:, None]
        excess = torch.empty(len(gaussians))
        excess[:background] = mean[:background, 1] / options.background_gradient
        excess[background:] = mean[background:, 0] / options.object_gradient
        excess[dead] = 0
        room = max(0, options.max_gaussians - len(gaussians) + int(dead.sum()))
        growing = excess >= 1
        if int(growing.sum()) > room:
            first = torch.argsort(excess, descending=True, stable=True)[:room]
            growing = torch.zeros_like(growing)
            growing[first] = True
        return growing

    def _relocate(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, rng: np.random.Generator
    ) -> Gaussians:
        options = self.options
        opacities = gaussians.logits.sigmoid()
        dead = self._dead(gaussians)
        alive = (~dead).nonzero()[:, 0]
        if len(alive) == 0:
            return gaussians
        wanted = min(options.max_gaussians, round(len(gaussians) * (1 + options.growth)))
        drawn = relocation.sample_by_weight(opacities[alive], max(0, wanted - len(alive)), rng)
        source = torch.cat([alive, alive[drawn]])
        copies = torch.bincount(source, minlength=len(gaussians))
        order = torch.argsort(gaussians.owners[source], stable=True)
        source = source[order]
        moved = rearrange(gaussians, optimizer, source, copies[source] > 1)
        many = (copies[source] > 1).nonzero()[:, 0]
        new_opacity, factor = relocation.compute_relocation(
            moved.logits[many].sigmoid(), copies[source][many], options.min_opacity
        )
        moved.logits[many] = torch.logit(new_opacity)
        moved.log_scales[many] += factor.log()[:, None]
        return moved

    @torch.no_grad()
    def jitter(self, gaussians: Gaussians, rate: float, iteration: int) -> None:
        """Noise of MCMC on the means, along each Gaussian's own shape; none for other methods.

        Kheradmand et al. 2024, eq. 8: the more transparent a Gaussian, the more it wanders.
        """
        if self.options.method != "mcmc":
            return
        rng = generator(self._seed, iteration)
        noise = torch.from_numpy(rng.standard_normal((len(gaussians), 3), dtype=np.float32))
        opacity = gaussians.logits.sigmoid()
        freedom = torch.sigmoid(-100 * (opacity - self.options.min_opacity))
        turn = rotations(gaussians.quats)
        along = torch.einsum("nji,nj->ni", turn, noise) * (2 * gaussians.log_scales).exp()
        step = torch.einsum("nij,nj->ni", turn, along)
        gaussians.means.add_(step * (freedom * rate * self.options.noise)[:, None])


def rearrange(
    gaussians: Gaussians, optimizer: SelectiveAdam, source: Tensor, fresh: Tensor
) -> Gaussians:
    """Rows ``source`` [M] (sorted by owner) of Gaussians and of all moments.

    Args:
        fresh: [M] bool, rows that start with moments of zero.
    """
    of_objects = source >= gaussians.counts[0]
    for name in FIELDS:
        mine = fresh[of_objects] if name in OBJECT_FIELDS else fresh
        optimizer.gather(name, gaussians.rows(name, source), mine)
    return gaussians.take(source)


@torch.no_grad()
def reset_opacity(gaussians: Gaussians, optimizer: SelectiveAdam) -> None:
    """Lower all opacities to 0.01, so that only what is needed comes back."""
    limit = float(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    gaussians.logits.clamp_(max=limit)
    optimizer.reset_moments("logits")


def generator(seed: int, iteration: int) -> np.random.Generator:
    """Noise that depends on seed and iteration alone, so that a resumed run draws the same."""
    return np.random.Generator(np.random.Philox(key=[seed, (1 << 40) + iteration]))


def rotations(quats: Tensor) -> Tensor:
    """[N, 3, 3] of quaternions [N, 4] wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _spread(gaussians: Gaussians, halves: Tensor, rng: np.random.Generator) -> Gaussians:
    """Draw the places of ``halves`` from the Gaussians they came from, and shrink them."""
    scales = gaussians.log_scales[halves].exp()
    noise = rng.standard_normal((len(halves), 3), dtype=np.float32)
    offset = torch.from_numpy(noise) * scales
    turned = torch.einsum("nij,nj->ni", rotations(gaussians.quats[halves]), offset)
    gaussians.means[halves] += turned
    gaussians.log_scales[halves] -= float(np.log(SPLIT_SHRINK))
    return gaussians
