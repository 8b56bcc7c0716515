"""Examples for a policy from labelled data sets: images with the plan that is their label.

``real2sim export-dataset --format labels`` writes them, with ``--perturb`` also beside the path.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.planners.learned import REACH, PolicyShape, shrink, state_of

from ..console import CommandError
from ..datasets.clips import Clip
from ..datasets.labels.futures import STEP_US
from .cloning import HOLD_OUT_EVERY, CloningDataset

TRAIN = "train"
LAYOUT = "labels"
"""Name of the format that is read, and of its folder in an export."""


def is_export(folder: Path) -> bool:
    """Whether a folder is a labelled data set."""
    return (folder / "manifest.json").is_file()


def exported_shape(folder: Path, camera: str | None) -> PolicyShape:
    """The shape of a policy that sees ``camera`` of an export, by default the one that looks most
    nearly ahead.

    Raises:
        CommandError: there is no such camera, or the export was written in other formats only.
    """
    found = _content(folder)["cameras"]
    cameras = {one["name"]: np.array(one["T_vehicle_camera"]) for one in found}
    if camera is not None and camera not in cameras:
        raise CommandError(f"no camera {camera!r} in {folder}; there are {', '.join(cameras)}")
    ahead = max(cameras, key=lambda name: cameras[name][0, 2])
    return PolicyShape(camera=camera or ahead, spacing=STEP_US * 1e-6)


def exported_examples(
    folders: Sequence[Path],
    shape: PolicyShape,
    *,
    on_progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> CloningDataset:
    """All frames of exports whose drive goes on for as long as a plan; ``ego_future`` is the plan.

    Held out are the clips of other splits than ``train``; where there are none, every fifth frame
    of each clip.

    Args:
        folders: exports with the format ``labels``.
        shape: of :func:`exported_shape`.
        on_progress: called with (clips read, all).

    Raises:
        CommandError: an export without labels or camera, or too few frames.
    """
    clips = [clip for folder in folders for clip in _clips(folder, shape)]
    splits = any(clip.split != TRAIN for clip in clips)
    inputs, states, poses, held_out = [], [], [], []
    for done, clip in enumerate(clips, start=1):
        for frame in clip.frames:
            plan = frame["ego_future"][: shape.poses]
            if len(plan) < shape.poses:
                continue
            rgb = clip.pixels("rgb", shape.camera, frame["index"])
            inputs.append(shrink(rgb, shape.width, shape.height))
            states.append(state_of(frame["ego"]["speed"], frame["ego"]["command"]))
            poses.append(np.array(plan)[:, 1:] / [REACH, REACH, 1.0])
            turn = frame["index"] % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
            held_out.append(clip.split != TRAIN if splits else turn)
        on_progress(done, len(clips))
    if len(inputs) < 2 * HOLD_OUT_EVERY:
        raise CommandError(
            f"{len(inputs)} frames have {shape.poses * shape.spacing:g} s of driving after them; "
            f"{2 * HOLD_OUT_EVERY} are needed"
        )
    return CloningDataset(
        np.stack(inputs), np.stack(states), np.stack(poses).astype(np.float32), np.array(held_out)
    )


def _clips(folder: Path, shape: PolicyShape) -> list[Clip]:
    content = _content(folder)
    names = [one["name"] for one in content["cameras"]]
    if shape.camera not in names:
        raise CommandError(f"no camera {shape.camera!r} in {folder}; there are {', '.join(names)}")
    return [Clip.open(folder / LAYOUT / name) for name in content["clips"]]


def _content(folder: Path) -> dict[str, Any]:
    file = folder / LAYOUT / "dataset.json"
    if not file.is_file():
        raise CommandError(f"{folder} holds no labels; export it with --format {LAYOUT}")
    content: dict[str, Any] = json.loads(file.read_bytes())
    return content
