"""A sensor modality is one module with a registration. It needs no change to the service."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from real2sim_proto import decode
from real2sim_proto.episode import SensorSpec
from real2sim_server.edit import ScenarioState, instances_at
from real2sim_server.render import RenderOutput, select_backend
from real2sim_server.render.images import EXACT_CODECS, encode_lossless
from real2sim_server.render.modalities import SensorModality, register, unregister
from real2sim_server.scene import Scene
from real2sim_server.service.engine import Engine
from real2sim_server.service.frames import EncodedFrame
from real2sim_server.service.http.telemetry import Metrics
from real2sim_server.service.renderer import Renderer, RenderRequest
from real2sim_server.service.sessions.wire import PhaseTimer, pack_members, pack_with_frames


def opacity(output: RenderOutput) -> NDArray[np.uint8]:
    levels: NDArray[np.uint8] = (output.alpha * 255 + 0.5).byte().cpu().numpy()
    return levels


@pytest.fixture
def alpha() -> Iterator[SensorModality]:
    """Accumulated opacity in 255 levels."""
    dtype = np.dtype(np.uint8)
    yield register(
        SensorModality(
            name="alpha",
            dtype=dtype,
            channels=(),
            codecs=EXACT_CODECS,
            pixels=opacity,
            encode=lambda image, codec, _: encode_lossless(image, codec, name="alpha", dtype=dtype),
        )
    )
    unregister("alpha")


def rendered(scene: Scene, codec: str) -> list[EncodedFrame]:
    """Frames of one camera in the modalities rgb and alpha."""
    # Skip validation: the request schema is a public contract and only lists the public modalities.
    sensor = SensorSpec.model_construct(
        camera=scene.rig.names[0], modalities=["rgb", "alpha"], codec=codec
    )
    request = RenderRequest(
        scene=scene,
        instances=instances_at(scene, ScenarioState.of(scene), scene.start_us),
        T_world_vehicle=scene.ego.transform(scene.start_us),
        t_us=scene.start_us,
        sensors=(sensor,),
    )
    engine = Engine()
    engine.start()
    renderer = Renderer(engine, select_backend("cpu"), Metrics(), max_pixels=10**7)
    try:
        return asyncio.run(renderer.render(request)).frames
    finally:
        renderer.close()
        engine.stop()


@pytest.mark.parametrize("codec", ["raw", "png", "jpeg"])
def test_a_registered_modality_is_rendered_and_encoded(alpha, tiny_scene, codec):
    rgb, frame = rendered(tiny_scene, codec)
    camera = tiny_scene.rig.cameras[0]
    assert (rgb.header.fields["modality"], frame.header.fields["modality"]) == ("rgb", "alpha")
    assert frame.codec == ("raw" if codec == "raw" else "png")
    assert frame.shape == (camera.height, camera.width)
    assert frame.header.fields["dtype"] == "uint8"


def test_a_frame_of_the_new_modality_is_decoded_from_an_observation(alpha, tiny_scene):
    frames = rendered(tiny_scene, "raw")
    message = pack_with_frames("obs", pack_members({"step": 1}), frames, PhaseTimer())
    received = decode(message.joined(3))["frames"][1]
    levels = np.frombuffer(received["data"], received["dtype"]).reshape(received["shape"])
    assert received["modality"] == "alpha"
    assert 0 < levels.max() <= 255
