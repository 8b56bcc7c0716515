"""Edited vehicles of a synthetic log against the street that is ray-cast with the same edit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.operations import Delete, Operation, Rotate, Translate

from ...edit import ScenarioState, apply_operations, instances_at
from ...geometry import Float, invert_transform
from ...logs import DrivingLog, ObjectTrack
from ...scene import Camera, Scene
from ...synthetic import SyntheticLog
from ...synthetic.street import KERB_HEIGHT
from ...synthetic.vehicles import SHAPES
from ..logged_view import image_time, spread, tracks_mask
from .images import SEEN_WITHIN, is_seen, logged_azimuths, mean_psnr, psnr, ssim
from .rendering import render_view
from .shifted import MIN_OBJECT_PIXELS, within_an_object

LANE_M = 3.5
"""Distance by which a vehicle is moved to its left [m]."""
TURNS = (35, 90, 180)
"""Angles by which a vehicle is turned in place [degrees]."""
MAX_FRAMES = 16
"""Maximum number of compared frames that are searched for vehicles, evenly spread."""
MAX_VIEWS = 4
"""Maximum number of views of one edit, evenly spread over those that show the vehicle."""
MIN_PIXELS = 200
"""Minimum number of pixels of the vehicle in a view, at its old or its new place."""
SIDES = np.deg2rad(30.0)
"""Minimum range of azimuths at which a moving vehicle counts as seen from several sides [rad]."""
CHANGED = 6
"""Smallest change of a channel by an edit that counts, of 255."""
CHANGED_MARGIN = 3
"""Changed regions are enlarged by this many pixels."""
GROUND_ABOVE = 0.05
"""Surfaces up to this far above the pavement count as ground [m]."""


@dataclass(frozen=True, eq=False)
class Cast:
    """A ray-cast view of a street.

    Attributes:
        rgb: [H, W, 3].
        depth: [H, W] along z [m], 0 in the sky.
        instance: [H, W], 1 + index of the track, 0 elsewhere.
        pose: ``T_world_camera`` [4, 4].
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    pose: Float


@dataclass(frozen=True, eq=False)
class AppliedEdit:
    """One edit, applied to a scene and to the true street.

    Attributes:
        object_id: id of the vehicle.
        state: the edited scene.
        before, after: the street without and with the edit.
    """

    object_id: str
    state: ScenarioState
    before: SyntheticLog
    after: SyntheticLog


@dataclass(frozen=True, eq=False)
class EditedView:
    """One view of an edit: images RGB [H, W, 3], and masks [H, W].

    Attributes:
        rendered: the edited scene.
        before, after: the street without and with the edit.
        region: what the edit changes in the street: the vehicle at both places, its shadows.
        shadows: the part of ``region`` that shows the vehicle at neither place.
        vehicle: the vehicle at its new place.
        hidden_ground: ground that the edit reveals.
        seen: whether a camera of the log saw this side of the vehicle at its new place; None if
            it was deleted.
    """

    rendered: NDArray[np.uint8]
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    region: NDArray[np.bool_]
    shadows: NDArray[np.bool_]
    vehicle: NDArray[np.bool_]
    hidden_ground: NDArray[np.bool_]
    seen: bool | None


@dataclass(frozen=True, kw_only=True)
class EditFigures:
    """Edited images against the truth.

    Attributes:
        psnr, ssim: over the region that the edit changes [dB], [1].
        pixels: number of its pixels.
        psnr_hidden_ground: over the ground that the edit reveals [dB]; nan below 50 pixels.
        psnr_shadows: over the rest of the region without the vehicle at either place [dB]; nan
            below 50 pixels.
        psnr_unseen: over the vehicle at its new place [dB]; nan below 50 pixels, if a camera of
            the log saw this side, and for deletions.
    """

    psnr: float
    ssim: float
    pixels: int
    psnr_hidden_ground: float
    psnr_shadows: float
    psnr_unseen: float


@dataclass(frozen=True, kw_only=True)
class EditViewScore(EditFigures):
    """One view of an edit, of ``camera`` at ``frame``."""

    camera: str
    frame: int


@dataclass(frozen=True, kw_only=True)
class EditScore(EditFigures):
    """One edit of one vehicle: means over its views, and the sum of their pixels.

    Attributes:
        object_id: id of the vehicle.
        vehicle: ``parked``, ``passing`` (moves, seen from several sides) or ``followed`` (moves,
            only seen from behind).
        edit: a name in :func:`edits_of`.
    """

    object_id: str
    vehicle: str
    edit: str
    views: tuple[EditViewScore, ...]


