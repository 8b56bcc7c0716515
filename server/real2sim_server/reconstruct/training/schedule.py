"""Options of training: iterations, learning rates over time, densification, presets."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..options import InitialiseOptions, ReconstructError
from .densify import STRATEGIES, DensifyOptions
from .losses import LossWeights

# Options for colours and sides seen from few directions.


@dataclass(frozen=True)
class DirectionOptions:
    """Treatment of objects that training images show from one side only.

    Attributes:
        lobe_prior: variance of the directions at which objects keep half of a direction-dependent
            colour; 0 keeps the learnt colours.
        paint: whether vehicle sides that images show only edge on get the colours of their
            bodies; the colours visible in the images stay.
        sides: whether vehicle sides that images show only edge on come from initialisation. This
            improves edits and degrades recorded views.
        close: whether vehicles that images show from one direction only are closed: the learnt
            Gaussians are projected onto the body's surface, with the body behind them.
        views: number of views to examine.
    """

    lobe_prior: float = 0.03
    paint: bool = True
    sides: bool = False
    close: bool = True
    views: int = 32


# Training options and presets.

COLOUR_BASES = ("cosine", "real_dft")
HIGHER_HARMONICS_RATE = 1 / 20
FINE_START = 0.55
"""Fraction of the iterations after which images wider than the preset's width are used at full
size.
"""


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates; pairs decay exponentially from the first to the second value.

    Attributes:
        means: centres [m per step].
        scales, quats, opacities: log scales, raw quaternions and logits.
        colour: constant part; the rest of the spherical harmonics gets 1/20 of it.
        fourier: time-varying colour.
        sky: cube map of the sky.
        pose_translation: positions of object boxes [m].
        pose_yaw: yaw of object boxes [rad].
        pose_tilt: roll and pitch of object boxes [rad].
        camera: camera poses [m, rad]; 0 keeps the calibration.
        exposure: affine colour of each camera; 0 disables it.
        image_exposure: gains of each image; 0 keeps them at 1.

    Sources: Kerbl et al. 2023; Street Gaussians (poses, sky); drivestudio (cameras).
    """

    means: tuple[float, float] = (1.6e-3, 1.6e-5)
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 0.05
    colour: float = 2.5e-3
    fourier: float = 2.5e-3
    sky: tuple[float, float] = (0.01, 1e-4)
    pose_translation: tuple[float, float] = (5e-3, 5e-5)
    pose_yaw: tuple[float, float] = (1e-3, 1e-5)
    pose_tilt: tuple[float, float] = (1e-3, 1e-5)
    camera: float = 0.0
    exposure: float = 0.0
    image_exposure: float = 0.0


