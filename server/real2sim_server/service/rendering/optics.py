"""Lenses, shutters and effects of sensors: from the wire to cameras and images, and back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.cameras import LensSpec, MotionBlurSpec, Optics
from real2sim_proto.episode import SensorSpec

from ...geometry.rotation import Float
from ...render import Instance, RigView
from ...render.images import Light, to_display, to_light
from ...scene import Camera, Lens, Shutter
from ...scene.camera_motion import moved
from ...scene.lens import lens_from


def camera_with(camera: Camera, optics: Optics) -> Camera:
    """A camera of a rig with the optics of a sensor. Raises SceneError for optics that are none."""
    if optics == "pinhole":
        return camera
    if optics == "recorded":
        return camera.as_recorded()
    K = camera.K if optics.K is None else np.array(optics.K)
    shutter = Shutter(optics.shutter.direction, optics.shutter.readout_us)
    return replace(camera, K=K, lens=lens_of(optics.lens), shutter=shutter, recorded=None)


def lens_of(spec: LensSpec) -> Lens | None:
    """A lens of the wire. Raises SceneError for one that its model refuses."""
    return lens_from(spec.model_dump())


def needs_motion(sensors: Sequence[SensorSpec]) -> bool:
    """Whether what moves matters to the images of sensors, and not only where it is."""
    return any(sensor.optics != "pinhole" or sensor.effects is not None for sensor in sensors)


def frame_names(sensor: SensorSpec, camera: Camera | None, modality: str) -> dict[str, Any]:
    """What a frame says of lens, shutter and effects; nothing where there are none."""
    said: dict[str, Any] = {}
    if camera is not None and camera.lens is not None:
        said["lens"] = camera.lens.model
    if camera is not None and camera.shutter.rolls:
        said["shutter"] = camera.shutter.direction
    if modality == "rgb" and sensor.effects is not None and sensor.effects.names:
        said["effects"] = sensor.effects.names
    return said


class FollowingImage:
    """An image that follows from a drawn one when somebody waits for it, on whatever thread.

    Args:
        drawn: [H, W] or [H, W, 3] uint8; whole once ``wait`` has returned.
        wait: for the drawn image.
        follow: the image that follows, of the same shape; called once, after ``wait``.

    Attributes:
        pixels: like ``drawn``; whole once :meth:`ready` has returned.
    """

    def __init__(
        self,
        drawn: NDArray[np.uint8],
        wait: Callable[[], object],
        follow: Callable[[], NDArray[np.uint8]],
    ) -> None:
        self.pixels = np.empty_like(drawn)
        self._wait = wait
        self._follow: Callable[[], NDArray[np.uint8]] | None = follow
        self._lock = threading.Lock()

    def ready(self) -> None:
        """Return when the pixels are there; any number of times."""
        with self._lock:
            if self._follow is not None:
                self._wait()
                self.pixels[:] = self._follow()
                self._follow = None  # and the drawn image with it


def blurred(
    view: RigView, blur: MotionBlurSpec, draw: Callable[[RigView], NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """The mean light of ``blur.samples`` images evenly within its exposure, whose middle is that of
    ``view``.

    Args:
        view: of one camera, with the motion of its vehicle and of what it looks at.
        blur: how long, and of how many.
        draw: the colour image of such a view.
    """
    total: Light | None = None
    for k in range(blur.samples):
        seconds = ((k + 0.5) / blur.samples - 0.5) * blur.exposure_us * 1e-6
        light = to_light(draw(_later(view, seconds)))
        total = light if total is None else total + light
    assert total is not None
    return to_display(total / np.float32(blur.samples))


def _later(view: RigView, seconds: float) -> RigView:
    vehicle: Float = np.asarray(view.T_world_vehicle, dtype=np.float64)
    if view.twist is not None:
        vehicle = moved(vehicle, view.twist[:3], view.twist[3:], seconds)
    instances = [_moved_on(instance, seconds) for instance in view.instances]
    return replace(view, T_world_vehicle=vehicle, instances=instances)


def _moved_on(instance: Instance, seconds: float) -> Instance:
    if instance.twist is None or instance.T_world_object is None:
        return instance
    pose = np.asarray(instance.T_world_object, dtype=np.float64)
    there = moved(pose, instance.twist[:3], instance.twist[3:], seconds)
    return replace(instance, T_world_object=there)
