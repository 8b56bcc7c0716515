"""AlpaSim's renderer interface (NVIDIA 2025): gRPC, ``SensorsimService``.

AlpaSim's runtime drives and requests images; this renderer takes them from a worker's scenes
instead of the closed renderer. Cameras are pinholes with a global shutter, as reported by
``get_available_cameras``. F-theta, fisheye, lens distortion, windshields, lidars and ego masks are
refused by name. Requires the ``alpasim`` extra.
"""

from __future__ import annotations

import importlib
import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim_proto.scenes import CameraInfo, SceneState

from .._alpasim import GLOBAL_SHUTTER, MAX_MESSAGE_BYTES, RENDERER, RENDERER_METHODS, messages
from .._session_state import Matrix, pose_matrix, quaternion_of
from ..errors import CapacityError, NotFoundError, Real2SimError, UnreachableError
from ..planners.alpasim import ALPASIM_CAMERAS
from ..planners.peer import PeerError, cameras_for, looks_of
from ..version import VERSION
from .linked_scene import CameraView, LinkedScene, SceneLink

if TYPE_CHECKING:
    from .._sync.client import Client
    from ..images import Frame

API = (0, 54, 0)
"""Version of the supported messages, as numbered by AlpaSim."""
THREADS = 8
CODECS = {0: "png", 1: "png", 2: "jpeg", 4: "raw"}
"""Codecs by AlpaSim's image format number; 0 is unspecified, and 4 is planar RGB."""
PLANAR = 4
DEFAULT_QUALITY = 95

log = logging.getLogger(__name__)


class Refusal(Exception):
    """A refused request.

    Attributes:
        status: gRPC's status name.
    """

    def __init__(self, status: str, said: str) -> None:
        super().__init__(said)
        self.status = status