def edits_of(object_id: str) -> dict[str, Operation]:
    """The scored edits of a vehicle by name."""
    turns = {f"turn_{d}": Rotate(object_id=object_id, angle=math.radians(d)) for d in TURNS}
    left = Translate(object_id=object_id, y=LANE_M, frame="object")
    return {"delete": Delete(object_id=object_id), "move_left": left, **turns}


def evaluate_edits(
    scene: Scene,
    log: DrivingLog,
    truth: SyntheticLog,
    pairs: Sequence[tuple[Camera, int]],
    *,
    backend: str = "auto",
    on_edit: Callable[[int, int], None] | None = None,
) -> tuple[EditScore, ...]:
    """Edit up to three vehicles and compare with the street that has the same edit.

    Args:
        scene: its ego path covers the compared frames.
        log: gives the times of the frames.
        truth: street of ``log``.
        pairs: compared cameras, at the compared size, and frames.
        on_edit: called with the number of finished edits and of all edits.
    """
    frames = set(spread(sorted({frame for _, frame in pairs}), MAX_FRAMES))
    pairs = [(camera, frame) for camera, frame in pairs if frame in frames]
    casts = [cast(truth, camera, image_time(log, camera.name, f)) for camera, f in pairs]
    tracks = 1 + len(truth.tracks)
    visible = [np.bincount(c.instance.ravel(), minlength=tracks)[1:] for c in casts]
    chosen = choose_vehicles(scene, truth, np.array(visible))
    todo = [(kind, name, edit) for kind, name in chosen.items() for edit in edits_of(name)]
    scores = []
    for done, (kind, object_id, name) in enumerate(todo):
        edit = apply_edit(scene, truth, object_id, edits_of(object_id)[name])
        index = _ids(truth).index(object_id)
        shown = [
            (camera, frame, before)
            for pixels, (camera, frame), before in zip(visible, pairs, casts, strict=True)
            if _is_shown(scene, edit, camera, image_time(log, camera.name, frame), pixels[index])
        ]
        views = []
        for camera, frame, before in spread(shown, MAX_VIEWS):
            t_us = image_time(log, camera.name, frame)
            view = compare_edit(scene, edit, camera, t_us, before=before, backend=backend)
            if (view.region & ~view.shadows).sum() >= MIN_PIXELS:
                views.append(score_view(view, camera.name, frame))
        if views:
            scores.append(_mean(object_id, kind, name, views))
        if on_edit is not None:
            on_edit(done + 1, len(todo))
    return tuple(scores)


def choose_vehicles(
    scene: Scene, truth: SyntheticLog, visible: NDArray[np.int64]
) -> dict[str, str]:
    """Ids of the vehicles to edit by kind: of each kind the one with the most visible pixels.

    Args:
        scene: vehicles without an object in it are left out.
        truth: street of the log.
        visible: [views, tracks] visible pixels.
    """
    categories = {shape.category for shape in SHAPES}
    most: dict[str, tuple[int, str]] = {}
    for index, track in enumerate(truth.tracks):
        pixels = visible[:, index]
        if track.category not in categories or track.object_id not in scene.objects:
            continue
        kind = _kind(truth, track)
        covered = int(pixels[pixels >= MIN_PIXELS].sum())
        if kind is not None and covered > most.get(kind, (0, ""))[0]:
            most[kind] = (covered, track.object_id)
    return {kind: most[kind][1] for kind in ("parked", "passing", "followed") if kind in most}


def apply_edit(
    scene: Scene, truth: SyntheticLog, object_id: str, operation: Operation
) -> AppliedEdit:
    """Apply an operation on a vehicle to the scene and, from its true trajectory, to the street.

    Raises:
        EditError: the scene has no such object.
    """
    state = ScenarioState.of(scene)
    edited = apply_operations(state, [operation]).state
    track = truth.tracks[_ids(truth).index(object_id)]
    exact = state.with_object(replace(state.objects[object_id], trajectory=track.trajectory))
    moved = apply_operations(exact, [operation]).state.objects[object_id]
    after = truth.with_vehicles({object_id: None if moved.deleted else moved.trajectory})
    return AppliedEdit(object_id, edited, truth, after)


def cast(street: SyntheticLog, camera: Camera, t_us: int) -> Cast:
    """Cast a view from the recording vehicle at ``t_us`` [us]."""
    pose = camera.pose(street.ego.transform(t_us))
    return Cast(*street.render(pose, camera.K, camera.width, camera.height, t_us), pose)


