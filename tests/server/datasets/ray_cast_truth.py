"""Labels of a synthetic street compared with its rays: figures for tests and documentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.labels import boxes_at, draw_moment, flow_between, views_of
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import invert_transform
from real2sim_server.scene import Scene
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log
from real2sim_server.synthetic.sensors import shoot_image

MIN_PIXELS = 100
ABOVE_ALL = 1000.0
"""A vehicle and the camera lifted so high [m] have nothing around them."""


@dataclass
class Figures:
    """What was measured.

    Attributes:
        ious: of masks, by object.
        pixels: of the true masks, by object, in the same order.
        box_ious: of modal boxes.
        visibility: errors, 0 to 1.
        depth: errors [m].
        flow: end-point errors [px], and lengths of the true flow [px].
    """

    ious: dict[str, list[float]] = field(default_factory=dict)
    pixels: dict[str, list[int]] = field(default_factory=dict)
    box_ious: list[float] = field(default_factory=list)
    visibility: list[float] = field(default_factory=list)
    depth: list[np.ndarray] = field(default_factory=list)
    flow: list[np.ndarray] = field(default_factory=list)
    lengths: list[np.ndarray] = field(default_factory=list)

    def summary(self) -> dict[str, float]:
        """The figures given in the documentation."""
        every = np.concatenate([np.array(v) for v in self.ious.values()])
        weights = np.concatenate([np.array(v) for v in self.pixels.values()])
        depth, flow = np.concatenate(self.depth), np.concatenate(self.flow)
        lengths = np.concatenate(self.lengths)
        outliers = (flow > 3) & (flow > 0.05 * lengths)
        return {
            "objects": len(every),
            "mask_iou": float(np.mean([np.mean(v) for v in self.ious.values()])),
            "mask_iou_by_pixels": float((every * weights).sum() / weights.sum()),
            "box_iou": float(np.mean(self.box_ious)),
            "box_iou_p10": float(np.percentile(self.box_ious, 10)),
            "visibility_error": float(np.mean(self.visibility)),
            "depth_median": float(np.median(depth)),
            "depth_p90": float(np.percentile(depth, 90)),
            "flow_median": float(np.median(flow)),
            "flow_outliers": float(outliers.mean()),
        }


def measure(
    scene: Scene, frames: Sequence[int], cameras: Sequence[str], *, width: int | None = None
) -> Figures:
    """Compare labels of a scene trained on a synthetic drive with that drive."""
    log = generate_log(SyntheticConfig.from_values(scene.provenance["config"]))
    drive = ScenarioDrive(scene, ScenarioState.of(scene))
    rig = [scene.rig[name].resized(width or scene.rig[name].width) for name in cameras]
    figures = Figures()
    for frame in frames:
        t_us = int(scene.frame_times_us[frame])
        moment = drive.at(t_us)
        boxes = boxes_at(moment.placed)
        images = draw_moment(scene, moment, rig)
        then_us = t_us + 100_000
        later = drive.at(then_us) if then_us <= drive.span[1] else None
        after = draw_moment(scene, later, rig) if later is not None else [None] * len(rig)
        for image, other in zip(images, after, strict=True):
            truth = _cast(log, image.T_world_camera, image.camera, t_us)
            view = views_of(image, boxes, moment.instances)
            _compare_objects(figures, log, view, truth, t_us)
            both = (truth[0] > 0) & (image.depth > 0)
            figures.depth.append(np.abs(truth[0] - image.depth)[both])
            if other is not None:
                flow, valid, _ = flow_between(image, other, boxes, boxes_at(later.placed))
                true = _true_flow(log, image, other, truth, (t_us, then_us))
                good = valid & (truth[0] > 0)
                figures.flow.append(np.linalg.norm(flow - true, axis=-1)[good])
                figures.lengths.append(np.linalg.norm(true, axis=-1)[good])
    return figures


def _cast(log: SyntheticLog, pose, camera, t_us):
    """True depth and instances."""
    _, depth, instance = log.render(pose, camera.K, camera.width, camera.height, t_us)
    return depth, instance


def _compare_objects(figures: Figures, log: SyntheticLog, view, truth, t_us: int) -> None:
    images, (_, instance) = view.images, truth
    names = {track.object_id: 1 + k for k, track in enumerate(log.tracks)}
    for seen in view.objects:
        true = instance == names[seen.object_id]
        count = int(true.sum())
        if count < MIN_PIXELS:
            continue
        mask = images.instance == seen.instance_id
        iou = float((mask & true).sum() / (mask | true).sum())
        figures.ious.setdefault(seen.object_id, []).append(iou)
        figures.pixels.setdefault(seen.object_id, []).append(count)
        figures.box_ious.append(_box_iou(seen.modal_box, _bounds(true)))
        alone = _alone(log, images, names[seen.object_id] - 1, t_us)
        figures.visibility.append(abs(seen.visibility - count / alone))


def _alone(log: SyntheticLog, images, index: int, t_us: int) -> int:
    """Pixels of a vehicle high above the street, seen from the same height."""
    source, camera = log.source, images.camera
    every = source.instances(t_us)
    one = every._replace(
        **{name: getattr(every, name)[index : index + 1] for name in every._fields}
    )
    to_world = one.to_world.copy()
    to_world[:, 2, 3] += ABOVE_ALL
    full = np.tile(np.eye(4), (1, 1, 1))
    full[:, :3] = to_world
    to_object = np.ascontiguousarray(invert_transform(full)[:, :3])
    pose = images.T_world_camera.copy()
    pose[2, 3] += ABOVE_ALL
    _, _, instance = shoot_image(
        source.world,
        one._replace(to_world=to_world, to_object=to_object),
        pose,
        np.ascontiguousarray(camera.K),
        camera.width,
        camera.height,
        1,
    )
    return max(int((instance > 0).sum()), 1)


def _true_flow(log: SyntheticLog, here, there, truth, times_us):
    """From rays and the drive's own tracks, written independently of the code under test."""
    depth, instance = truth
    height, width = depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    K_inverse = np.linalg.inv(here.camera.K)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ K_inverse.T
    local = np.concatenate([rays * depth[..., None], np.ones((height, width, 1))], axis=-1)
    world = local @ here.T_world_camera.T
    for number in np.unique(instance).tolist():
        if number:
            path = log.tracks[number - 1].trajectory
            motion = path.transform(times_us[1]) @ np.linalg.inv(path.transform(times_us[0]))
            own = instance == number
            world[own] = world[own] @ motion.T
    seen = world @ np.linalg.inv(there.T_world_camera).T
    pixels = seen[..., :3] @ there.camera.K.T
    end = pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-6)
    return end - np.stack([u, v], axis=-1)


def _bounds(mask):
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return columns[0], rows[0], columns[-1] + 1, rows[-1] + 1


def _box_iou(one, two) -> float:
    if one is None:
        return 0.0
    left, top = max(one[0], two[0]), max(one[1], two[1])
    right, bottom = min(one[2], two[2]), min(one[3], two[3])
    shared = max(right - left, 0) * max(bottom - top, 0)
    whole = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, two)]
    return float(shared / (sum(whole) - shared))