class AlpasimRenderer:
    """Serves ``SensorsimService`` from a worker.

    Args:
        client: client of the worker.
        links: links by AlpaSim's scene id; empty: every scene of the worker under its own name.
        strict: refuse objects that the scene lacks; else skip each with a warning.

    Raises:
        PeerError: the ``alpasim`` extra is not installed.
    """

    def __init__(
        self,
        client: Client,
        *,
        links: Mapping[str, SceneLink] | None = None,
        strict: bool = False,
    ) -> None:
        try:
            self._grpc, self._messages = importlib.import_module("grpc"), messages()
        except ImportError as error:
            raise PeerError(
                "AlpaSim's renderer interface needs the alpasim extra: "
                "pip install 'real2sim[alpasim]'"
            ) from error
        self._client, self._links, self._strict = client, dict(links or {}), strict
        self._scenes: dict[str, LinkedScene] = {}
        self._opening = threading.Lock()
        self._missing: set[tuple[str, str]] = set()
        self._server: Any = None

    def start(self, address: str = "127.0.0.1:8080") -> int:
        """Listen and return the port. Raises PeerError if that fails."""
        sizes = ("grpc.max_send_message_length", "grpc.max_receive_message_length")
        self._server = self._grpc.server(
            ThreadPoolExecutor(THREADS, thread_name_prefix="alpasim"),
            options=[*((name, MAX_MESSAGE_BYTES) for name in sizes), ("grpc.so_reuseport", 0)],
        )
        handlers = {name: self._handler(name, *pair) for name, pair in RENDERER_METHODS.items()}
        generic = self._grpc.method_handlers_generic_handler(RENDERER, handlers)
        self._server.add_generic_rpc_handlers((generic,))
        try:
            port: int = self._server.add_insecure_port(address)
        except RuntimeError as error:
            raise PeerError(f"cannot listen at {address}: {error}") from error
        self._server.start()
        return port

    def stop(self, grace: float = 2.0) -> None:
        """Finish running requests, and stop listening."""
        self._server.stop(grace).wait()

    # --- the calls ------------------------------------------------------------------------------

    def _get_version(self, _request: Any) -> Any:
        m = self._messages
        major, minor, patch = API
        api = m.APIVersion(major=major, minor=minor, patch=patch)
        return m.VersionId(
            version_id=f"real2sim-{VERSION}", git_hash="unknown", grpc_api_version=api
        )

    def _get_available_scenes(self, _request: Any) -> Any:
        return self._messages.AvailableScenesReturn(scene_ids=sorted(self._known()))

    def _get_loaded_scenes(self, _request: Any) -> Any:
        m, known = self._messages, self._known()
        states = {info.scene: info.state for info in self._client.scenes.list()}
        loaded = [i for i in sorted(known) if states.get(known[i].scene) is SceneState.RESIDENT]
        # A loaded scene serves any number of rollouts.
        entries = [
            m.LoadedSceneEntry(scene_id=i, loaded_instance_count=1, reusable_instance_count=1)
            for i in loaded
        ]
        return m.LoadedScenesReturn(scenes=entries, loaded_instance_capacity=max(1, len(known)))

    def _get_available_cameras(self, request: Any) -> Any:
        m, scene = self._messages, self._scene(request.scene_id)
        available = []
        for name, camera in _cameras(scene).items():
            spec = m.CameraSpec(
                logical_id=name,
                resolution_h=camera.height,
                resolution_w=camera.width,
                shutter_type=GLOBAL_SHUTTER,
            )
            K = camera.K
            spec.opencv_pinhole_param.CopyFrom(
                m.OpenCVPinholeCameraParam(
                    principal_point_x=K[0][2],
                    principal_point_y=K[1][2],
                    focal_length_x=K[0][0],
                    focal_length_y=K[1][1],
                )
            )
            # Despite its name this is the camera's pose in the rig.
            pose = self._pose(np.array(camera.T_vehicle_camera))
            available.append(
                m.AvailableCamera(intrinsics=spec, rig_to_camera=pose, logical_id=name)
            )
        return m.AvailableCamerasReturn(available_cameras=available)

    def _get_available_trajectories(self, request: Any) -> Any:
        m, scene = self._messages, self._scene(request.scene_id)
        ego, poses = scene.info.ego, []
        if ego is not None:
            for t_us, *pair in zip(ego.times_us, ego.positions, ego.quaternions, strict=True):
                pose = self._pose(scene.to_theirs(pose_matrix(*pair)))
                poses.append(m.PoseAtTime(pose=pose, timestamp_us=scene.their_time(t_us)))
        recorded = m.AvailableTrajectory(trajectory=m.Trajectory(poses=poses))
        return m.AvailableTrajectoriesReturn(available_trajectories=[recorded])

    def _get_available_ego_masks(self, _request: Any) -> Any:
        return self._messages.AvailableEgoMasksReturn()

    def _render_rgb(self, request: Any) -> Any:
        (image,) = self._images([request])
        return self._messages.RGBRenderReturn(image_bytes=image)

    def _batch_render_rgb(self, request: Any) -> Any:
        m = self._messages
        answers = []
        for name, image in self._each(request.items):
            answer = m.BatchRGBRenderReturnItem(camera_name=name)
            if isinstance(image, Refusal):
                answer.error_message = f"{image.status}: {image}"
            else:
                answer.success = True
                answer.result.image_bytes = image
            answers.append(answer)
        return m.BatchRGBRenderReturn(items=answers)

    def _render_aggregated(self, request: Any) -> Any:
        if request.lidar_requests:
            raise _no_lidar()
        m = self._messages
        images = self._images(request.rgb_requests)
        returns = [m.RGBRenderReturn(image_bytes=image) for image in images]
        return m.AggregatedRenderReturn(rgb_returns=returns)

    def _render_lidar(self, _request: Any) -> Any:
        raise _no_lidar()

    # --- images ---------------------------------------------------------------------------------

    def _each(self, items: Sequence[Any]) -> list[tuple[str, bytes | Refusal]]:
        """The image of each item of a batch, or the reason for its failure."""
        try:
            images: Sequence[bytes | Refusal] = self._images([item.request for item in items])
        except Exception:
            # One failed image must not fail the batch.
            images = [self._alone(item.request) for item in items]
        return [(item.camera_name, image) for item, image in zip(items, images, strict=True)]

    def _alone(self, request: Any) -> bytes | Refusal:
        try:
            return self._images([request])[0]
        except Exception as error:
            return refusal_of(error)

    def _images(self, requests: Sequence[Any]) -> list[bytes]:
        """Images of the requests; requests for the same instant share a call to the worker."""
        images: dict[int, bytes] = {}
        for members in _instants(requests).values():
            first = requests[members[0]]
            scene = self._scene(first.scene_id)
            frames = scene.pictures(
                [self._camera_view(scene, requests[k]) for k in members],
                their_us=first.frame_end_us,
                poses=self._objects(scene, first),
                others="parked",
            )
            for k, frame in zip(members, frames, strict=True):
                images[k] = _image_bytes(frame, requests[k].image_format)
        return [images[k] for k in range(len(requests))]

    def _camera_view(self, scene: LinkedScene, request: Any) -> CameraView:
        spec = request.camera_intrinsics
        _check_supported(request, spec)
        if spec.HasField("opencv_pinhole_param"):
            lens = spec.opencv_pinhole_param
            K = np.array(
                [
                    [lens.focal_length_x, 0.0, lens.principal_point_x],
                    [0.0, lens.focal_length_y, lens.principal_point_y],
                    [0.0, 0.0, 1.0],
                ]
            )
            native = (
                spec.resolution_w or request.resolution_w,
                spec.resolution_h or request.resolution_h,
            )
        else:
            camera = _camera_named(scene, spec.logical_id)
            K, native = np.array(camera.K), (camera.width, camera.height)
        width, height, scale_x, scale_y = _size(request, *native)
        K = np.diag([scale_x, scale_y, 1.0]) @ K
        quality = round(request.image_quality) or DEFAULT_QUALITY
        return CameraView(
            width=width,
            height=height,
            K=K,
            pose=_end_of(request.sensor_pose, "sensor_pose"),
            codec=CODECS[request.image_format],  # type: ignore[arg-type]
            quality=min(max(quality, 1), 100),
        )

    def _objects(self, scene: LinkedScene, request: Any) -> dict[str, Matrix]:
        poses: dict[str, Matrix] = {}
        for found in request.dynamic_objects:
            object_id = scene.objects.get(found.track_id)
            if object_id is not None:
                poses[object_id] = _end_of(found.pose_pair, f"the pose of {found.track_id!r}")
            elif self._strict:
                raise Refusal(
                    "INVALID_ARGUMENT",
                    f"scene {request.scene_id!r} has no object {found.track_id!r}; it has "
                    f"{', '.join(list(scene.objects)[:20]) or 'none'}",
                )
            elif (missing := (request.scene_id, found.track_id)) not in self._missing:
                self._missing.add(missing)
                log.warning("scene %r has no object %r; it is not drawn", *missing)
        return poses

    # --- scenes ---------------------------------------------------------------------------------

    def _known(self) -> dict[str, SceneLink]:
        if self._links:
            return self._links
        return {info.scene: SceneLink(scene=info.scene) for info in self._client.scenes.list()}

    def _scene(self, scene_id: str) -> LinkedScene:
        with self._opening:
            if scene_id not in self._scenes:
                known = self._known()
                if scene_id not in known:
                    there = ", ".join(sorted(known)) or "none"
                    raise Refusal("NOT_FOUND", f"no scene {scene_id!r}; there are {there}")
                self._scenes[scene_id] = LinkedScene(self._client, known[scene_id])
            return self._scenes[scene_id]

    def _pose(self, matrix: Matrix) -> Any:
        m = self._messages
        w, x, y, z = quaternion_of(matrix[:3, :3])
        px, py, pz = matrix[:3, 3].tolist()
        return m.Pose(vec=m.Vec3(x=px, y=py, z=pz), quat=m.Quat(w=w, x=x, y=y, z=z))

    def _handler(self, name: str, request: str, answer: str) -> Any:
        serve: Callable[[Any], Any] = getattr(self, f"_{name}")

        def handle(asked: Any, context: Any) -> Any:
            try:
                return serve(asked)
            except Exception as error:
                refusal = refusal_of(error)
                log.warning("%s: %s, %s", name, refusal.status, refusal)
                context.abort(self._grpc.StatusCode[refusal.status], str(refusal))

        return self._grpc.unary_unary_rpc_method_handler(
            handle,
            request_deserializer=getattr(self._messages, request).FromString,
            response_serializer=getattr(self._messages, answer).SerializeToString,
        )


