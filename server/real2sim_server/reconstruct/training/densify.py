"""Strategies of densification: when Gaussians are added and removed, and which.

A strategy is called twice a step, as in gsplat: :meth:`Strategy.step_pre_backward` with what
was drawn and :meth:`Strategy.step_post_backward` after the optimiser's step. What it does to the
Gaussians are the functions of :mod:`.operations`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ...render import RenderOutput, ScreenStatistics
from ..options import ReconstructError
from . import operations
from .gaussians import Gaussians
from .optimizer import SelectiveAdam

BOX_MARGIN = 1.15
"""Objects' Gaussians may stick out of their boxes by this factor: mirrors, antennas, bad boxes."""


@dataclass(frozen=True)
class VisibilityLimits:
    """Which Gaussians count as hidden: see :mod:`.visibility`.

    Attributes:
        fraction: visible fraction up to which all are.
        occluded_fraction: visible fraction up to which those are that lie deep behind a surface.
        occluded_depth: how deep that is [m].
    """

    fraction: float = 0.005
    occluded_fraction: float = 0.03
    occluded_depth: float = 0.3


@dataclass(frozen=True)
class DensifyOptions:
    """When and how Gaussians are added and removed.

    Attributes:
        method: name of a strategy, see STRATEGIES.
        start, stop: fraction of all iterations between which it happens.
        every: iterations from one round to the next.
        max_gaussians: never more than so many.
        background_gradient: absgrad on the image above which background grows.
        object_gradient: plain gradient above which objects grow.
        split_scale: Gaussians larger than this are split, smaller ones duplicated [m].
        min_opacity: below it Gaussians are removed, or moved by ``mcmc``.
        max_scale: larger ones near the drive are removed [m].
        reset_every: iterations between resets of opacity; 0 for never.
        noise: of ``mcmc``: factor on the learning rate of means.
        growth: of ``mcmc``: fraction by which the number grows in a round.
        hidden_rounds: fractions of all iterations at which hidden Gaussians are pruned.
        prior_round: fraction of all iterations at which they are pruned once more, and priors of
            stage 0 take their places; what stands before these closes up in the rest.
        background_limits: of what counts as hidden in the background.
        object_limits: likewise in objects.
        last_background_limits: when priors take their places, besides, of what is no higher than
            the objects: what lies metres behind all that images show of it was learnt through gaps
            in them, and shows when one is deleted.
        last_object_limits: likewise in objects; what a window shows of an object's inside is
            hardly ever learnt well, and is better drawn as the window's colour.
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
    hidden_rounds: tuple[float, ...] = (0.35, 0.6)
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
    """What was visible on images since the last round.

    Attributes:
        gradients: [N, 2] float32 sums, see ScreenStatistics.
        views: [N] float32, in how many images each Gaussian was drawn.
    """

    gradients: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, count: int, device: torch.device | str = "cpu") -> ScreenSums:
        """For ``count`` Gaussians that were not visible yet."""
        return cls(torch.zeros(count, 2, device=device), torch.zeros(count, device=device))

    def add(self, rows: list[slice], screen: ScreenStatistics) -> None:
        """Add one image; ``rows`` are those of each drawn instance."""
        for part, radii, gradients in zip(rows, screen.radii, screen.gradients, strict=True):
            self.gradients[part] += gradients
            self.views[part] += (radii > 0).any(0)


@dataclass(frozen=True, eq=False)
class TrainingStep:
    """A step that was taken.

    Attributes:
        iteration: counted from 0.
        rows: of the Gaussians of each drawn instance.
        screen: where these were on the image, with gradients.
        means_rate: learning rate of the means in this step [m].
    """

    iteration: int
    rows: list[slice]
    screen: ScreenStatistics
    means_rate: float


class Strategy:
    """Leaves the set of Gaussians as it is; others add and remove.

    Attributes:
        state: what was visible since the last round; a part of checkpoints.

    Args:
        options: see there.
        half_sizes: [I, 3] half the sizes of the objects' boxes [m], where the Gaussians are.
        seed: of all noise, together with the iteration.
        iterations: of the whole training.
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
        """Begin anew for ``count`` Gaussians, after something else changed the set."""
        self.state = ScreenSums.zeros(count, self._half_sizes.device)

    def step_pre_backward(self, output: RenderOutput) -> None:
        """After the image of a step is drawn, before the loss is differentiated.

        Raises:
            ReconstructError: the renderer keeps no screen statistics.
        """
        if output.screen is None:
            raise ReconstructError("this renderer does not count what it draws; choose another")

    def step_post_backward(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, step: TrainingStep
    ) -> Gaussians:
        """The Gaussians after the optimiser's step; the moments in ``optimizer`` follow."""
        self.state.add(step.rows, step.screen)
        return gaussians

    def step_end(self, gaussians: Gaussians, optimizer: SelectiveAdam, iteration: int) -> None:
        """Last in a step, in place, after hidden Gaussians were pruned; nothing by default."""

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
        refined = operations.refine(
            gaussians,
            optimizer,
            duplicate=growing & ~large,
            split=growing & large,
            prune=dead,
            rng=operations.step_generator(self._seed, step.iteration),
        )
        self.initialize_state(len(refined))
        return refined

    def step_end(self, gaussians: Gaussians, optimizer: SelectiveAdam, iteration: int) -> None:
        """Reset opacities every ``options.reset_every`` iterations."""
        every = self.options.reset_every
        if 0 < every <= iteration + 1 < self._last and (iteration + 1) % every == 0:
            operations.reset_opacity(gaussians, optimizer)

    def _growing(self, gaussians: Gaussians, dead: Tensor) -> Tensor:
        """[N] bool: the strongest gradients above the threshold, as many as the budget allows."""
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
    """Moves dead Gaussians to live ones, and all of them by noise (Kheradmand et al. 2024)."""

    @torch.no_grad()
    def step_post_backward(
        self, gaussians: Gaussians, optimizer: SelectiveAdam, step: TrainingStep
    ) -> Gaussians:
        """Inject noise in every step; relocate and grow in rounds."""
        super().step_post_backward(gaussians, optimizer, step)
        options = self.options
        operations.inject_noise(
            gaussians,
            rate=step.means_rate,
            strength=options.noise,
            min_opacity=options.min_opacity,
            rng=operations.step_generator(self._seed, step.iteration),
        )
        if not self._is_due(step.iteration):
            return gaussians
        relocated = operations.relocate(
            gaussians,
            optimizer,
            self._dead(gaussians),
            count=min(options.max_gaussians, round(len(gaussians) * (1 + options.growth))),
            min_opacity=options.min_opacity,
            rng=operations.step_generator(self._seed, step.iteration),
        )
        self.initialize_state(len(relocated))
        return relocated


STRATEGIES: dict[str, type[Strategy]] = {
    "none": Strategy,
    "gradient": GradientStrategy,
    "mcmc": McmcStrategy,
}
"""By the name that ``DensifyOptions.method`` gives."""