def compare_edit(
    scene: Scene,
    edit: AppliedEdit,
    camera: Camera,
    t_us: int,
    *,
    before: Cast | None = None,
    backend: str = "auto",
) -> EditedView:
    """Render the edited scene and the street from the recording vehicle at ``t_us`` [us].

    Args:
        before: the view of the street without the edit; None casts it.
    """
    before = before or cast(edit.before, camera, t_us)
    after = cast(edit.after, camera, t_us)
    old = before.instance == 1 + _ids(edit.before).index(edit.object_id)
    new, seen = np.zeros_like(old), None
    if edit.object_id in _ids(edit.after):
        index = _ids(edit.after).index(edit.object_id)
        new = after.instance == 1 + index
        track = edit.before.tracks[_ids(edit.before).index(edit.object_id)]
        T_world_object = edit.after.tracks[index].trajectory.transform(t_us)
        x, y, _ = (invert_transform(T_world_object) @ after.pose)[:3, 3]
        seen = is_seen(float(np.arctan2(y, x)), logged_azimuths(edit.before, track))
    region = edit_region(before.rgb, after.rgb, old | new)
    instances = instances_at(scene, edit.state, t_us)
    return EditedView(
        rendered=render_view(scene, camera, t_us, instances=instances, backend=backend).rgb,
        before=before.rgb,
        after=after.rgb,
        region=region,
        shadows=region & ~old & ~new,
        vehicle=new,
        hidden_ground=old & (after.instance == 0) & _ground(after, camera),
        seen=seen,
    )


def edit_region(
    before: NDArray[np.uint8], after: NDArray[np.uint8], vehicle: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Pixels [H, W] that an edit changes, with a margin, and those of the vehicle."""
    import cv2

    changed = np.abs(before.astype(np.int16) - after).max(axis=-1) >= CHANGED
    kernel = np.ones((2 * CHANGED_MARGIN + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate(changed.astype(np.uint8), kernel) > 0) | vehicle


def score_view(view: EditedView, camera: str, frame: int) -> EditViewScore:
    """Scores of a view within its masks."""
    rendered, after = view.rendered, view.after
    unseen = view.vehicle & (view.seen is False)

    def psnr_of_part(mask: NDArray[np.bool_]) -> float:
        enough = int(mask.sum()) >= MIN_OBJECT_PIXELS
        return psnr(rendered, after, mask) if enough else float("nan")

    return EditViewScore(
        camera=camera,
        frame=frame,
        psnr=psnr(rendered, after, view.region),
        ssim=ssim(rendered, after, view.region),
        pixels=int(view.region.sum()),
        psnr_hidden_ground=psnr_of_part(view.hidden_ground),
        psnr_shadows=psnr_of_part(view.shadows),
        psnr_unseen=psnr_of_part(unseen),
    )


def _ids(log: DrivingLog) -> list[str]:
    return [track.object_id for track in log.tracks]


def _kind(truth: SyntheticLog, track: ObjectTrack) -> str | None:
    if not track.trajectory.moves:
        return "parked"
    azimuths = np.array(logged_azimuths(truth, track))
    if not len(azimuths):
        return None
    from_behind = (azimuths % (2 * np.pi)) - np.pi
    if (np.abs(from_behind) <= SEEN_WITHIN).all():
        return "followed"
    # A range of angles is the same from any direction in which none of them lies.
    ranges = np.ptp(azimuths), np.ptp(from_behind)
    return "passing" if min(ranges) >= SIDES else None


def _is_shown(scene: Scene, edit: AppliedEdit, camera: Camera, t_us: int, old_pixels: int) -> bool:
    """Whether a view shows the vehicle at its old or its new place, the new one through others.

    Views from within a vehicle do not.
    """
    if not scene.objects[edit.object_id].trajectory.covers(t_us):
        return False
    pose = camera.pose(edit.after.ego.transform(t_us))
    if within_an_object(edit.after, pose[:3, 3], t_us):
        return False
    moved = [track for track in edit.after.tracks if track.object_id == edit.object_id]
    return bool(max(old_pixels, tracks_mask(moved, camera, pose, t_us).sum()) >= MIN_PIXELS)


def _ground(view: Cast, camera: Camera) -> NDArray[np.bool_]:
    """Pixels [H, W] with a surface at the height of the road or the pavement."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    height = view.pose[2, 3] + view.depth * (rays @ view.pose[2, :3])
    return np.asarray((view.depth > 0) & (height <= KERB_HEIGHT + GROUND_ABOVE))


def _mean(object_id: str, vehicle: str, edit: str, views: Sequence[EditViewScore]) -> EditScore:
    return EditScore(
        object_id=object_id,
        vehicle=vehicle,
        edit=edit,
        psnr=mean_psnr(view.psnr for view in views),
        ssim=float(np.mean([view.ssim for view in views])),
        pixels=sum(view.pixels for view in views),
        psnr_hidden_ground=mean_psnr(view.psnr_hidden_ground for view in views),
        psnr_shadows=mean_psnr(view.psnr_shadows for view in views),
        psnr_unseen=mean_psnr(view.psnr_unseen for view in views),
        views=tuple(views),
    )
