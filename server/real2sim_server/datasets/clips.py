"""Labelled clips as files: the input of writers, preserved when an export is killed.

A clip is a folder that is created atomically: ``labels.json``, and for each camera and frame images
as png: ``rgb``, ``depth`` (1/256 m), ``instance``, ``semantic``, ``flow_forward`` and
``flow_backward`` (KITTI: u and v times 64 plus 2^15, and a validity flag), ``occluded_forward`` and
``occluded_backward``; ``points/NNNNNN.npy`` has the points of a frame.
"""

from __future__ import annotations

import io
import json
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from functools import partial as partial_of
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, Self, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from .._files import unpack_tar
from ..executors import Executor, ExecutorError
from ..geometry import Float, invert_transform
from ..render import Backend, encode_image
from ..render.cast import CastBackend, select_caster
from ..scene import Camera
from ..world.path import LoggedPath
from .drive import DatasetError, Drive, Moment
from .labels import (
    CameraImages,
    CameraView,
    ObjectBox,
    SeenPoints,
    boxes_at,
    draw_moment,
    ego_future,
    ego_state,
    flow_between,
    futures_at,
    lidar_points,
    points_in_boxes,
    seen_points,
    views_of,
)
from .labels.boxes import in_frame, noisy_boxes
from .labels.views import ObjectView, keypoints_at, keypoints_in_image
from .perturbed import PerturbedDrive, perturbed
from .plan import ExportPlan, PlannedClip, Variant, planned_cameras, planned_lidar

POINT = np.dtype(
    [
        ("xyz", "<f4", 3),
        ("intensity", "<f4"),
        ("beam", "u1"),
        ("instance", "<u2"),
        ("semantic", "u1"),
        ("velocity", "<f4", 3),
        ("time_us", "<i4"),
        ("return_number", "u1"),
    ]
)
"""A row of ``points``: ego frame [m], [m/s]."""

SEED_STEP = 1_000_003
"""Distance between the seeds of exports. Frames add their time step."""

NO_VALUES: Mapping[str, Any] = MappingProxyType({})
ENCODERS = 2
"""Number of encoding threads."""

FLOW_SCALE, FLOW_ZERO = 64.0, 1 << 15


@runtime_checkable
class CastsToo(Protocol):
    """A backend that also casts beams."""

    caster: CastBackend


