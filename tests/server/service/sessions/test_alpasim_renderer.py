"""The AlpaSim SensorsimService of a worker, called as AlpaSim's runtime does.

If REAL2SIM_ALPASIM names a checkout of NVlabs/alpasim, messages and stubs are compiled from its
protos (needs grpcio-tools). The same calls also run with this repository's messages.
"""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import cv2
import grpc
import numpy as np
import pytest
import simplejpeg

import real2sim
from real2sim._alpasim import RENDERER, RENDERER_METHODS, messages
from real2sim.renderers.alpasim import AlpasimRenderer
from real2sim.renderers.linked_scene import SceneLink
from real2sim_server.geometry import (
    invert_transform,
    matrix_to_quaternion,
    quaternion_to_matrix,
)

pytestmark = pytest.mark.network

PNG, JPEG, PLANAR, AV1 = 1, 2, 4, 6
SHIFTED = np.array([[0.0, -1, 0, 5], [1, 0, 0, -3], [0, 0, 1, 2], [0, 0, 0, 1]])
"""T_world_theirs of a scene for which the other simulator uses a different world frame."""
LATER = 1_700_000_000_000_000


@pytest.fixture
def renderer(site):
    with real2sim.connect(site.url) as client:
        links = {
            "clip": SceneLink(scene="tiny"),
            "elsewhere": SceneLink(
                scene="tiny",
                T_world_theirs=tuple(map(tuple, SHIFTED.tolist())),
                offset_us=LATER,
                cameras={"camera_front_wide_120fov": "front"},
                objects={"17": "car_red"},
            ),
        }
        served = AlpasimRenderer(client, links=links)
        served.target = f"127.0.0.1:{served.start('127.0.0.1:0')}"
        yield served
        served.stop(0)


def our_side(channel):
    made = messages()
    calls = {
        name: channel.unary_unary(
            f"/{RENDERER}/{name}",
            request_serializer=getattr(made, request).SerializeToString,
            response_deserializer=getattr(made, answer).FromString,
        )
        for name, (request, answer) in RENDERER_METHODS.items()
    }
    return made, SimpleNamespace(**calls)


def their_side(channel, folder: Path):
    checkout = os.environ.get("REAL2SIM_ALPASIM")
    if not checkout:
        pytest.skip("REAL2SIM_ALPASIM names no checkout of NVlabs/alpasim")
    protoc = pytest.importorskip("grpc_tools.protoc")
    source = Path(checkout) / "src/grpc"
    # The package's own __init__ looks up its installed version.
    (folder / "alpasim_grpc/v0").mkdir(parents=True, exist_ok=True)
    for proto in ("common", "sensorsim"):
        path = source / f"alpasim_grpc/v0/{proto}.proto"
        shutil.copy(path, folder / f"alpasim_grpc/v0/{proto}.proto")
        arguments = [f"-I{source}", f"--python_out={folder}", f"--grpc_python_out={folder}"]
        assert protoc.main(["protoc", *arguments, str(path)]) == 0
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    common, pb2, stubs = (
        importlib.import_module(f"alpasim_grpc.v0.{name}")
        for name in ("common_pb2", "sensorsim_pb2", "sensorsim_pb2_grpc")
    )
    return SimpleNamespace(**vars(common) | vars(pb2)), stubs.SensorsimServiceStub(channel)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    return tmp_path_factory.mktemp("protos")


@pytest.fixture(params=["our messages", "their protos"])
def runtime(request, renderer, compiled):
    """Messages and stub on the AlpaSim side."""
    with grpc.insecure_channel(renderer.target) as channel:
        if request.param == "our messages":
            yield our_side(channel)
        else:
            yield their_side(channel, compiled)


@pytest.fixture
def ours(renderer):
    with grpc.insecure_channel(renderer.target) as channel:
        yield our_side(channel)


def pose_of(m, matrix):
    w, x, y, z = matrix_to_quaternion(matrix[:3, :3])
    px, py, pz = matrix[:3, 3]
    return m.Pose(vec=m.Vec3(x=px, y=py, z=pz), quat=m.Quat(w=w, x=x, y=y, z=z))


