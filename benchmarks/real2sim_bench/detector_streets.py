"""Edited streets for a detector: exported from a reconstruction, and ray-cast from the truth.

Both have the same vehicles, poses and cameras, frame by frame. They differ in the source of images
and boxes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from real2sim_proto.jobs import DatasetSweep
from real2sim_server.console import CommandError
from real2sim_server.datasets.clips import Clip
from real2sim_server.datasets.labels.views import without_blobs
from real2sim_server.datasets.perturbed import Perturbation
from real2sim_server.datasets.plan import ExportPlan, Variant, swept
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import box_penetration
from real2sim_server.scene import Camera, Scene
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log

from .detector_model import TrainingImages, TrueBoxes

REMOVED, ADDED, MOVED = 3, 4, 5
"""Number of vehicles per sweep to delete, duplicate and move."""
COPY = "__"
"""Separator between a vehicle id and the number of its copy."""
DRAWS = 10
"""Drives per sweep."""
PERIOD_US = 530_000
PERTURBATION = Perturbation(lateral_sigma=0.4, heading_sigma=0.06, recover_s=4.0)
TRIES = 50
CLEAR = 0.5
"""Minimum distance of copies from other objects [m]."""
EGO_CENTRE, EGO_ROOM = np.eye(4), (16.0, 3.5, 4.0)
"""Box around the rear axle of the ego that copies must not enter [m]."""
MIN_PIXELS, MIN_SIDE = 40, 6.0
"""Minimum visible pixels and box side of an object that counts, in pixels of the final image."""
FORMATS = ("coco", "labels")
FINER = 2
"""Supersampling factor. Images are rendered finer and averaged, so that pixels integrate light like
those of a camera, and boxes have subpixel edges."""


@dataclass(frozen=True)
class EditedStreets:
    """Sweeps over a scene with DRAWS drives each; called in every worker of an export.

    Attributes:
        scene: scene to edit.
        sweeps: parameters and edits of each sweep.
        seed: seed of the draws.
    """

    scene: Scene
    sweeps: tuple[DatasetSweep, ...]
    seed: int

    @classmethod
    def of(cls, scene: Scene, sweeps: int, seed: int) -> EditedStreets:
        """Create ``sweeps`` random sweeps."""
        return cls(scene, tuple(edits_of(scene, number, seed) for number in range(sweeps)), seed)

    def __call__(self) -> list[Variant]:
        """Return the drives of all sweeps."""
        state = ScenarioState.of(self.scene)
        return [
            variant
            for number, sweep in enumerate(self.sweeps)
            for variant in swept(self.scene, state, sweep, self.seed + number)
        ]


def true_log(scene: Scene) -> SyntheticLog:
    """The synthetic drive that a scene was reconstructed from.

    Raises:
        CommandError: the drive is not synthetic, so there is no ground truth.
    """
    config = scene.provenance.get("config") if scene.objects else None
    if scene.provenance.get("reader") != "synthetic" or config is None:
        raise CommandError(
            f"scene {scene.name!r} was not reconstructed from a synthetic drive with vehicles; "
            "take one that was, such as the demo's street"
        )
    return generate_log(SyntheticConfig.from_values(config))


def edits_of(scene: Scene, number: int, seed: int) -> DatasetSweep:
    """Sweep ``number``: deletes, duplicates and moves vehicles; moves differ between drives."""
    rng = np.random.default_rng([seed, number])
    names = rng.permutation(sorted(scene.objects)).tolist()
    removed = min(REMOVED, len(names) // 4)
    gone, stay = names[:removed], names[removed:]
    edits: list[dict[str, Any]] = [{"op": "delete", "object_id": name} for name in gone]
    edits += _doubles(scene, stay, rng)
    parameters: dict[str, Any] = {}
    for k, name in enumerate(stay[:MOVED]):
        parameters |= {
            f"along_{k}": {"uniform": (-1.5, 1.5)},
            f"aside_{k}": {"uniform": (-0.3, 0.3)},
            f"turn_{k}": {"normal": (0.0, 0.08)},
        }
        place = {"x": f"$along_{k}", "y": f"$aside_{k}", "frame": "object"}
        edits.append({"op": "translate", "object_id": name, **place})
        edits.append({"op": "rotate", "object_id": name, "angle": f"$turn_{k}"})
    content = {"parameters": parameters, "draws": DRAWS, "operations": edits}
    return DatasetSweep.model_validate(content)


def _doubles(scene: Scene, names: Sequence[str], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Edits that duplicate vehicles, in free space ahead of or behind the original."""
    times = np.linspace(scene.start_us, scene.end_us, 25).astype(int).tolist()
    found: list[dict[str, Any]] = []
    state = ScenarioState.of(scene)
    for _ in range(TRIES):
        name = names[int(rng.integers(len(names)))]
        away = float(rng.choice([-1, 1]) * rng.uniform(6.0, 16.0))
        if len(found) < ADDED and _is_free(scene, state, name, away, times):
            copy = f"{name}{COPY}{len(found)}"
            edit = {"op": "duplicate", "object_id": name, "new_id": copy, "frame": "object"}
            found.append({**edit, "x": away, "snap": True})
    return found