@dataclass(frozen=True, eq=False)
class LabelledMoment:
    """All labels of a moment."""

    moment: Moment
    boxes: Sequence[ObjectBox]
    images: Sequence[CameraImages]


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip in the store.

    Attributes:
        folder: folder with the files.
        name: four digits.
        split: name of its split.
        frames: labels of each frame, see ``docs/datasets.md``.
        values: parameter values of a sweep.
    """

    folder: Path
    name: str
    split: str
    frames: Sequence[dict[str, Any]]
    values: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path) -> Clip:
        """The clip in a folder written by :func:`write_clip`."""
        content = json.loads((folder / "labels.json").read_bytes())
        values = content.get("values", {})
        return cls(folder, content["name"], content["split"], content["frames"], values)

    def file(self, kind: str, camera: str, frame: int) -> Path:
        """The png of an image of that kind. The first and the last frame each lack one flow."""
        return self.folder / kind / camera / f"{frame:06d}.png"

    def pixels(self, kind: str, camera: str, frame: int) -> NDArray[Any]:
        """An image as stored in its png; RGB for ``rgb``."""
        image = cv2.imread(str(self.file(kind, camera, frame)), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise FileNotFoundError(self.file(kind, camera, frame))
        return np.ascontiguousarray(image[..., ::-1]) if kind == "rgb" else np.asarray(image)

    def points(self, frame: int) -> NDArray[Any]:
        """Points as rows of POINT."""
        rows: NDArray[Any] = np.load(self.folder / "points" / f"{frame:06d}.npy")
        return rows


def write_shard(
    variant: Variant,
    plan: ExportPlan,
    cameras: Sequence[Camera],
    clip: PlannedClip,
    folder: Path,
    *,
    backend: str | Backend = "auto",
    on_frame: Callable[[], None] = lambda: None,
) -> None:
    """Render and label a clip of a sweep, perturbed if planned; as :func:`write_clip`."""
    drive = variant.drive
    if plan.perturb is not None and clip.copy is not None:
        seed = (plan.seed, int(clip.name), clip.copy)
        drive = perturbed(drive, plan.perturb, clip.times_us, seed)
    write_clip(
        drive,
        plan,
        cameras,
        clip,
        folder,
        values=variant.values,
        backend=backend,
        on_frame=on_frame,
    )


def write_clip(
    drive: Drive,
    plan: ExportPlan,
    cameras: Sequence[Camera],
    clip: PlannedClip,
    folder: Path,
    *,
    values: Mapping[str, Any] = NO_VALUES,
    backend: str | Backend = "auto",
    on_frame: Callable[[], None] = lambda: None,
) -> None:
    """Render and label a clip into ``folder``, which is created atomically."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    frames, path = [], LoggedPath(drive.scene.ego)
    before: LabelledMoment | None = None
    with _FileWriter(partial) as files:
        for index, t_us in enumerate(clip.times_us):
            moment = drive.at(t_us)
            images = draw_moment(drive.scene, moment, cameras, backend=backend)
            here = LabelledMoment(moment, boxes_at(moment.placed), images)
            views = [views_of(i, here.boxes, moment.instances, backend=backend) for i in images]
            points = _points_of(drive, plan, here, backend)
            labels = _frame_labels(drive, here, views, points, index=index, path=path)
            if plan.noise is not None:
                labels["detections"] = _detections(here, labels, plan, (int(clip.name), index))
            frames.append(labels)
            files.finish()
            _write_images(files, images, index)
            files.add("points", "", index, _points_file(points))
            if before is not None and plan.flow:
                _write_flow(files, before, here, "forward", index - 1)
                _write_flow(files, here, before, "backward", index)
            before = here
            on_frame()
    content: dict[str, Any] = {"name": clip.name, "split": clip.split, "frames": frames}
    if values:
        content["values"] = dict(values)
    (partial / "labels.json").write_text(json.dumps(content), encoding="utf-8")
    partial.rename(folder)


def _points_of(
    drive: Drive, plan: ExportPlan, here: LabelledMoment, backend: str | Backend
) -> SeenPoints:
    lidar = planned_lidar(plan)
    if lidar is None:
        return seen_points(here.images, here.boxes, here.moment.T_world_ego)
    caster = backend.caster if isinstance(backend, CastsToo) else select_caster()
    seed = plan.seed * SEED_STEP + here.moment.t_us
    return lidar_points(drive, here.moment, here.boxes, lidar, seed=seed, caster=caster)


def _frame_labels(
    drive: Drive,
    here: LabelledMoment,
    views: Sequence[CameraView],
    points: SeenPoints,
    *,
    index: int,
    path: LoggedPath,
) -> dict[str, Any]:
    moment, boxes = here.moment, here.boxes
    beside = _beside(drive, moment.t_us)
    to_ego = invert_transform(moment.T_world_ego)
    in_ego = [in_frame(box, to_ego) for box in boxes]
    counts = points_in_boxes(points.points, [pose for pose, _ in in_ego], [b.size for b in boxes])
    futures = futures_at(drive, moment.t_us, [box.object_id for box in boxes])
    joints = keypoints_at(drive.scene, moment.placed, moment.t_us, strides=moment.strides)
    return {
        "index": index,
        "t_us": moment.t_us,
        "T_world_ego": moment.T_world_ego.tolist(),
        "ego": ego_state(drive, path, moment.t_us),
        "ego_future": ego_future(drive, moment.t_us),
        **beside,
        "objects": [
            {
                "object_id": box.object_id,
                "category": box.category,
                "instance_id": box.instance_id,
                "size": list(box.size),
                "T_world_object": box.T_world_object.tolist(),
                "T_ego_object": pose.tolist(),
                "velocity": box.velocity.tolist(),
                "velocity_ego": velocity.tolist(),
                "points": count,
                "future": futures[box.object_id],
                **_if_known("keypoints", joints.get(box.object_id)),
            }
            for box, (pose, velocity), count in zip(boxes, in_ego, counts, strict=True)
        ],
        "views": {view.images.camera.name: _view_labels(view, boxes, joints) for view in views},
    }