def matrix_of(pose):
    matrix = np.eye(4)
    q, v = pose.quat, pose.vec
    matrix[:3, :3] = quaternion_to_matrix(np.array([q.w, q.x, q.y, q.z], float))
    matrix[:3, 3] = (v.x, v.y, v.z)
    return matrix


def pair(m, matrix):
    return m.PosePair(start_pose=pose_of(m, matrix), end_pose=pose_of(m, matrix))


def asked(m, stub, *, scene="clip", camera="front", rig=None, t_us=0, objects=(), **fields):
    """A request as AlpaSim's runtime builds it from the available cameras."""
    available = stub.get_available_cameras(m.AvailableCamerasRequest(scene_id=scene))
    (found,) = [c for c in available.available_cameras if c.logical_id == camera]
    rig = np.eye(4) if rig is None else rig
    return m.RGBRenderRequest(
        **{
            "scene_id": scene,
            "resolution_h": found.intrinsics.resolution_h,
            "resolution_w": found.intrinsics.resolution_w,
            "camera_intrinsics": found.intrinsics,
            "frame_start_us": t_us,
            "frame_end_us": t_us,
            "sensor_pose": pair(m, rig @ matrix_of(found.rig_to_camera)),
            "dynamic_objects": [
                m.DynamicObject(track_id=name, pose_pair=pair(m, matrix))
                for name, matrix in objects
            ],
            "image_format": PNG,
            "image_quality": 95,
        }
        | fields
    )


def pixels(answer):
    return cv2.cvtColor(
        cv2.imdecode(np.frombuffer(answer.image_bytes, np.uint8), cv2.IMREAD_COLOR),
        cv2.COLOR_BGR2RGB,
    )


