"""The labels as they are, in the project's own layout: all of them, and exact."""

from __future__ import annotations

import shutil
from pathlib import Path

from .writer import LabelledDrive, write_json


class LabelsWriter:
    """Writes each clip as a folder: ``labels.json``, images and points."""

    name = "labels"
    holds = "all labels as JSON, images as png, points as npy; docs/datasets.md has the fields"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`."""
        for clip in drive.clips:
            shutil.copytree(clip.folder, folder / clip.name)
        cameras = [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "T_vehicle_camera": camera.T_vehicle_camera.tolist(),
            }
            for camera in drive.cameras
        ]
        content = {
            "name": drive.name,
            "period_us": drive.period_us,
            "ego_size": list(drive.ego_size),
            "cameras": cameras,
            "clips": {clip.name: clip.split for clip in drive.clips},
        }
        write_json(folder / "dataset.json", content)
