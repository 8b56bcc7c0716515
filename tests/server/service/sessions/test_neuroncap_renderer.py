"""The NeuroNCAP renderer interface of a worker.

If REAL2SIM_NEURONCAP names a checkout of atonderski/neuro-ncap (MIT), its own client is tested too
(needs httpx and torch).
"""

from __future__ import annotations

import asyncio
import base64
import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path

import cv2
import httpx2
import numpy as np
import pytest
import torch

import real2sim
from real2sim.planners.peer import PeerError
from real2sim.renderers.linked_scene import SceneLink
from real2sim.renderers.neuroncap import NeuroNcapRenderer
from real2sim_server.geometry import invert_transform
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.network

SHIFTED = np.array([[0.0, -1, 0, 5], [1, 0, 0, -3], [0, 0, 1, 2], [0, 0, 0, 1]])
LATER = 1_531_883_530_449_377


@pytest.fixture
def serve(site):
    """Serve the tiny scene with a link. Returns an HTTP client."""
    with real2sim.connect(site.url) as client:
        started = []

        def start(**link) -> httpx2.Client:
            renderer = NeuroNcapRenderer(client, SceneLink(scene="tiny", **link))
            http = httpx2.Client(base_url=f"http://127.0.0.1:{renderer.start(port=0)}")
            started.append((renderer, http))
            return http

        yield start
        for renderer, http in started:
            http.close()
            renderer.stop()


def camera_at(scene, t_us, name="front"):
    return scene.rig[name].pose(scene.ego.transform(t_us))


def render(http, pose, t_us, *, camera="CAM_FRONT", image_format="png"):
    body = {"pose": pose.tolist(), "timestamp": t_us, "camera_name": camera}
    return http.post("/render_image", json=body | {"image_format": image_format})


def pixels(response) -> np.ndarray:
    assert response.status_code == 200, response.text
    image = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def drawn(site, **options):
    with real2sim.connect(site.url) as client:
        return client.scenes.render("tiny", codec="raw", **options).array


def alike(image, other) -> bool:
    """Whether images are equal up to rounding errors of poses converted to quaternions."""
    return np.abs(image.astype(int) - other).mean() < 0.01


def seen_at(scene, image, point):
    """Red, green and blue of a world point in the front camera at the start."""
    front = scene.rig["front"]
    x, y, z = (front.viewmat(np.eye(4)) @ [*point, 1.0])[:3]
    u, v, _ = front.K @ (x / z, y / z, 1.0)
    return image[int(v), int(u)].astype(int)


def moved(actor, x, y, z, *, times=(0, 2_000_000)):
    pose = np.eye(4)
    pose[:3, 3] = (x, y, z)
    return actor | {"timestamps": list(times), "poses": [pose.tolist()] * len(times)}


def test_alive_and_start_time_are_served(serve):
    http = serve(offset_us=LATER)
    assert http.get("/alive").json() is True
    assert http.get("/start_time").json() == LATER


def test_actors_list_all_objects_with_width_before_length(serve, tiny_scene):
    listed = {a["uuid"]: a for a in serve().get("/get_actors").json()}
    assert set(listed) == {"car_red", "car_blue", "post"}
    blue = tiny_scene.objects["car_blue"]
    assert listed["car_blue"]["dims"] == pytest.approx([1.8, 4.2, 1.5])
    assert listed["car_blue"]["timestamps"] == blue.trajectory.times_us.tolist()
    last = np.array(listed["car_blue"]["poses"][-1])
    np.testing.assert_allclose(last, blue.trajectory.transform(2_000_000), atol=1e-9)


@pytest.mark.parametrize(("camera", "ours"), [("CAM_FRONT", "front"), ("CAM_FRONT_LEFT", "left")])
def test_without_an_update_the_recorded_image_is_rendered(serve, site, tiny_scene, camera, ours):
    image = render(serve(), camera_at(tiny_scene, 1_000_000, ours), 1_000_000, camera=camera)
    assert alike(pixels(image), drawn(site, camera=ours, t_us=1_000_000))


def test_updated_actors_are_rendered_at_their_new_poses(serve, tiny_scene):
    http = serve()
    (red,) = [a for a in http.get("/get_actors").json() if a["uuid"] == "car_red"]
    there = (12.0, 0.0, 0.75)
    assert http.post("/update_actors", json=[moved(red, *there)]).status_code == 200
    red_value, green, _ = seen_at(
        tiny_scene, pixels(render(http, camera_at(tiny_scene, 0), 0)), there
    )
    assert red_value - green > 60
    # Actors missing from an update are removed, and exist only between their first and last time.
    gone = pixels(render(http, camera_at(tiny_scene, 0), 2_100_000))
    http.post("/update_actors", json=[])
    assert np.array_equal(gone, pixels(render(http, camera_at(tiny_scene, 0), 0)))


def test_actor_poses_are_interpolated(serve, tiny_scene):
    http = serve()
    (red,) = [a for a in http.get("/get_actors").json() if a["uuid"] == "car_red"]
    poses = [np.eye(4), np.eye(4)]
    poses[0][:3, 3], poses[1][:3, 3] = (12.0, -4.0, 0.75), (12.0, 4.0, 0.75)
    actor = red | {"timestamps": [0, 1_000_000], "poses": [p.tolist() for p in poses]}
    http.post("/update_actors", json=[actor])
    between = pixels(render(http, camera_at(tiny_scene, 0), 500_000))
    http.post("/update_actors", json=[moved(red, 12.0, 0.0, 0.75)])
    assert np.array_equal(between, pixels(render(http, camera_at(tiny_scene, 0), 500_000)))
    listed = {a["uuid"]: a for a in http.get("/get_actors").json()}
    assert listed["car_red"]["poses"][0][0][3] == 12.0


