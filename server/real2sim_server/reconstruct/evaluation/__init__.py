"""How close a scene comes to its log: images, moving objects, depth, and how fast it is drawn."""

from .image_metrics import PSNR_CAP, mean_psnr, psnr, ssim
from .logged_views import (
    EvaluationReport,
    ViewScore,
    evaluate_views,
    lidar_mask,
    render_logged_view,
)
from .report import write_report
from .scores import EvaluateOptions, Evaluation, evaluate_scene

__all__ = [
    "PSNR_CAP",
    "EvaluateOptions",
    "Evaluation",
    "EvaluationReport",
    "ViewScore",
    "evaluate_scene",
    "evaluate_views",
    "lidar_mask",
    "mean_psnr",
    "psnr",
    "render_logged_view",
    "ssim",
    "write_report",
]