def refusal_of(error: Exception) -> Refusal:
    """The gRPC status and details of an error."""
    if isinstance(error, Refusal):
        return error
    status = "INTERNAL"
    if isinstance(error, NotFoundError):
        status = "NOT_FOUND"
    elif isinstance(error, UnreachableError):
        status = "UNAVAILABLE"
    elif isinstance(error, CapacityError):
        status = "RESOURCE_EXHAUSTED"
    elif isinstance(error, ValueError):
        status = "INVALID_ARGUMENT"
    hint = getattr(error, "hint", None)
    said = str(error) if isinstance(error, Real2SimError | ValueError) else repr(error)
    return Refusal(status, f"{said} ({hint})" if hint else said)


def _cameras(scene: LinkedScene) -> dict[str, CameraInfo]:
    """Cameras by name: the link's names, AlpaSim's for similar directions, and the scene's own."""
    own = {camera.name: camera for camera in scene.info.cameras}
    looks, given = looks_of(scene.info.cameras), scene.link.cameras
    named: dict[str, CameraInfo] = {}
    for name in {**given, **({} if given else ALPASIM_CAMERAS)}:
        try:
            chosen = cameras_for([name], looks, known=ALPASIM_CAMERAS, given=given)[name]
        except PeerError:
            if name in given:
                raise
            continue
        named[name] = _narrowed(own[chosen], name)
    return own | named