def placed(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = (x, y, z)
    return pose


def as_recorded(scene, t_us, *, but=()):
    moving = [o for o in scene.objects.values() if o.trajectory.moves and o.object_id not in but]
    return [(o.object_id, o.trajectory.transform(t_us)) for o in moving]


def test_a_rollout_frame_equals_the_worker_render(site, runtime, tiny_scene):
    m, stub = runtime
    for t_us in (0, 1_000_000):
        rig = tiny_scene.ego.transform(t_us)
        request = asked(m, stub, rig=rig, t_us=t_us, objects=as_recorded(tiny_scene, t_us))
        with real2sim.connect(site.url) as client:
            drawn = client.scenes.render("tiny", camera="front", t_us=t_us, codec="raw").array
        difference = np.abs(pixels(stub.render_rgb(request)).astype(int) - drawn)
        # AlpaSim sends single-precision numbers.
        assert difference.mean() < 0.2


def test_an_object_is_rendered_at_the_pose_of_the_runtime(runtime, tiny_scene):
    m, stub = runtime
    there = placed(12.0, 0.0, 0.75)
    before = pixels(stub.render_rgb(asked(m, stub)))
    after = pixels(stub.render_rgb(asked(m, stub, objects=[("car_red", there)])))
    front = tiny_scene.rig["front"]
    x, y, z = (front.viewmat(np.eye(4)) @ [12.0, 0.0, 0.75, 1.0])[:3]
    u, v, _ = front.K @ (x / z, y / z, 1.0)
    red, green, _ = after[int(v), int(u)].astype(int)
    assert red - green > 60
    red, green, _ = before[int(v), int(u)].astype(int)
    assert red - green < 30


def test_a_batch_returns_one_image_per_camera(runtime):
    m, stub = runtime
    items = [
        m.BatchRGBRenderRequestItem(camera_name=name, request=asked(m, stub, camera=name))
        for name in ("front", "left")
    ]
    answer = stub.batch_render_rgb(m.BatchRGBRenderRequest(items=items))
    assert [(i.camera_name, i.success) for i in answer.items] == [("front", True), ("left", True)]
    alone = stub.render_rgb(items[1].request)
    assert answer.items[1].result.image_bytes == alone.image_bytes


def test_a_failed_batch_item_does_not_affect_the_others(ours):
    m, stub = ours
    good, bad = asked(m, stub), asked(m, stub, image_format=AV1)
    items = [
        m.BatchRGBRenderRequestItem(camera_name=name, request=request)
        for name, request in (("bad", bad), ("good", good))
    ]
    first, second = stub.batch_render_rgb(m.BatchRGBRenderRequest(items=items)).items
    assert (first.success, second.success) == (False, True)
    assert first.error_message.startswith("UNIMPLEMENTED: image format 6")


def test_an_aggregated_request_returns_every_image(runtime):
    m, stub = runtime
    requests = [asked(m, stub, t_us=t_us) for t_us in (0, 100_000)]
    answer = stub.render_aggregated(m.AggregatedRenderRequest(rgb_requests=requests))
    assert len(answer.rgb_returns) == 2


def test_concurrent_rollouts_get_their_own_images(ours):
    m, stub = ours
    requests = [
        asked(m, stub, objects=[("car_red", placed(10.0 + 2 * k, 1.0, 0.75))]) for k in range(4)
    ]
    alone = [stub.render_rgb(request).image_bytes for request in requests]
    assert len(set(alone)) == 4
    with ThreadPoolExecutor(4) as pool:
        together = pool.map(lambda request: stub.render_rgb(request).image_bytes, requests * 3)
        assert list(together) == alone * 3


def test_available_and_loaded_scenes_are_listed(runtime):
    m, stub = runtime
    assert list(stub.get_available_scenes(m.Empty()).scene_ids) == ["clip", "elsewhere"]
    stub.render_rgb(asked(m, stub))
    loaded = stub.get_loaded_scenes(m.Empty())
    assert {s.scene_id: s.loaded_instance_count for s in loaded.scenes} == {
        "clip": 1,
        "elsewhere": 1,
    }
    assert loaded.loaded_instance_capacity == 2
    assert stub.get_version(m.Empty()).version_id.startswith("real2sim-")
    assert not stub.get_available_ego_masks(m.Empty()).ByteSize()


def test_cameras_get_alpasim_names_by_viewing_direction(ours, tiny_scene):
    m, stub = ours
    available = stub.get_available_cameras(m.AvailableCamerasRequest(scene_id="clip"))
    cameras = {c.logical_id: c for c in available.available_cameras}
    assert {"front", "left", "camera_front_wide_120fov", "camera_cross_left_120fov"} <= set(cameras)
    assert "camera_cross_right_120fov" not in cameras
    left = matrix_of(cameras["camera_cross_left_120fov"].rig_to_camera)
    np.testing.assert_allclose(left, tiny_scene.rig["left"].T_vehicle_camera, atol=1e-6)
    # The tele camera has the field of view in its name.
    spec = cameras["camera_front_tele_30fov"].intrinsics
    focal = spec.opencv_pinhole_param.focal_length_x
    assert 2 * np.arctan(spec.resolution_w / 2 / focal) == pytest.approx(np.radians(30))


def test_world_frame_clock_and_object_names_are_converted(ours, tiny_scene):
    m, stub = ours
    theirs = invert_transform(SHIFTED)
    same = {"resolution_h": 64}
    here = stub.render_rgb(asked(m, stub, objects=[("car_red", placed(12, 0, 0.75))], **same))
    there = stub.render_rgb(
        asked(
            m,
            stub,
            scene="elsewhere",
            camera="camera_front_wide_120fov",
            rig=theirs,
            t_us=LATER,
            objects=[("17", theirs @ placed(12, 0, 0.75))],
            **same,
        )
    )
    difference = np.abs(pixels(here).astype(int) - pixels(there))
    assert difference.mean() < 0.2
    request = m.AvailableTrajectoriesRequest(scene_id="elsewhere")
    (recorded,) = stub.get_available_trajectories(request).available_trajectories
    first, last = recorded.trajectory.poses[0], recorded.trajectory.poses[-1]
    assert (first.timestamp_us, last.timestamp_us) == (LATER, LATER + 2_000_000)
    expected = theirs @ tiny_scene.ego.transform(2_000_000)
    np.testing.assert_allclose(matrix_of(last.pose), expected, atol=1e-5)


def test_image_formats_and_sizes(ours):
    m, stub = ours
    jpeg = stub.render_rgb(asked(m, stub, image_format=JPEG)).image_bytes
    assert simplejpeg.decode_jpeg(jpeg).shape == (64, 96, 3)
    planar = stub.render_rgb(asked(m, stub, image_format=PLANAR)).image_bytes
    image = np.frombuffer(planar, np.uint8).reshape(3, 64, 96).transpose(1, 2, 0)
    assert np.array_equal(image, pixels(stub.render_rgb(asked(m, stub))))
    # Like AlpaSim's own renderer: use the requested height and keep the aspect ratio.
    half = stub.render_rgb(asked(m, stub, resolution_h=32, resolution_w=100))
    assert pixels(half).shape == (32, 48, 3)


def unsupported(m, request, change: str):
    spec = request.camera_intrinsics
    if change == "fisheye":
        spec.opencv_fisheye_param.SetInParent()
    elif change == "ftheta":
        spec.ftheta_param.SetInParent()
    elif change == "windshield":
        spec.bivariate_windshield_model_param.SetInParent()
    elif change == "distortion":
        spec.opencv_pinhole_param.radial_coeffs.extend([0.1, 0.0])
    elif change == "format":
        request.image_format = AV1
    elif change == "mask":
        request.insert_ego_mask = True
    elif change == "pose":
        request.sensor_pose.Clear()
    elif change == "scene":
        request.scene_id = "nowhere"
    return request


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        ("fisheye", "UNIMPLEMENTED", "fisheye cameras are not drawn"),
        ("ftheta", "UNIMPLEMENTED", "f-theta cameras are not drawn"),
        ("windshield", "UNIMPLEMENTED", "windshields are not drawn"),
        ("distortion", "UNIMPLEMENTED", "lens distortion is not drawn"),
        ("format", "UNIMPLEMENTED", "ask for PNG, JPEG or planar RGB"),
        ("mask", "INVALID_ARGUMENT", "there are no ego masks"),
        ("pose", "INVALID_ARGUMENT", "sensor_pose is not a pose"),
        ("scene", "NOT_FOUND", "no scene 'nowhere'; there are clip, elsewhere"),
    ],
)
def test_unsupported_requests_return_a_grpc_status(ours, change, status, said):
    m, stub = ours
    with pytest.raises(grpc.RpcError) as refused:
        stub.render_rgb(unsupported(m, asked(m, stub), change))
    assert refused.value.code().name == status
    assert said in refused.value.details()


