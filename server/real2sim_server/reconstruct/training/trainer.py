"""The training loop, with one image per step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...logs import DrivingLog
from ...render.backend import Backend
from ...scene import Scene
from ...scene.cloud import SH_C0
from ..initialise.vehicle_body import scene_bodies
from ..logged_view import image_time, objects_mask
from ..options import ReconstructError
from . import losses
from .closed_vehicles import close_followed, offer_bodies
from .data import TrainingView, TrainingViews, held_out_frames
from .densify import STRATEGIES, ScreenSums, SelectiveAdam, TrainingStep, step_generator
from .gaussians import FIELDS, OBJECT_FIELDS, Gaussians
from .model import RenderedView, SceneModel
from .records import (
    Checkpoint,
    MetricsFile,
    OnTraining,
    RateMeter,
    RunningMeans,
    StepTimer,
    TrainingProgress,
    read_checkpoint,
    write_checkpoint,
)
from .schedule import TrainOptions, from_values, learning_rates_at
from .visibility import (
    OcclusionPruning,
    paint_unseen_sides,
    plain_lobes,
    unseen_sides,
    viewing_directions,
)

CONSTANT_SH = (-0.55 / SH_C0, 0.55 / SH_C0)
"""Range of the constant coefficients: colours from -0.05 to 1.05."""
CHECKPOINT = "checkpoint"


class Trainer:
    """Trains one scene on one log. The same arguments give the same bits on the CPU.

    Args:
        log: the drive, all frames.
        scene: scene of stage 0, built without the held-out frames.
        options: options of training.
        folder: folder of checkpoints and metrics; None writes nothing.
        backend: backend of the renderer.
    """

    def __init__(
        self,
        log: DrivingLog,
        scene: Scene,
        options: TrainOptions,
        *,
        folder: Path | None = None,
        backend: str | Backend = "auto",
    ) -> None:
        self.log, self.options, self.folder = log, options, folder
        held_out = set(held_out_frames(log.frame_count, options.hold_out))
        frames = [f for f in range(log.frame_count) if f not in held_out]
        keys = {image_time(log, name, f) for f in frames for name in log.rig.names}
        key_times = np.array(sorted(keys), dtype=np.int64)
        self.model = SceneModel(scene, options, key_times, backend=backend)
        self.views = TrainingViews(log, frames, options, device=self.model.device)
        self.optimizer = SelectiveAdam(self.model.parameters())
        self.strategy = STRATEGIES[options.densify.method](
            options.densify,
            self.model.half_sizes,
            seed=options.seed,
            iterations=options.iterations,
        )
        self.strategy.initialize_state(len(self.model.gaussians))
        bodies = scene_bodies(scene)
        self.occlusion_pruning = OcclusionPruning(
            options.densify,
            options.iterations,
            self.views.sample_viewpoints,
            unseen=partial(unseen_sides, bodies=bodies) if options.directions.sides else None,
            close=partial(close_followed, bodies=bodies) if options.directions.close else None,
            offer=partial(offer_bodies, bodies=bodies) if options.directions.close else None,
        )
        self.iteration = 0
        self.running = RunningMeans()
        self.metrics = MetricsFile(folder / "metrics.jsonl") if folder else None

    def run(
        self,
        *,
        on_progress: OnTraining | None = None,
        on_preview: Callable[[SceneModel, int], None] | None = None,
        until: int | None = None,
    ) -> None:
        """Run all remaining steps, or those before ``until``.

        Raises:
            LogError: an image or sweep cannot be read.
            ReconstructError: the loss is no longer finite.
        """
        options = self.options
        last = options.iterations if until is None else min(until, options.iterations)
        clock = RateMeter(self.iteration)
        while self.iteration < last:
            terms = self.step()
            done = self.iteration
            if done % options.log_every == 0 or done == options.iterations:
                self._report(terms, clock, on_progress)
            if _is_due(done, options.preview_every) and on_preview is not None:
                on_preview(self.model, done)
            if _is_due(done, options.checkpoint_every) or done == options.iterations:
                self.save()

    def step(self) -> dict[str, float]:
        """Run one iteration; returns the terms of its loss."""
        i = self.iteration
        timed = StepTimer(self.running.stages)
        with timed("data"):
            view = self.views.view(self.views.index_at(i), self.options.divisor(i))
            self.views.prefetch(i)
        with timed("forward"):
            rendered = self.model.render(
                view.camera,
                view.t_us,
                degree=self.options.active_degree(i),
                mirrored=self._flips(i),
                depth=len(view.pixels) > 0,
            )
        with timed("loss"):
            terms, squared = self._loss_terms(view, rendered)
            total = torch.stack(list(terms.values())).sum()
        loss, squared_error, *values = _on_host(total, squared, *terms.values())
        if not math.isfinite(loss):
            raise ReconstructError(f"the loss is {loss} at iteration {i}; lower the learning rates")
        self.strategy.step_pre_backward(rendered.output)
        with timed("backward"):
            torch.autograd.backward(total)
        with timed("optimiser"):
            taken = self._update(rendered)
        with timed("densify"):
            self._densify(taken)
        self.running.add(loss, squared_error)
        self.iteration += 1
        return dict(zip(terms, values, strict=True))

    def _flips(self, i: int) -> tuple[bool, ...]:
        """Vehicles that are mirrored in this step."""
        vehicles = self.model.mirrored
        if not any(vehicles):
            return ()
        drawn = step_generator(self.options.seed + 1, i).random(len(vehicles))
        return tuple(
            bool(m and d < self.options.mirror) for m, d in zip(vehicles, drawn, strict=True)
        )

    def _loss_terms(
        self, view: TrainingView, rendered: RenderedView
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Weighted terms of the loss, and the mean squared error of the image."""
        weights, output = self.options.losses, rendered.output
        picture, _, _, squared = losses.photometric(
            rendered.rgb, view.image, ssim_weight=weights.ssim
        )
        terms = {"picture": picture}
        if weights.depth > 0 and len(view.pixels) and output.depth is not None:
            term = losses.lidar_depth(output.depth[0], view.pixels, view.depths)
            terms["depth"] = weights.depth * term
        if weights.sky > 0 and view.sky is not None:
            terms["sky"] = weights.sky * losses.sky_opacity(output.alpha[0], view.sky)
        if self.iteration % self.options.regularise_every == 0:
            # Evaluated rarely, with the weight scaled by the interval.
            for name, term in self._regularisers(view).items():
                terms[name] = term * self.options.regularise_every
        if weights.opacity > 0:
            terms["opacity"] = weights.opacity * self.model.gaussians.logits.sigmoid().mean()
        if weights.scale > 0:
            terms["scale"] = weights.scale * self.model.gaussians.log_scales.exp().mean()
        return terms, squared

    def _regularisers(self, view: TrainingView) -> dict[str, Tensor]:
        weights, model = self.options.losses, self.model
        gaussians, objects = model.gaussians, len(model.gaussians.counts) > 1
        terms = {}
        if weights.needle > 0:
            terms["needle"] = weights.needle * losses.needles(
                gaussians.log_scales, weights.needle_ratio
            )
        if weights.box > 0 and objects:
            means = gaussians.means[gaussians.counts[0] :]
            counts = torch.tensor(gaussians.counts[1:], device=means.device)
            half = torch.repeat_interleave(model.half_sizes, counts, dim=0, output_size=len(means))
            terms["box"] = weights.box * losses.outside_box(means, half)
        if weights.smooth > 0 and objects and self.options.refine_poses:
            terms["smooth"] = weights.smooth * model.poses.roughness()
        if weights.box_pose > 0 and objects and self.options.refine_poses:
            terms["box_pose"] = weights.box_pose * model.poses.squares()
        if weights.exposure > 0 and self.options.learning_rates.exposure > 0:
            change = model.exposure - torch.eye(3, 4, device=model.device)
            terms["exposure"] = weights.exposure * change.square().sum()
        if weights.exposure > 0 and self.options.learning_rates.image_exposure > 0:
            terms["image_exposure"] = weights.exposure * model.gains.squares()
        late = self.iteration >= self.options.densify.stop * self.options.iterations
        if weights.object_entropy > 0 and objects and late:
            inside = torch.from_numpy(objects_mask(model.scene, view.camera, view.t_us))
            alpha = model.objects_alpha(view.camera, view.t_us)
            inside = inside.to(alpha.device)
            entropy = losses.object_accumulation(alpha, inside)
            terms["object_entropy"] = weights.object_entropy * entropy
        return terms

    @torch.no_grad()
    def _update(self, rendered: RenderedView) -> TrainingStep:
        """Update the parameters of visible Gaussians along their gradients."""
        gaussians, parameters = self.model.gaussians, self.model.parameters()
        rows = self._rows(rendered.drawn)
        assert rendered.output.screen is not None
        screen = rendered.output.screen.first(len(rows))
        visible = torch.zeros(len(gaussians), dtype=torch.bool, device=self.model.device)
        for part, radii in zip(rows, screen.radii, strict=True):
            visible[part] = (radii > 0).any(0)
        masks = {name: visible for name in FIELDS if name not in OBJECT_FIELDS}
        masks |= dict.fromkeys(OBJECT_FIELDS, visible[gaussians.counts[0] :])
        for name in (
            "pose_translation",
            "pose_yaw",
            "pose_tilt",
            "exposure",
            "image_exposure",
            "camera",
        ):
            gradient = parameters[name].grad
            if gradient is not None:
                masks[name] = gradient.reshape(len(gradient), -1).any(1)
        fraction = self.iteration / self.options.iterations
        rates = learning_rates_at(self.options, fraction, functions=int(gaussians.sh.shape[1]))
        self.optimizer.step(parameters, rates, masks)
        # A colour outside the gamut would compensate for a Gaussian in front of it, and become
        # visible without that Gaussian.
        gaussians.sh[:, 0].clamp_(*CONSTANT_SH)
        # Sky colours beyond white cannot be stored.
        self.model.sky.clamp_(0, 1)
        for parameter in parameters.values():
            parameter.grad = None
        return TrainingStep(self.iteration, rows, screen, float(rates["means"]))

    def _rows(self, drawn: tuple[int, ...]) -> list[slice]:
        starts = self.model.gaussians.starts
        return [slice(starts[k], starts[k + 1]) for k in drawn]

    def _densify(self, step: TrainingStep) -> None:
        """Add, remove and reset Gaussians if a round is due."""
        model, strategy, optimizer = self.model, self.strategy, self.optimizer
        model.gaussians = strategy.step_post_backward(model.gaussians, optimizer, step)
        if self.occlusion_pruning.step(model, optimizer, step.iteration):
            strategy.initialize_state(len(model.gaussians))
        strategy.step_end(model.gaussians, optimizer, step.iteration)
        self._settle_colours(step.iteration + 1)

    def _settle_colours(self, done: int) -> None:
        """After the last step: fix objects' colours in directions without views."""
        options = self.options.directions
        if done != self.options.iterations or not self.model.scene.objects:
            return
        viewpoints = self.views.sample_viewpoints(options.views)
        if options.lobe_prior > 0:
            seen = viewing_directions(self.model, viewpoints, objects_only=True)
            plain_lobes(self.model, seen, prior=options.lobe_prior)
        if options.paint:
            paint_unseen_sides(self.model, viewpoints, scene_bodies(self.model.scene))

    def _report(
        self, terms: dict[str, float], clock: RateMeter, on_progress: OnTraining | None
    ) -> None:
        rate = clock.rate(self.iteration)
        progress = TrainingProgress(
            iteration=self.iteration,
            iterations=self.options.iterations,
            rate=rate,
            loss=self.running.mean_loss,
            psnr=self.running.psnr,
            gaussians=len(self.model.gaussians),
            eta_s=(self.options.iterations - self.iteration) / rate,
        )
        if self.metrics is not None:
            self.metrics.write({**asdict(progress), "terms": terms})
        if on_progress is not None:
            on_progress(progress)

    def save(self) -> None:
        """Write a checkpoint if there is a folder."""
        if self.folder is None:
            return
        tensors = {f"model.{k}": v for k, v in self.model.parameters().items()}
        priors = self.model.priors
        if priors is not None:
            tensors |= {f"priors.{k}": v for k, v in priors.tensors().items()}
        tensors |= {f"adam.{k}": v for k, v in self.optimizer.state().items()}
        state = self.strategy.state
        tensors |= {"sums.gradients": state.gradients, "sums.views": state.views}
        running = self.running
        checkpoint = Checkpoint(
            iteration=self.iteration,
            counts=self.model.gaussians.counts,
            prior_counts=() if priors is None else priors.counts,
            optimizer_steps=self.optimizer.steps,
            options=asdict(self.options),
            log_name=self.log.name,
            running={"loss": running.loss, "squared": running.squared, "weight": running.weight},
            tensors=tensors,
        )
        write_checkpoint(checkpoint, self.folder / CHECKPOINT)

    def resume(self) -> None:
        """Restore the last checkpoint in the folder.

        Raises:
            ReconstructError: the checkpoint is missing, or belongs to another log or other options.
        """
        if self.folder is None:
            raise ReconstructError("a run without a folder leaves no checkpoint to resume")
        held = read_checkpoint(self.folder / CHECKPOINT)
        if held.log_name != self.log.name:
            raise ReconstructError(
                f"{self.folder}: trains on log {held.log_name!r}, not {self.log.name!r}"
            )
        if from_values(TrainOptions, held.options) != self.options:
            raise ReconstructError(
                f"{self.folder}: has other options; resume with the same options or start a new run"
            )
        parts: dict[str, dict[str, Tensor]] = {"model": {}, "priors": {}, "adam": {}, "sums": {}}
        for name, tensor in held.tensors.items():
            group, key = name.split(".", 1)
            parts[group][key] = tensor.to(self.model.device)
        self.model.load(parts["model"], held.counts)
        if held.prior_counts:
            self.model.priors = Gaussians(**parts["priors"], counts=held.prior_counts)
            if self.options.directions.close:
                self.model.stop_mirroring()
        self.optimizer.restore(parts["adam"], held.optimizer_steps)
        self.strategy.state = ScreenSums(**parts["sums"])
        self.iteration = held.iteration
        self.running = RunningMeans(
            loss=held.running["loss"],
            squared=held.running["squared"],
            weight=held.running["weight"],
        )
        if self.metrics is not None:
            self.metrics.cut(held.iteration)


def _on_host(*values: Tensor) -> list[float]:
    """All values in one copy, so that a step synchronises with its device only once."""
    numbers: list[float] = torch.stack([v.detach().double() for v in values]).tolist()
    return numbers


def _is_due(done: int, every: int) -> bool:
    return every > 0 and done % every == 0