def _narrowed(camera: CameraInfo, name: str) -> CameraInfo:
    """The camera, cropped to the field of view of AlpaSim's camera of that name if it is wider."""
    known = ALPASIM_CAMERAS.get(name)
    focal = camera.width / (2 * math.tan(known.field / 2)) if known else 0.0
    (fx, skew, _), (_, fy, _), last = camera.K
    if focal <= fx:
        return camera
    K = [
        [focal, skew, camera.width / 2],
        [0.0, fy * focal / fx, camera.height / 2],
        list(last),
    ]
    return camera.model_copy(update={"K": K})


def _camera_named(scene: LinkedScene, name: str) -> CameraInfo:
    found = _cameras(scene)
    if name not in found:
        raise Refusal(
            "INVALID_ARGUMENT",
            f"camera_intrinsics name no camera model, and {name!r} is none of {', '.join(found)}",
        )
    return found[name]


def _instants(requests: Sequence[Any]) -> dict[tuple[str, int, bytes], list[int]]:
    """Indices of requests that differ only in their cameras."""
    groups: dict[tuple[str, int, bytes], list[int]] = {}
    for k, request in enumerate(requests):
        objects = b"\0".join(o.SerializeToString() for o in request.dynamic_objects)
        groups.setdefault((request.scene_id, request.frame_end_us, objects), []).append(k)
    return groups


def _check_supported(request: Any, spec: Any) -> None:
    unsupported = {
        "ftheta_param": "f-theta cameras",
        "opencv_fisheye_param": "fisheye cameras",
        "bivariate_windshield_model_param": "windshields",
    }
    for member, what in unsupported.items():
        if spec.HasField(member):
            raise Refusal(
                "UNIMPLEMENTED",
                f"{what} are not drawn, pinhole cameras are; see get_available_cameras",
            )
    lens = spec.opencv_pinhole_param
    if any([*lens.radial_coeffs, *lens.tangential_coeffs, *lens.thin_prism_coeffs]):
        raise Refusal("UNIMPLEMENTED", "lens distortion is not drawn; send no coefficients")
    if request.insert_ego_mask:
        raise Refusal("INVALID_ARGUMENT", "there are no ego masks; see get_available_ego_masks")
    if request.image_format not in CODECS:
        raise Refusal(
            "UNIMPLEMENTED",
            f"image format {request.image_format} is not made; ask for PNG, JPEG or planar RGB",
        )


def _size(request: Any, native_width: int, native_height: int) -> tuple[int, int, float, float]:
    """Width and height [px], and their scale factors relative to the native ones.

    As in AlpaSim's renderer, the height is the requested one, and the width keeps the native
    aspect.
    """
    if not (native_width and native_height):
        raise Refusal("INVALID_ARGUMENT", "camera_intrinsics give no resolution")
    height = request.resolution_h or native_height
    width = max(1, round(native_width * height / native_height))
    return width, height, width / native_width, height / native_height


def _end_of(pair: Any, what: str) -> Matrix:
    """The pose at the end of a frame, which is AlpaSim's timestamp of the frame."""
    pose = pair.end_pose if pair.HasField("end_pose") else pair.start_pose
    q, v = pose.quat, pose.vec
    quaternion = np.array([q.w, q.x, q.y, q.z], dtype=np.float64)
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite([v.x, v.y, v.z]).all() and 0.5 < norm < 2.0):
        raise Refusal("INVALID_ARGUMENT", f"{what} is not a pose: {quaternion.tolist()} wxyz")
    return pose_matrix((v.x, v.y, v.z), (quaternion / norm).tolist())


def _image_bytes(frame: Frame, image_format: int) -> bytes:
    if image_format == PLANAR:
        return np.ascontiguousarray(frame.array.transpose(2, 0, 1)).tobytes()
    return frame.data


def _no_lidar() -> Refusal:
    return Refusal("UNIMPLEMENTED", "lidars are not drawn")