def test_world_frame_clock_and_object_names_are_converted(serve, site, tiny_scene):
    rows = tuple(map(tuple, SHIFTED.tolist()))
    http = serve(T_world_theirs=rows, offset_us=LATER, objects={"token": "car_red"})
    theirs = invert_transform(SHIFTED)
    image = render(http, theirs @ camera_at(tiny_scene, 500_000), LATER + 500_000)
    assert alike(pixels(image), drawn(site, camera="front", t_us=500_000))
    listed = {a["uuid"]: a for a in http.get("/get_actors").json()}
    assert set(listed) == {"token", "car_blue", "post"}
    red = np.array(listed["token"]["poses"][0])
    np.testing.assert_allclose(SHIFTED @ red, tiny_scene.objects["car_red"].trajectory.transform(0))


def test_raw_images_are_base64_encoded_tensors(serve, site, tiny_scene):
    response = render(serve(), camera_at(tiny_scene, 0), 0, image_format="raw")
    tensor = torch.load(io.BytesIO(base64.b64decode(response.text)))
    assert tensor.dtype is torch.uint8
    assert alike(tensor.numpy(), drawn(site, camera="front", t_us=0))


@pytest.mark.parametrize(
    ("path", "body", "status", "said"),
    [
        ("/render_image", {}, 422, "pose"),
        ("/render_image", {"pose": [[1.0] * 4] * 4}, 422, "not a rigid transform"),
        ("/render_image", {"image_format": "webp"}, 422, "image_format"),
        (
            "/render_image",
            {"camera_name": "CAM_BACK"},
            422,
            "none of front, left faces that direction",
        ),
        ("/render_image", {"camera_name": "roof"}, 422, "matches none of"),
        (
            "/update_actors",
            [{"uuid": "x", "timestamps": [0], "poses": [np.eye(4).tolist()]}],
            422,
            "no actor 'x'",
        ),
        (
            "/update_actors",
            [{"uuid": "post", "timestamps": [1, 0], "poses": [np.eye(4).tolist()] * 2}],
            422,
            "must increase",
        ),
        ("/set_actor_scale", 1.0, 404, "there are GET /alive"),
    ],
)
def test_an_invalid_request_is_refused_and_the_service_continues(
    serve, tiny_scene, path, body, status, said
):
    http = serve()
    if path == "/render_image" and body:
        good = {"pose": np.eye(4).tolist(), "timestamp": 0, "camera_name": "CAM_FRONT"}
        body = good | body
    refused = http.post(path, content=json.dumps(body))
    assert refused.status_code == status
    assert said in refused.json()["detail"]
    assert render(http, camera_at(tiny_scene, 0), 0).status_code == 200


def test_a_link_to_an_unknown_camera_is_refused_immediately(serve):
    with pytest.raises(PeerError, match="camera 'roof', given for 'CAM_FRONT', does not exist"):
        serve(cameras={"CAM_FRONT": "roof"})


# --- NeuroNCAP's own client -----------------------------------------------------------------------


@pytest.fixture
def their_client(serve):
    checkout = os.environ.get("REAL2SIM_NEURONCAP")
    if not checkout:
        pytest.skip("REAL2SIM_NEURONCAP names no checkout of atonderski/neuro-ncap")
    pytest.importorskip("httpx")
    # Its package imports nuScenes' toolkit and other packages that the client does not use.
    for name in ("neuro_ncap", "neuro_ncap.components"):
        package = types.ModuleType(name)
        package.__path__ = [str(Path(checkout, *name.split(".")))]
        sys.modules[name] = package
    api = importlib.import_module("neuro_ncap.components.renderer_api")
    port = serve().base_url.port
    yield api, api.RendererConfig(host="127.0.0.1", port=port).setup()
    for name in [name for name in sys.modules if name.partition(".")[0] == "neuro_ncap"]:
        del sys.modules[name]


def test_neuroncaps_client_renders_and_moves_actors(their_client, site, tiny_scene):
    api, client = their_client
    names = dict.fromkeys(("car_red", "car_blue", "post"), "car")
    listed = asyncio.run(client.get_actors(uuid_to_cls=names))
    assert {actor.uuid for actor in listed} == set(names)

    def image(t_us):
        pose = torch.from_numpy(camera_at(tiny_scene, 0))
        spec = api.RenderSpecification(pose=pose, timestamp=t_us, camera_name="CAM_FRONT")
        saved = asyncio.run(client.get_image(spec))
        return torch.load(io.BytesIO(base64.b64decode(saved))).numpy()

    assert alike(image(0), drawn(site, camera="front", t_us=0))
    (red,) = [actor for actor in listed if actor.uuid == "car_red"]
    red.poses[:, :3, 3] = (12.0, 0.0, 0.75)
    asyncio.run(client.update_actors([red], scale=1.0))
    red_value, green, _ = seen_at(tiny_scene, image(0), (12.0, 0.0, 0.75))
    assert red_value - green > 60


@pytest.mark.parametrize(
    ("command", "options"), [("alpasim-renderer", []), ("neuroncap-renderer", ["--scene", "tiny"])]
)
def test_the_adapter_command_prints_its_address_and_stops_on_interrupt(site, command, options):
    arguments = ["adapter", command, "--url", site.url, "--port", "0", *options]
    process = subprocess.Popen(
        [sys.executable, "-m", "real2sim", *arguments], stdout=subprocess.PIPE, text=True
    )
    said = process.stdout.readline()
    try:
        assert re.search(r"interface at 127\.0\.0\.1:\d+, pictures from http://127", said)
    finally:
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, rest) == (0, "")
