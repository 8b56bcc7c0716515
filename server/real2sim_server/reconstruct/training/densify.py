"""Densification: the sparse Adam optimiser, edits of the set of Gaussians, and the strategies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ...render import RenderOutput, ScreenStatistics
from ..options import ReconstructError
from . import kernels
from .gaussians import FIELDS, OBJECT_FIELDS, Gaussians

# Sparse Adam: only rows with gradients are updated.

EPSILON = 1e-15
JOINT = ("means", "log_scales")
"""Parameters whose columns share a second moment, so that a step has the direction of the gradient
(Ling et al. 2022). Otherwise, every axis moves at the full rate, also along rays, where images give
almost no gradient.
"""


class SelectiveAdam:
    """Adam (Kingma and Ba 2015) over named tensors with one row per Gaussian.

    Unseen rows keep their value and moments, so a Gaussian does not drift while it is out of view.
    The bias correction uses the global step count.

    Args:
        parameters: by name, float32, updated in place.
    """

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        self.steps = 0
        self.first = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.second = {name: torch.zeros_like(p) for name, p in parameters.items()}

    @torch.no_grad()
    def step(
        self,
        parameters: Mapping[str, Tensor],
        rates: Mapping[str, float | Tensor],
        seen: Mapping[str, Tensor],
    ) -> None:
        """One step along the gradients of ``parameters``.

        Args:
            parameters: those without a gradient do not change.
            rates: learning rate by name, one number or one per column.
            seen: [rows] bool by name; all rows if a name is missing.
        """
        self.steps += 1
        for name, parameter in parameters.items():
            if parameter.grad is not None and parameter.numel():
                self._update(name, parameter, parameter.grad, rates[name], seen.get(name))

    def _update(
        self,
        name: str,
        parameter: Tensor,
        gradient: Tensor,
        rate: float | Tensor,
        seen: Tensor | None,
    ) -> None:
        rows, joint = parameter.shape[0], name in JOINT
        views = [
            t.detach().reshape(rows, -1)
            for t in (parameter, gradient, self.first[name], self.second[name])
        ]
        columns = torch.as_tensor(rate, dtype=torch.float32, device=parameter.device)
        columns = columns.expand(views[0].shape[1]) / (1 - 0.9**self.steps)
        correction = (1 - 0.999**self.steps) ** -0.5
        if seen is None:
            seen = torch.ones(rows, dtype=torch.bool, device=parameter.device)
        if parameter.device.type != "cpu":
            _update_plain(views, seen, columns, correction, joint=joint)
            return
        values, by_values, first, second = (view.numpy() for view in views)
        kernels.adam_rows(
            values,
            by_values,
            first,
            second,
            seen.numpy(),
            columns.contiguous().numpy(),
            np.float32(correction),
            np.float32(EPSILON),
            joint,
        )

    def gather(self, name: str, source: Tensor, fresh: Tensor) -> None:
        """Apply a change of rows: new row i was row ``source[i]``; ``fresh`` rows get zero
        moments.

        Args:
            source: [M] int64.
            fresh: [M] bool.
        """
        for moments in (self.first, self.second):
            taken = moments[name][source].contiguous()
            taken[fresh] = 0
            moments[name] = taken

    def reset_moments(self, name: str, rows: Tensor | None = None) -> None:
        """Set moments to zero, of ``rows`` (mask or indices) or of all."""
        for moments in (self.first, self.second):
            moments[name][slice(None) if rows is None else rows] = 0

    def state(self) -> dict[str, Tensor]:
        """Moments as ``first.<name>`` and ``second.<name>``, without copies."""
        return {f"first.{k}": v for k, v in self.first.items()} | {
            f"second.{k}": v for k, v in self.second.items()
        }

    def restore(self, state: Mapping[str, Tensor], steps: int) -> None:
        """Restore the result of :meth:`state` after ``steps`` steps; missing moments are 0."""
        self.steps = steps
        self.first = {k: state.get(f"first.{k}", held) for k, held in self.first.items()}
        self.second = {k: state.get(f"second.{k}", held) for k, held in self.second.items()}


def _update_plain(
    views: list[Tensor], seen: Tensor, columns: Tensor, correction: float, *, joint: bool
) -> None:
    values, gradient, first, second = views
    squares = gradient * gradient
    if joint:
        squares = squares.mean(1, keepdim=True)
    # torch.where avoids the device synchronisation of a boolean index.
    rows = seen[:, None]
    m = torch.where(rows, 0.9 * first + 0.1 * gradient, first)
    v = torch.where(rows, 0.999 * second + 0.001 * squares, second)
    first.copy_(m)
    second.copy_(v)
    values.sub_(torch.where(rows, columns * m / (v.sqrt() * correction + EPSILON), 0.0))


# Edits: duplicate, split, prune, relocate, reset.
#
# Every operation also updates the optimiser, so its moments stay with their rows. Rows stay sorted
# by owner.

SPLIT_SHRINK = 1.6
"""Factor by which the halves of a split Gaussian are smaller (Kerbl et al. 2023)."""
RESET_OPACITY = 0.01
MAX_COPIES = 51
"""Cap on the number of copies of one Gaussian when opacity is divided among them."""


def step_generator(seed: int, iteration: int) -> np.random.Generator:
    """Random generator of seed and iteration only, so that a resumed run is identical."""
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
    """Duplicate, split and prune in one pass (Kerbl et al. 2023); every tensor is gathered once.

    Args:
        duplicate: [N] bool, get a copy with zero moments.
        split: [N] bool, are replaced by two smaller ones at random positions within the original.
        prune: [N] bool, are removed; disjoint from the other masks.
        rng: samples the positions of the halves.
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
    """Sample the positions of ``halves`` from their original Gaussians, and shrink them."""
    scales = gaussians.log_scales[halves].exp()
    noise = rng.standard_normal((len(halves), 3), dtype=np.float32)
    offset = torch.from_numpy(noise).to(scales.device) * scales
    rotated = torch.einsum("nij,nj->ni", rotation_matrices(gaussians.quats[halves]), offset)
    gaussians.means[halves] += rotated
    gaussians.log_scales[halves] -= float(np.log(SPLIT_SHRINK))


