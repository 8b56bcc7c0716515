"""Images for planners that see, drawn in the process that drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from real2sim.images import Frame
from real2sim.observation import Observation
from real2sim.planners import Needs

from ..render import RasterOptions, View, rasterize_batch
from ..render.images import to_uint8
from ..scene import Camera, Scene
from ..service.library.views import camera_infos
from ..world import World

RGB = RasterOptions(depth=False, instance=False)


@dataclass(frozen=True, eq=False)
class CameraFeed:
    """The colour images that a planner asks for.

    Attributes:
        cameras: resized to what it wants.
    """

    cameras: tuple[Camera, ...]

    @classmethod
    def of(cls, scene: Scene, needs: Needs) -> CameraFeed | None:
        """What a planner needs; None for one that is blind.

        Raises:
            ValueError: images other than colour, or a camera that the scene lacks.
        """
        if not needs.modalities:
            return None
        if set(needs.modalities) != {"rgb"}:
            raise ValueError(
                f"the planner wants {', '.join(needs.modalities)}; sweeps draw rgb alone: drive it "
                "with evaluate-policy"
            )
        sensors = needs.sensors(camera_infos(tuple(scene.rig)))
        cameras = (scene.rig[sensor["camera"]] for sensor in sensors)
        return cls(tuple(c if needs.width is None else c.resized(needs.width) for c in cameras))

    def added_to(self, obs: Observation, world: World) -> Observation:
        """The observation with the images of its instant."""
        frames = {camera.name: {"rgb": draw_frames([world], camera)[0]} for camera in self.cameras}
        return replace(obs, frames=frames)


def draw_frames(worlds: Sequence[World], camera: Camera) -> list[Frame]:
    """What a camera sees in each of several worlds of one scene, drawn in one call.

    Args:
        worlds: at their instants; one at least.
        camera: of the ego.
    """
    views = [View(w.instances(), camera.viewmat(w.T_world_body), camera.K) for w in worlds]
    drawn = rasterize_batch(
        views, camera.width, camera.height, sky=worlds[0].scene.sky, options=RGB
    )
    images = zip(worlds, to_uint8(drawn.rgb), strict=True)
    return [_frame(world, camera, image) for world, image in images]


def _frame(world: World, camera: Camera, image: NDArray[np.uint8]) -> Frame:
    return Frame(
        modality="rgb",
        codec="raw",
        dtype="uint8",
        shape=image.shape,
        data=image.tobytes(),
        sensor=camera.name,
        t_us=world.t_us,
        T_world_sensor=world.T_world_body @ camera.T_vehicle_camera,
        K=camera.K,
    )