@dataclass(frozen=True)
class TrainOptions:
    """All settings of a training run; the same log and values give the same scene.

    Attributes:
        iterations: steps, one image each.
        seed: seed of the order of images and of all noise.
        width: image width [px]; None for the logged width. Never above ``max_width``.
        max_width: largest width of training images [px].
        coarse: (fraction of iterations, divisor of the width) stages before full size.
        scales: divisors of the width to cycle through after these stages; (1, 2, 2) keeps a scene
            sharp at full size and accurate at half of it.
        sh_degree: highest degree of the spherical harmonics.
        sh_every: fraction of the iterations after which the degree increases by one.
        harmonics: number of basis functions of objects' time-varying colours; 0 for none.
        harmonics_basis: ``cosine`` (half periods) or ``real_dft``.
        hold_out: hold out every Nth frame for evaluation; 0 trains on all.
        refine_poses: whether to refine object boxes.
        pose_start: fraction of the iterations before which boxes are fixed.
        mirror: fraction of steps that show vehicles mirrored about their long axis.
        initial_opacity: initial opacity of Gaussians from LiDAR.
        sky_resolution: edge length of a face of the sky [px].
        depth_points: maximum number of LiDAR points per step.
        regularise_every: interval of the steps with the costly object terms.
        image_bytes: memory for decoded images.
        log_every, preview_every, checkpoint_every: iterations between lines of metrics, preview
            pictures and checkpoints; 0 for none but the last.
        initialise: options of stage 0.
        learning_rates, losses, densify, directions: see their classes.

    Raises:
        ReconstructError: a value is out of range.
    """

    iterations: int = 30_000
    seed: int = 0
    width: int | None = None
    max_width: int = 1600
    coarse: tuple[tuple[float, int], ...] = ()
    scales: tuple[int, ...] = (1,)
    sh_degree: int = 1
    sh_every: float = 0.05
    harmonics: int = 4
    harmonics_basis: str = "cosine"
    hold_out: int = 4
    refine_poses: bool = True
    pose_start: float = 0.05
    mirror: float = 0.2
    initial_opacity: float = 0.8
    sky_resolution: int = 256
    depth_points: int = 4096
    regularise_every: int = 10
    image_bytes: int = 2 << 30
    log_every: int = 50
    preview_every: int = 2000
    checkpoint_every: int = 1000
    initialise: InitialiseOptions = field(default_factory=InitialiseOptions)
    learning_rates: LearningRates = field(default_factory=LearningRates)
    losses: LossWeights = field(default_factory=LossWeights)
    densify: DensifyOptions = field(default_factory=DensifyOptions)
    directions: DirectionOptions = field(default_factory=DirectionOptions)

    def __post_init__(self) -> None:
        _check_range(self, "iterations", 1, 10_000_000)
        _check_range(self, "sh_degree", 0, 3)
        _check_range(self, "harmonics", 0, 16)
        _check_range(self, "mirror", 0, 1)
        _check_range(self, "initial_opacity", 0.01, 0.99)
        _check_range(self, "sky_resolution", 1, 4096)
        if self.hold_out != 0:
            _check_range(self, "hold_out", 2, 1_000_000)
        if self.densify.method not in STRATEGIES:
            raise ReconstructError(
                f"densify.method must be one of {list(STRATEGIES)}, not {self.densify.method!r}"
            )
        if self.harmonics_basis not in COLOUR_BASES:
            raise ReconstructError(
                f"harmonics_basis must be one of {list(COLOUR_BASES)}, not {self.harmonics_basis!r}"
            )

    def active_degree(self, iteration: int) -> int:
        """Degree of the spherical harmonics in use: grows by one every ``sh_every``."""
        step = max(1, round(self.sh_every * self.iterations))
        return min(self.sh_degree, iteration // step)

    def divisor(self, iteration: int) -> int:
        """Divisor of the image width at ``iteration``."""
        fraction = iteration / self.iterations
        for until, divisor in self.coarse:
            if fraction < until:
                return divisor
        return self.scales[iteration % len(self.scales)]


def _check_range(options: TrainOptions, name: str, low: float, high: float) -> None:
    value = getattr(options, name)
    if not low <= value <= high:
        raise ReconstructError(f"{name} must be from {low} to {high}, not {value!r}")


PRESETS: dict[str, TrainOptions] = {
    "cpu-small": TrainOptions(
        iterations=4000,
        max_width=640,
        coarse=((0.25, 2),),
        mirror=0.1,
        sky_resolution=128,
        image_bytes=512 << 20,
        checkpoint_every=500,
        preview_every=500,
        initialise=InitialiseOptions(
            max_background=120_000,
            max_object=6_000,
            voxel=0.1,
            ground_spacing=0.12,
            object_voxel=0.05,
            sky_resolution=128,
        ),
        # The default rates are for 30,000 iterations; fewer steps have to be larger. Rotations do
        # not: surfaces of vehicles would turn towards the few directions that see them.
        learning_rates=LearningRates(
            means=(3.2e-3, 1.6e-4), scales=0.02, colour=0.01, fourier=5e-3
        ),
        densify=DensifyOptions(max_gaussians=300_000, every=100, stop=0.7, reset_every=0),
    ),
    "standard": TrainOptions(
        iterations=30_000,
        sh_degree=3,
        coarse=((0.01, 4), (0.02, 2)),
        initialise=InitialiseOptions(max_background=800_000, voxel=0.1),
        learning_rates=LearningRates(exposure=1e-3),
        losses=LossWeights(object_entropy=0.1),
        densify=DensifyOptions(max_gaussians=3_000_000),
    ),
    "paper": TrainOptions(
        iterations=50_000,
        sh_degree=1,
        harmonics=4,
        harmonics_basis="real_dft",
        mirror=0.5,
        initial_opacity=0.1,
        sky_resolution=1024,
        initialise=InitialiseOptions(max_background=800_000, voxel=0.15, max_object=20_000),
        losses=LossWeights(object_entropy=0.1, depth=0.0, box=0.0, needle=0.0),
        densify=DensifyOptions(max_gaussians=6_000_000),
    ),
}


def at_width(options: TrainOptions, width: int) -> TrainOptions:
    """``options`` for images of ``width`` [px], coarse to fine if they are wider than the preset's.

    Earlier stages keep their image widths, so most steps cost the same. In the last stage, one
    image at full size alternates with two downscaled images, so that smaller images do not become
    too sharp.
    """
    part = -(-width // options.max_width)
    if part > 1:
        stages = tuple((until, divisor * part) for until, divisor in options.coarse)
        options = replace(options, coarse=(*stages, (FINE_START, part)), scales=(1, part, part))
    return replace(options, width=width, max_width=width)


def preset(name: str, **changes: Any) -> TrainOptions:
    """The preset of that name with some values changed.

    Raises:
        ReconstructError: the name is unknown; the message lists the presets.
    """
    if name not in PRESETS:
        raise ReconstructError(f"preset must be one of {list(PRESETS)}, not {name!r}")
    return replace(PRESETS[name], **changes)


def exponential_decay(span: tuple[float, float], fraction: float) -> float:
    """Interpolate between the values of ``span`` for ``fraction`` from 0 to 1."""
    first, last = span
    return float(first * (last / first) ** min(max(fraction, 0.0), 1.0)) if first > 0 else 0.0


def learning_rates_at(
    options: TrainOptions, fraction: float, *, functions: int
) -> dict[str, float | Tensor]:
    """Learning rates by parameter name after ``fraction`` of the iterations.

    Args:
        functions: number of spherical harmonics, which have different rates.
    """
    rates = options.learning_rates
    columns = torch.full((functions, 3), rates.colour * HIGHER_HARMONICS_RATE)
    columns[0] = rates.colour
    poses_move = float(options.refine_poses and fraction >= options.pose_start)
    return {
        "means": exponential_decay(rates.means, fraction),
        "log_scales": rates.scales,
        "quats": rates.quats,
        "logits": rates.opacities,
        "sh": columns.reshape(-1),
        "fourier": rates.fourier,
        "sky": exponential_decay(rates.sky, fraction),
        "pose_translation": poses_move * exponential_decay(rates.pose_translation, fraction),
        "pose_yaw": poses_move * exponential_decay(rates.pose_yaw, fraction),
        "pose_tilt": poses_move * exponential_decay(rates.pose_tilt, fraction),
        "exposure": rates.exposure,
        "image_exposure": rates.image_exposure,
        "camera": rates.camera,
    }


def from_values(kind: type, values: dict[str, Any]) -> Any:
    """The frozen dataclass ``kind`` from ``dataclasses.asdict`` as read back from JSON."""
    given = {}
    for item in fields(kind):
        default = getattr(kind(), item.name)
        if item.name not in values:
            # Missing in runs of earlier releases.
            continue
        value = values[item.name]
        if is_dataclass(default):
            value = from_values(type(default), value)
        elif isinstance(value, list):
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
        given[item.name] = value
    return kind(**given)
