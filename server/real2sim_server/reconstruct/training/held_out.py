"""How well the model shows images it never saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...logs import DrivingLog
from ..logged_view import objects_mask
from . import losses
from .data import TrainingViews, held_out_frames
from .model import SceneModel
from .schedule import TrainOptions

MIN_PIXELS = 50
"""Views in which moving objects cover fewer pixels do not count for them."""


@dataclass(frozen=True)
class HeldOutScore:
    """Means over held-out views; nan where there are none.

    Attributes:
        psnr: over all pixels [dB].
        ssim: mean structural similarity.
        psnr_objects: over the projected boxes of moving objects [dB].
        views: how many.
    """

    psnr: float
    ssim: float
    psnr_objects: float
    views: int


@torch.no_grad()
def score_held_out(
    model: SceneModel, log: DrivingLog, options: TrainOptions, *, limit: int | None = None
) -> HeldOutScore:
    """Compare the held-out images of ``log`` with what ``model`` shows.

    Args:
        limit: at most so many frames, evenly spread; all by default.

    Raises:
        LogError: an image cannot be read.
    """
    frames = held_out_frames(log.frame_count, options.hold_out)
    if limit is not None and len(frames) > limit:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, limit).round().astype(int)]
    if not frames:
        return HeldOutScore(float("nan"), float("nan"), float("nan"), 0)
    views = TrainingViews(log, frames, options, device=model.device)
    moving = [k for k, o in model.scene.objects.items() if o.trajectory.moves]
    scores = []
    for index in range(len(views)):
        view = views.view(index)
        image = model.render(view.camera, view.t_us).rgb.clamp(0, 1)
        inside = objects_mask(model.scene, view.camera, view.t_us, only=moving)
        mask = torch.from_numpy(inside).to(image.device)
        scores.append(_score(image, view.image, mask))
    views.close()
    psnr, ssim, psnr_objects = np.array(scores).T
    known = psnr_objects[~np.isnan(psnr_objects)]
    return HeldOutScore(
        psnr=float(psnr.mean()),
        ssim=float(ssim.mean()),
        psnr_objects=float(known.mean()) if len(known) else float("nan"),
        views=len(views),
    )


def _score(image: Tensor, truth: Tensor, mask: Tensor) -> tuple[float, float, float]:
    squared = (image - truth).square().mean(-1)
    on_objects = float("nan")
    if int(mask.sum()) >= MIN_PIXELS:
        on_objects = losses.psnr_of(float(squared[mask].mean()))
    return losses.psnr_of(float(squared.mean())), losses.ssim(image, truth), on_objects
