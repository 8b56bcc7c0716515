"""Query and headers of a single frame, the same for scenes and scenarios."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Header, Query

from real2sim_proto.base import Identifier, Microseconds, Modality
from real2sim_proto.episode import SensorSpec

from ...edit import ScenarioState, instances_at
from ...geometry.rotation import Float
from ...render import Instance
from ...scene import Scene
from ..rendering.renderer import RenderRequest
from ..rendering.responses import CODEC_OF, choose_media_type


@dataclass(frozen=True)
class FrameQuery:
    """Query and headers of a render or preview."""

    camera: Annotated[
        Identifier | None, Query(description="camera of the rig; default: its first one")
    ] = None
    t_us: Annotated[
        Microseconds | None, Query(description="simulation time; default: start of the scenario")
    ] = None
    width: Annotated[
        int | None, Query(ge=16, le=8192, description="[px]; default: as recorded")
    ] = None
    modality: Modality = "rgb"
    accept: Annotated[
        str | None, Header(description="image/jpeg, image/png or application/msgpack")
    ] = None

    def media_type(self) -> str:
        """Form of the answer. Raises ServiceError: NOT_ACCEPTABLE."""
        return choose_media_type(self.accept, self.modality)

    def render_request(self, scene: Scene, state: ScenarioState, media_type: str) -> RenderRequest:
        """What to draw, from where the recording vehicle was.

        Raises:
            TimeOutOfRangeError: ``t_us`` outside the recording.
        """
        t_us = state.clock[0] if self.t_us is None else self.t_us
        return self.render_request_for(scene, instances_at(scene, state, t_us), t_us, media_type)

    def render_request_for(
        self,
        scene: Scene,
        instances: Sequence[Instance],
        t_us: int,
        media_type: str,
        T_world_vehicle: Float | None = None,
    ) -> RenderRequest:
        """The same for instances that are there already, and another way of the vehicle."""
        sensor = SensorSpec(
            camera=self.camera or scene.rig.names[0],
            modalities=[self.modality],
            width=self.width,
            codec=CODEC_OF[media_type],
        )
        return RenderRequest(
            scene=scene,
            instances=instances,
            T_world_vehicle=(
                scene.ego.transform(t_us) if T_world_vehicle is None else T_world_vehicle
            ),
            t_us=t_us,
            sensors=(sensor,),
        )


FrameQueryOf = Annotated[FrameQuery, Depends()]