def _is_free(
    scene: Scene, state: ScenarioState, name: str, away: float, times_us: Sequence[int]
) -> bool:
    ego = scene.ego
    for t_us in times_us:
        placed = state.tracks.at(t_us)
        own = [k for k, subject in enumerate(placed.objects) if subject.object_id == name]
        if not own:
            return False
        shift = np.eye(4)
        shift[0, 3] = away
        pose, size = placed.transforms[own[0]] @ shift, placed.sizes[own[0]] + CLEAR
        others = np.concatenate([placed.transforms, ego.transform(t_us)[None] @ EGO_CENTRE])
        sizes = np.concatenate([placed.sizes, [EGO_ROOM]])
        if (box_penetration(pose, size, others, sizes) > 0).any():
            return False
    return True


def export_plan(camera: str, width: int, seed: int) -> ExportPlan:
    """Export plan with about 20 frames per drive, from perturbed paths, at the image width."""
    return ExportPlan(
        formats=FORMATS,
        cameras=(camera,),
        width=width * FINER,
        period_us=PERIOD_US,
        clip_s=4 * PERIOD_US * 1e-6,
        seed=seed,
        flow=False,
        perturb=PERTURBATION,
    )


def exported_pictures(folder: Path) -> TrainingImages:
    """Images and boxes of an export, read from its COCO files."""
    images, boxes = [], []
    content = json.loads((folder / "coco/annotations/instances_train.json").read_bytes())
    own: dict[int, list[list[float]]] = {}
    for note in content["annotations"]:
        left, top, width, height = note["bbox"]
        if _counts(note["area"], width, height):
            row = [left, top, left + width, top + height]
            own.setdefault(note["image_id"], []).append(row)
    for image in content["images"]:
        images.append(_averaged(_read(folder / "coco/train" / image["file_name"])))
        boxes.append(np.array(own.get(image["id"], []), np.float64).reshape(-1, 4) / FINER)
    return TrainingImages(np.stack(images), boxes)


def cast_pictures(
    log: SyntheticLog,
    folder: Path,
    camera: Camera,
    on_progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> TrainingImages:
    """Ray-cast the frames of an export from the true street, in the same order.

    Args:
        log: synthetic drive of the street.
        folder: folder of the export.
        camera: camera with the resolution of the export.
        on_progress: callback with (frames done, total).
    """
    numbers = {track.object_id: k for k, track in enumerate(log.tracks)}
    frames = [frame for clip in _clips(folder) for frame in clip.frames]
    images, boxes = [], []
    for done, frame in enumerate(frames, start=1):
        objects = frame["objects"]
        rgb, _, instance = log.render_placed(
            camera.pose(np.array(frame["T_world_ego"])),
            camera.K,
            (camera.width, camera.height),
            [numbers[subject["object_id"].partition(COPY)[0]] for subject in objects],
            np.array([subject["T_world_object"] for subject in objects]).reshape(-1, 4, 4),
        )
        images.append(_averaged(rgb))
        truth = boxes_in(instance)
        boxes.append(truth.boxes[truth.counts])
        on_progress(done, len(frames))
    return TrainingImages(np.stack(images), boxes)


def withheld_drive(
    config: SyntheticConfig, camera: str, width: int, period_us: int
) -> tuple[NDArray[np.uint8], list[TrueBoxes]]:
    """Ray-cast images [N, H, W, 3] of an unedited synthetic drive, and the objects in each."""
    log = generate_log(config)
    lens = log.rig[camera].resized(width * FINER)
    images, boxes = [], []
    for t_us in range(int(log.frame_times_us[0]), int(log.frame_times_us[-1]) + 1, period_us):
        pose = lens.pose(log.ego.transform(t_us))
        rgb, _, instance = log.render(pose, lens.K, lens.width, lens.height, t_us)
        images.append(_averaged(rgb))
        boxes.append(boxes_in(instance))
    return np.stack(images), boxes


def boxes_in(instance: NDArray[np.uint16]) -> TrueBoxes:
    """Boxes of the objects in a supersampled instance image [px of the final image], and a mask of
    those that count."""
    boxes, counts = [], []
    for number in np.unique(instance).tolist():
        mask = without_blobs(instance == number)
        if number and mask.any():
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
            boxes.append([left, top, right, bottom])
            counts.append(_counts(int(mask.sum()), float(right - left), float(bottom - top)))
    found = np.array(boxes, np.float64).reshape(-1, 4) / FINER
    return TrueBoxes(found, np.array(counts, np.bool_))


def _counts(pixels: int, width: float, height: float) -> bool:
    """Whether an object counts; all arguments are in pixels of the supersampled image."""
    return pixels >= MIN_PIXELS * FINER**2 and min(width, height) >= MIN_SIDE * FINER


def _averaged(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    size = (width // FINER, height // FINER)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _clips(folder: Path) -> list[Clip]:
    content: Mapping[str, Any] = json.loads((folder / "labels/dataset.json").read_bytes())
    return [Clip.open(folder / "labels" / name) for name in content["clips"]]


def _read(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(path)
    return np.ascontiguousarray(image[..., ::-1])