def test_lidar_requests_are_unimplemented(ours):
    m, stub = ours
    for call in (
        lambda: stub.render_lidar(m.LidarRenderRequest()),
        lambda: stub.render_aggregated(
            m.AggregatedRenderRequest(lidar_requests=[m.LidarRenderRequest()])
        ),
    ):
        with pytest.raises(grpc.RpcError) as refused:
            call()
        assert refused.value.code() is grpc.StatusCode.UNIMPLEMENTED


def test_unknown_objects_are_ignored_or_refused_in_strict_mode(renderer, ours):
    m, stub = ours
    request = asked(m, stub, objects=[("ghost", placed(8, 0, 1))])
    assert stub.render_rgb(request).image_bytes == stub.render_rgb(asked(m, stub)).image_bytes
    renderer._strict = True
    with pytest.raises(grpc.RpcError) as refused:
        stub.render_rgb(request)
    assert "has no object 'ghost'; it has car_red" in refused.value.details()


def test_a_stopped_worker_is_reported_as_unavailable(own_site):
    lone = own_site()
    with real2sim.connect(lone.url, retries=0) as client:
        served = AlpasimRenderer(client)
        port = served.start("127.0.0.1:0")
        lone.stop()
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            m, stub = our_side(channel)
            with pytest.raises(grpc.RpcError) as refused:
                stub.get_available_scenes(m.Empty())
        served.stop(0)
    assert refused.value.code() is grpc.StatusCode.UNAVAILABLE