@torch.no_grad()
def prune(gaussians: Gaussians, optimizer: SelectiveAdam, mask: Tensor) -> Gaussians:
    """Remove the Gaussians of ``mask`` [N] bool."""
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
    """Replace dead Gaussians by copies of live ones, sampled by opacity (Kheradmand et al. 2024).

    The copies of a Gaussian together look like the original.

    Args:
        dead: [N] bool.
        count: number of Gaussians afterwards; at least the number of live ones.
        min_opacity: minimum opacity of copies.
        rng: samples the Gaussians to copy.
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
    """``count`` indices [count] int64, sampled with probability proportional to ``weights`` [N]."""
    sums = np.cumsum(weights.double().cpu().numpy())
    chosen = np.searchsorted(sums, rng.random(count) * sums[-1], side="right")
    return torch.from_numpy(np.minimum(chosen, len(sums) - 1)).to(weights.device)


def compute_relocation(
    opacities: Tensor, copies: Tensor, min_opacity: float
) -> tuple[Tensor, Tensor]:
    """Opacity [M] of each of ``copies`` [M] that together look like one, and their size factor.

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
    """Add noise along each Gaussian's shape to the means, in place.

    Kheradmand et al. 2024, eq. 8: the more transparent a Gaussian, the more it moves.

    Args:
        rate: learning rate of the means [m].
        strength: strength of the noise, relative to the rate.
        min_opacity: opacity around which the noise fades out.
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
    """Lower all opacities to RESET_OPACITY in place, so that only the Gaussians in use recover."""
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


# Strategies for adding and removing Gaussians.
#
# The trainer calls a strategy twice a step, as in gsplat: :meth:`Strategy.step_pre_backward` with
# the render and :meth:`Strategy.step_post_backward` after the optimiser's step.

BOX_MARGIN = 1.15
"""Gaussians of objects may exceed their boxes by this factor: mirrors, antennas, inexact boxes."""


@dataclass(frozen=True)
class VisibilityLimits:
    """Limits of hidden Gaussians, see :mod:`.visibility`.

    Attributes:
        fraction: all Gaussians up to this visible fraction are hidden.
        occluded_fraction: visible fraction up to which Gaussians deep behind a surface are hidden.
        occluded_depth: minimum depth behind the surface [m].
    """

    fraction: float = 0.005
    occluded_fraction: float = 0.03
    occluded_depth: float = 0.3


@dataclass(frozen=True)
class DensifyOptions:
    """Schedule and limits for adding and removing Gaussians.

    Attributes:
        method: name of a strategy, see STRATEGIES.
        start, stop: range of the rounds, as fractions of all iterations.
        every: iterations between rounds.
        max_gaussians: maximum number.
        background_gradient: absgrad on the image above which background grows.
        object_gradient: plain gradient above which objects grow.
        split_scale: Gaussians larger than this are split, smaller ones duplicated [m].
        min_opacity: Gaussians below it are removed, or moved by ``mcmc``.
        max_scale: larger ones near the drive are removed [m].
        reset_every: iterations between resets of opacity; 0 for never.
        noise: for ``mcmc``, factor on the learning rate of means.
        growth: for ``mcmc``, relative growth of the number per round.
        hidden_round: fraction of all iterations at which hidden Gaussians are pruned; 0 for never.
        prior_round: fraction of all iterations at which they are pruned again and replaced by
            priors of stage 0, 0 for never; the surfaces in front close up in the remaining
            iterations.
        background_limits: limits of hidden Gaussians in the background.
        object_limits: limits of hidden Gaussians in objects.
        last_background_limits: additional limits in the prior round, for background no higher than
            the objects: Gaussians metres behind the visible surfaces were learnt through gaps in
            them, and become visible when an object is deleted.
        last_object_limits: the same in objects: an interior seen through a window is rarely learnt
            well, and looks better in the window's colour.
    """

    method: str = "gradient"
    start: float = 0.02
    stop: float = 0.5
    every: int = 100
    max_gaussians: int = 1_000_000
    background_gradient: float = 6e-4
    object_gradient: float = 2e-4
    split_scale: float = 0.2
    min_opacity: float = 0.005
    max_scale: float = 4.0
    reset_every: int = 3000
    noise: float = 5e5
    growth: float = 0.05
    hidden_round: float = 0.6
    prior_round: float = 0.85
    background_limits: VisibilityLimits = field(default_factory=VisibilityLimits)
    object_limits: VisibilityLimits = field(
        default_factory=lambda: VisibilityLimits(0.01, occluded_fraction=0.03, occluded_depth=0.3)
    )
    last_background_limits: VisibilityLimits = field(
        default_factory=lambda: VisibilityLimits(0.005, occluded_fraction=0.1, occluded_depth=4.0)
    )
    last_object_limits: VisibilityLimits = field(
        default_factory=lambda: VisibilityLimits(0.03, occluded_fraction=0.3, occluded_depth=0.15)
    )


@dataclass(frozen=True, eq=False)
class ScreenSums:
    """Visibility on images since the last round.

    Attributes:
        gradients: [N, 2] float32 sums, see ScreenStatistics.
        views: [N] float32, number of images that each Gaussian was rendered in.
    """

    gradients: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, count: int, device: torch.device | str = "cpu") -> ScreenSums:
        """Empty statistics of ``count`` Gaussians."""
        return cls(torch.zeros(count, 2, device=device), torch.zeros(count, device=device))

    def add(self, rows: list[slice], screen: ScreenStatistics) -> None:
        """Add one image; ``rows`` are those of each rendered instance."""
        for part, radii, gradients in zip(rows, screen.radii, screen.gradients, strict=True):
            self.gradients[part] += gradients
            self.views[part] += (radii > 0).any(0)


@dataclass(frozen=True, eq=False)
class TrainingStep:
    """A finished step.

    Attributes:
        iteration: counted from 0.
        rows: rows of the Gaussians of each rendered instance.
        screen: their positions on the image, with gradients.
        means_rate: learning rate of the means in this step [m].
    """

    iteration: int
    rows: list[slice]
    screen: ScreenStatistics
    means_rate: float


class Strategy:
    """Base strategy: does not change the set of Gaussians; subclasses add and remove.

    Attributes:
        state: visibility since the last round; a part of checkpoints.

    Args:
        options: see :class:`DensifyOptions`.
        half_sizes: [I, 3] half the sizes of the objects' boxes [m], on the Gaussians' device.
        seed: seed of all noise, together with the iteration.
        iterations: iterations of the whole training.
    """

    def __init__(
        self, options: DensifyOptions, half_sizes: Tensor, *, seed: int, iterations: int
    ) -> None:
        self.options = options
        self.state = ScreenSums.zeros(0, half_sizes.device)
        self._half_sizes = half_sizes
        self._seed = seed
        self._first = round(options.start * iterations)
        self._last = round(options.stop * iterations)

    def initialize_state(self, count: int) -> None:
        """Restart the statistics for ``count`` Gaussians after an external change of the set."""
        self.state = ScreenSums.zeros(count, self._half_sizes.device)

    def step_pre_backward(self, output: RenderOutput) -> None:
        """Called after the image of a step is rendered, before the backward pass.

        Raises:
            ReconstructError: the renderer has no screen statistics.
        """
        if output.screen is None:
            raise ReconstructError(
                "this renderer does not report the contributions of Gaussians; choose another"
            )

    def step_post_backward(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, step: TrainingStep
    ) -> Gaussians:
        """The Gaussians after the optimiser's step; the moments in ``optimizer`` are updated to
        match.
        """
        self.state.add(step.rows, step.screen)
        return gaussians

    def step_end(self, gaussians: Gaussians, optimizer: SelectiveAdam, iteration: int) -> None:
        """Last call in a step, in place, after hidden Gaussians were pruned; nothing by default."""

    def _is_due(self, iteration: int) -> bool:
        """Whether a round of adding and removing follows the step ``iteration``."""
        in_span = self._first <= iteration < self._last
        return in_span and (iteration + 1) % self.options.every == 0

    def _dead(self, gaussians: Gaussians) -> Tensor:
        """[N] bool: transparent, too large, or outside the box of their object."""
        options, background = self.options, gaussians.counts[0]
        dead = gaussians.logits.sigmoid() < options.min_opacity
        dead[:background] |= gaussians.log_scales[:background].amax(-1).exp() > options.max_scale
        if len(gaussians) > background:
            half = torch.repeat_interleave(
                self._half_sizes,
                torch.tensor(gaussians.counts[1:], device=self._half_sizes.device),
                dim=0,
                output_size=len(gaussians) - background,
            )
            outside = gaussians.means[background:].abs() > half * BOX_MARGIN + 0.1
            dead[background:] |= outside.any(-1)
        return dead


class GradientStrategy(Strategy):
    """Duplicates and splits where gradients on the image are large, prunes, resets opacities.

    Kerbl et al. 2023, with absolute gradients (Ye et al. 2024) in the background.
    """

    @torch.no_grad()
    def step_post_backward(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, step: TrainingStep
    ) -> Gaussians:
        """Duplicate, split and prune in rounds."""
        super().step_post_backward(gaussians, optimizer, step)
        if not self._is_due(step.iteration):
            return gaussians
        dead = self._dead(gaussians)
        growing = self._growing(gaussians, dead)
        large = gaussians.log_scales.amax(-1).exp() > self.options.split_scale
        refined = refine(
            gaussians,
            optimizer,
            duplicate=growing & ~large,
            split=growing & large,
            prune=dead,
            rng=step_generator(self._seed, step.iteration),
        )
        self.initialize_state(len(refined))
        return refined

    def step_end(self, gaussians: Gaussians, optimizer: SelectiveAdam, iteration: int) -> None:
        """Reset opacities every ``options.reset_every`` iterations."""
        every = self.options.reset_every
        if 0 < every <= iteration + 1 < self._last and (iteration + 1) % every == 0:
            reset_opacity(gaussians, optimizer)

    def _growing(self, gaussians: Gaussians, dead: Tensor) -> Tensor:
        """[N] bool: the strongest gradients above the threshold, within the budget."""
        options, background = self.options, gaussians.counts[0]
        mean = self.state.gradients / self.state.views.clamp(min=1)[:, None]
        excess = mean.new_empty(len(gaussians))
        excess[:background] = mean[:background, 1] / options.background_gradient
        excess[background:] = mean[background:, 0] / options.object_gradient
        excess[dead] = 0
        budget = max(0, options.max_gaussians - len(gaussians) + int(dead.sum()))
        growing = excess >= 1
        if int(growing.sum()) > budget:
            strongest = torch.argsort(excess, descending=True, stable=True)[:budget]
            growing = torch.zeros_like(growing)
            growing[strongest] = True
        return growing


class McmcStrategy(Strategy):
    """Relocates dead Gaussians to live ones and adds noise to all (Kheradmand et al. 2024)."""

    @torch.no_grad()
    def step_post_backward(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, step: TrainingStep
    ) -> Gaussians:
        """Inject noise in every step; relocate and grow in rounds."""
        super().step_post_backward(gaussians, optimizer, step)
        options = self.options
        inject_noise(
            gaussians,
            rate=step.means_rate,
            strength=options.noise,
            min_opacity=options.min_opacity,
            rng=step_generator(self._seed, step.iteration),
        )
        if not self._is_due(step.iteration):
            return gaussians
        relocated = relocate(
            gaussians,
            optimizer,
            self._dead(gaussians),
            count=min(options.max_gaussians, round(len(gaussians) * (1 + options.growth))),
            min_opacity=options.min_opacity,
            rng=step_generator(self._seed, step.iteration),
        )
        self.initialize_state(len(relocated))
        return relocated


STRATEGIES: dict[str, type[Strategy]] = {
    "none": Strategy,
    "gradient": GradientStrategy,
    "mcmc": McmcStrategy,
}
"""Strategies by the name used in ``DensifyOptions.method``."""
