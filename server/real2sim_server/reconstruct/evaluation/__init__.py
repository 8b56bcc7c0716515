"""Evaluation of a scene against its log: images, moving objects, depth, and frame rate."""

from .images import PSNR_CAP, mean_psnr, psnr, ssim
from .lidar import CoverageReport, CoverageScore, evaluate_views, lidar_mask
from .rendering import render_logged_view
from .report import write_report
from .scores import EvaluateOptions, Evaluation, evaluate_scene

__all__ = [
    "PSNR_CAP",
    "CoverageReport",
    "CoverageScore",
    "EvaluateOptions",
    "Evaluation",
    "evaluate_scene",
    "evaluate_views",
    "lidar_mask",
    "mean_psnr",
    "psnr",
    "render_logged_view",
    "ssim",
    "write_report",
]