def _if_known(name: str, points: Float | None) -> dict[str, Any]:
    return {} if points is None else {name: points.tolist()}


def _beside(drive: Drive, t_us: int) -> dict[str, Any]:
    """Lateral and heading offset of the ego from its path, if it is perturbed."""
    if not isinstance(drive, PerturbedDrive):
        return {}
    lateral, heading = drive.offset_at(t_us)
    return {"beside_path": {"lateral": lateral, "heading": heading}}


def _detections(
    here: LabelledMoment, labels: Mapping[str, Any], plan: ExportPlan, place: tuple[int, int]
) -> list[dict[str, Any]]:
    assert plan.noise is not None
    poses = [np.array(subject["T_ego_object"]) for subject in labels["objects"]]
    return noisy_boxes(here.boxes, poses, plan.noise, (plan.seed, *place))


def _view_labels(
    view: CameraView, boxes: Sequence[ObjectBox], joints: Mapping[str, Float]
) -> list[dict[str, Any]]:
    def keypoints(seen: ObjectView) -> dict[str, Any]:
        points = joints.get(seen.object_id)
        if points is None:
            return {}
        return {"keypoints_2d": keypoints_in_image(points, view.images, seen.instance_id)}

    to_camera: Float = invert_transform(view.images.T_world_camera)
    poses = {box.object_id: to_camera @ box.T_world_object for box in boxes}
    return [
        {
            "object_id": seen.object_id,
            "instance_id": seen.instance_id,
            "T_camera_object": poses[seen.object_id].tolist(),
            "box_2d_modal": None if seen.modal_box is None else list(seen.modal_box),
            "box_2d_amodal": list(seen.amodal_box),
            "visible_pixels": seen.visible_pixels,
            "alone_pixels": seen.alone_pixels,
            "visibility": seen.visibility,
            "truncation": seen.truncation,
            **keypoints(seen),
        }
        for seen in view.objects
    ]


class _FileWriter:
    """Encodes and writes files on separate threads while the next frame is rendered."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pool = ThreadPoolExecutor(ENCODERS, thread_name_prefix="labels")
        self._pending: list[Future[None]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._pool.shutdown(cancel_futures=kind is not None)
        if kind is None:
            self.finish()

    def add(self, kind: str, camera: str, index: int, encode: Callable[[], bytes]) -> None:
        """Write the result of ``encode``; :meth:`finish` raises its error."""
        suffix = "npy" if kind == "points" else "png"
        path = self._folder / kind / camera / f"{index:06d}.{suffix}"

        def write() -> None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(encode())

        self._pending.append(self._pool.submit(write))

    def finish(self) -> None:
        """Wait for all added files."""
        for pending in self._pending:
            pending.result()
        self._pending.clear()


def _write_images(files: _FileWriter, images: Sequence[CameraImages], index: int) -> None:
    for image in images:
        parts: dict[str, NDArray[Any]] = {
            "rgb": image.rgb,
            "depth": image.depth,
            "instance": image.instance,
            "semantic": image.semantic,
        }
        for kind, pixels in parts.items():
            encode = partial_of(_encoded_image, pixels, kind)
            files.add(kind, image.camera.name, index, encode)


def _encoded_image(pixels: NDArray[Any], kind: str) -> bytes:
    return encode_image(pixels, kind, "png").data


def _points_file(points: SeenPoints) -> Callable[[], bytes]:
    rows = np.zeros(len(points.points), POINT)
    rows["xyz"], rows["intensity"], rows["beam"] = points.points, points.intensity, points.beam
    rows["instance"], rows["semantic"] = points.instance, points.semantic
    rows["velocity"], rows["time_us"] = points.velocity, points.time_us
    rows["return_number"] = points.return_number
    file = io.BytesIO()
    np.save(file, rows)
    return file.getvalue


def _write_flow(
    files: _FileWriter, start: LabelledMoment, end: LabelledMoment, direction: str, index: int
) -> None:
    for here, there in zip(start.images, end.images, strict=True):
        flow, valid, occluded = flow_between(here, there, start.boxes, end.boxes)
        name = here.camera.name
        files.add(f"flow_{direction}", name, index, partial_of(flow_png, flow, valid))
        files.add(f"occluded_{direction}", name, index, partial_of(_png, occluded))


def flow_png(flow: NDArray[np.float32], valid: NDArray[np.bool_]) -> bytes:
    """Flow [H, W, 2] [px] as KITTI's 16-bit png: u and v times 64 plus 2^15, and validity. Flow
    beyond 511 px is not valid."""
    levels = np.rint(flow * FLOW_SCALE) + FLOW_ZERO
    good = valid & ((levels >= 1) & (levels <= np.iinfo(np.uint16).max)).all(axis=-1)
    stored = np.zeros((*valid.shape, 3), np.uint16)
    # OpenCV writes channels in reverse order.
    stored[..., 2] = np.where(good, levels[..., 0], 0)
    stored[..., 1] = np.where(good, levels[..., 1], 0)
    stored[..., 0] = good
    return _encoded(stored)


def read_flow(stored: NDArray[np.uint16]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Flow [H, W, 2] [px] and validity [H, W] of :meth:`Clip.pixels`."""
    flow = (stored[..., [2, 1]].astype(np.float32) - FLOW_ZERO) / np.float32(FLOW_SCALE)
    valid = stored[..., 0] > 0
    return np.where(valid[..., None], flow, np.float32(0)), valid


