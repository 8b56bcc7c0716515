"""Images for planners that see, drawn in the process that drives."""

from __future__ import annotations

from dataclasses import dataclass, replace

from real2sim.images import Frame
from real2sim.observation import Observation
from real2sim.planners import Needs

from ..render import RasterOptions, View, rasterize_batch
from ..render.quantize import to_uint8
from ..scene import Camera, Scene
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
        names = list(needs.cameras or scene.rig.names[:1])
        if missing := [name for name in names if name not in scene.rig.names]:
            raise ValueError(
                f"the planner wants camera {missing[0]!r}; the scene has "
                f"{', '.join(scene.rig.names) or 'none'}"
            )
        cameras = (scene.rig[name] for name in names)
        return cls(tuple(c if needs.width is None else c.resized(needs.width) for c in cameras))

    def added_to(self, obs: Observation, world: World) -> Observation:
        """The observation with the images of its instant."""
        frames = {}
        for camera in self.cameras:
            view = View(world.instances(), camera.viewmat(world.T_world_body), camera.K)
            drawn = rasterize_batch(
                [view], camera.width, camera.height, sky=world.scene.sky, options=RGB
            )
            image = to_uint8(drawn.rgb)[0]
            frame = Frame(
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
            frames[camera.name] = {"rgb": frame}
        return replace(obs, frames=frames)