def _png(mask: NDArray[np.bool_]) -> bytes:
    return _encoded(mask.astype(np.uint8) * 255)


def _encoded(image: NDArray[Any]) -> bytes:
    # Flow is smooth along rows: a single filter halves the time and gives smaller files.
    along_rows = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1, *along_rows])
    assert done
    return bytes(data)


# --- Makers ---------------------------------------------------------------------------------------
# Local processes or a Ray cluster make the clips. The bytes do not depend on the maker, and a clip
# is made again if its maker dies. Clips return as archives, so no shared disk is needed.

Recipe = Callable[[], Sequence[Variant]]
"""Makes the variants of an export. Must be picklable, with files available to every worker."""


@dataclass(frozen=True)
class ClipMakers:
    """Workers that each hold the scene in memory and make clips of an export.

    Attributes:
        executor: runs the workers.
        recipe: makes the variants in each worker.
        backend: name of the renderer's backend.
    """

    executor: Executor
    recipe: Recipe
    backend: str = "auto"

    def run(
        self,
        plan: ExportPlan,
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> None:
        """Make each clip as a folder below ``folder``, created atomically and named after the clip.

        Args:
            plan: plan of the export.
            clips: missing clips.
            folder: parent of the clips.
            on_frames: called with the number of frames of each finished clip.

        Raises:
            DatasetError: the makers of a clip die repeatedly.
        """
        named = {clip.name: clip for clip in clips}

        def keep(name: str, archive: bytes) -> None:
            _unpack(archive, folder / name)
            on_frames(len(named[name].times_us))

        try:
            self.executor.run(partial(_ClipMaker, self.recipe, plan, self.backend), named, keep)
        except ExecutorError as error:
            raise DatasetError(f"clip {error}") from error


class _ClipMaker:
    """A worker of an executor; computes with ``threads`` threads."""

    def __init__(self, recipe: Recipe, plan: ExportPlan, backend: str, threads: int) -> None:
        import numba
        import torch

        numba.set_num_threads(min(threads, numba.get_num_threads()))
        torch.set_num_threads(threads)
        self._variants = recipe()
        self._plan = plan
        self._cameras = planned_cameras(self._variants[0].drive, plan)
        self._backend = backend

    def make(self, clip: PlannedClip) -> bytes:
        """The files of a clip as a tar archive."""
        with tempfile.TemporaryDirectory(prefix="real2sim-clip-") as place:
            folder = Path(place) / clip.name
            variant = self._variants[clip.variant]
            write_shard(variant, self._plan, self._cameras, clip, folder, backend=self._backend)
            file = io.BytesIO()
            with tarfile.open(fileobj=file, mode="w") as tar:
                for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                    tar.add(path, str(path.relative_to(folder)))
            return file.getvalue()


def _unpack(archive: bytes, folder: Path) -> None:
    """Write the files of a clip; the folder is created atomically."""
    partial_folder = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial_folder, ignore_errors=True)
    partial_folder.mkdir(parents=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        unpack_tar(tar, partial_folder, members=tar)
    partial_folder.rename(folder)
