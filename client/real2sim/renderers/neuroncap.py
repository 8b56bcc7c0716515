"""NeuroNCAP's renderer interface (Ljungbergh et al. 2024; NeuRAD's closed-loop server): HTTP.

NeuroNCAP drives and requests images of a worker's scene, through
``GET /alive``, ``GET /get_actors``, ``POST /update_actors``, ``POST /render_image`` and
``GET /start_time``. Like NeuRAD's server, it serves one scene and one run at a time. Its image
format ``raw`` is a tensor written by ``torch.save``, which requires torch in this process.
"""

from __future__ import annotations

import base64
import importlib
import io
import itertools
import json
import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from real2sim_proto.scenes import ObjectInfo

from .._calls import describe
from .._session_state import Matrix, pose_between, pose_matrix
from ..errors import NotFoundError, Real2SimError, UnreachableError
from ..planners.neuroncap import NUSCENES_CAMERAS
from ..planners.peer import Look, PeerError, cameras_for, looks_of
from .linked_scene import CameraView, LinkedScene, SceneLink, camera_names

if TYPE_CHECKING:
    from .._sync.client import Client
    from ..images import Frame

MAX_BODY = 256 * 1024 * 1024
NUSCENES_FIELD = math.radians(70)
LOOKS = {name: Look(turn, NUSCENES_FIELD) for name, turn in NUSCENES_CAMERAS.items()}
MEDIA_TYPES = {"raw": "text/plain", "png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg"}

log = logging.getLogger(__name__)

Rows = list[tuple[float, float, float, float]]


class _Actor(BaseModel):
    """An item of ``/update_actors``; unknown members are ignored."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    uuid: str
    timestamps: list[int] = Field(min_length=1)
    poses: list[Rows] = Field(min_length=1)


class _RenderInput(BaseModel):
    """Body of ``/render_image``."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    pose: Rows = Field(min_length=4, max_length=4)
    timestamp: int
    camera_name: str
    image_format: Literal["raw", "png", "jpg", "jpeg"] = "raw"


_ACTORS = TypeAdapter(list[_Actor])


@dataclass(frozen=True)
class Answer:
    """An HTTP response."""

    content: bytes
    media_type: str = "application/json"
    status: int = HTTPStatus.OK


@dataclass(frozen=True)
class ActorTrack:
    """An actor's motion in NeuroNCAP: times [N] [us], box centres ``T_world_object`` [N, 4, 4]."""

    times_us: list[int]
    poses: Matrix

    def at(self, t_us: int) -> Matrix | None:
        """Pose [4, 4] at a time; None if the actor does not exist then."""
        after = int(np.searchsorted(self.times_us, t_us))
        if after == len(self.times_us) or (after == 0 and self.times_us[0] != t_us):
            return None
        if self.times_us[after] == t_us:
            found: Matrix = self.poses[after]
            return found
        before, end = self.times_us[after - 1], self.times_us[after]
        fraction = (t_us - before) / (end - before)
        return pose_between(self.poses[after - 1], self.poses[after], fraction)


class NeuroNcapRenderer:
    """Serves NeuroNCAP's renderer interface from one scene of a worker.

    The actors are the scene's objects, under the ids of its log if the scene has them. They move as
    recorded until ``/update_actors``; from then on only the listed ones exist, at the listed poses.
    An object keeps its own size.
    """

    def __init__(self, client: Client, link: SceneLink) -> None:
        """Find the scene.

        Raises:
            NotFoundError: no such scene.
            PeerError: the link names a camera that the scene lacks.
        """
        self._scene = LinkedScene(client, link)
        self._cameras = {camera.name: camera for camera in self._scene.info.cameras}
        names = camera_names(link, LOOKS, self._scene.info)
        self._looks = looks_of(self._scene.info.cameras)
        self._camera_names = cameras_for(names, self._looks, known=LOOKS, given=names)
        self._theirs = {ours: theirs for theirs, ours in self._scene.objects.items()}
        self._tracks: dict[str, ActorTrack] | None = None
        self._changing = threading.Lock()
        self._server: ThreadingHTTPServer | None = None

    def start(self, host: str = "127.0.0.1", port: int = 8000) -> int:
        """Listen and return the port. Raises PeerError if that fails."""
        try:
            self._server = ThreadingHTTPServer((host, port), _handler_of(self.answer))
        except OSError as error:
            raise PeerError(f"cannot listen at {host}:{port}: {error}") from error
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return int(self._server.server_address[1])

    def stop(self) -> None:
        """Stop listening."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()

    def answer(self, method: str, path: str, body: bytes) -> Answer:
        """The response to a request; never raises."""
        routes: dict[tuple[str, str], Callable[[bytes], Answer]] = {
            ("GET", "/alive"): lambda _body: _json(True),
            ("GET", "/start_time"): lambda _body: _json(self._start_time()),
            ("GET", "/get_actors"): lambda _body: _json(self.listed()),
            ("POST", "/update_actors"): self._update_actors,
            ("POST", "/render_image"): self._render_image,
        }
        serve = routes.get((method, path))
        if serve is None:
            there = ", ".join(f"{m} {p}" for m, p in routes)
            return _refused(HTTPStatus.NOT_FOUND, f"no {method} {path}; there are {there}")
        try:
            return serve(body)
        except Exception as error:
            return _refused_for(error, f"{method} {path}")

    def listed(self) -> list[dict[str, Any]]:
        """The objects as ``/get_actors`` lists them."""
        return [self._actor(found) for found in self._scene.info.objects if found.trajectory]

    def _actor(self, found: ObjectInfo) -> dict[str, Any]:
        assert found.trajectory is not None
        track = found.trajectory
        poses = [
            pose_matrix(*pair) for pair in zip(track.positions, track.quaternions, strict=True)
        ]
        length, width, height = found.size
        recorded = {
            "timestamps": [self._scene.their_time(t_us) for t_us in track.times_us],
            "poses": self._scene.to_theirs(np.array(poses)).tolist(),
        }
        with self._changing:
            changed = (self._tracks or {}).get(found.object_id)
        if changed is not None:
            recorded = {"timestamps": changed.times_us, "poses": changed.poses.tolist()}
        dims = [width, length, height]
        return {"uuid": self._theirs[found.object_id], "dims": dims} | recorded

    def _start_time(self) -> int:
        return self._scene.their_time(self._scene.info.start_us)

    def _update_actors(self, body: bytes) -> Answer:
        tracks: dict[str, ActorTrack] = {}
        for actor in _ACTORS.validate_json(body):
            object_id = self._scene.objects.get(actor.uuid)
            if object_id is None:
                there = ", ".join(list(self._theirs.values())[:20]) or "none"
                raise ValueError(f"there is no actor {actor.uuid!r}; there are {there}")
            tracks[object_id] = _track(actor)
        with self._changing:
            self._tracks = tracks
        return _json(None)

    def _render_image(self, body: bytes) -> Answer:
        asked = _RenderInput.model_validate_json(body)
        camera = self._cameras[self._camera(asked.camera_name)]
        with self._changing:
            tracks = self._tracks
        moved = {name: track.at(asked.timestamp) for name, track in (tracks or {}).items()}
        codec = asked.image_format if asked.image_format in {"raw", "png"} else "jpeg"
        wanted = CameraView(
            width=camera.width,
            height=camera.height,
            K=np.array(camera.K),
            pose=_rigid(asked.pose, "pose"),
            codec=codec,
            quality=95,
        )
        (frame,) = self._scene.pictures(
            [wanted],
            their_us=asked.timestamp,
            poses={name: pose for name, pose in moved.items() if pose is not None},
            others="recorded" if tracks is None else "none",
        )
        content = _saved_tensor(frame) if asked.image_format == "raw" else bytes(frame.data)
        return Answer(content, MEDIA_TYPES[asked.image_format])

    def _camera(self, name: str) -> str:
        if name not in self._camera_names:
            self._camera_names |= cameras_for([name], self._looks, known=LOOKS, given={})
        return self._camera_names[name]


def _handler_of(answer: Callable[[str, str, bytes], Answer]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 60

        def do_GET(self) -> None:
            self._send(answer("GET", self.path.partition("?")[0], b""))

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdigit() or int(length) > MAX_BODY:
                self.close_connection = True
                self._send(_refused(HTTPStatus.BAD_REQUEST, "the body has no length that is taken"))
                return
            body = self.rfile.read(int(length))
            self._send(answer("POST", self.path.partition("?")[0], body))

        def _send(self, given: Answer) -> None:
            self.send_response(given.status)
            self.send_header("Content-Type", given.media_type)
            self.send_header("Content-Length", str(len(given.content)))
            self.end_headers()
            self.wfile.write(given.content)

        def log_message(self, format: str, *args: Any) -> None:
            log.debug(format, *args)

    return Handler


def _track(actor: _Actor) -> ActorTrack:
    times = actor.timestamps
    if len(times) != len(actor.poses) or any(a >= b for a, b in itertools.pairwise(times)):
        raise ValueError(
            f"actor {actor.uuid!r}: {len(times)} timestamps, which must increase, and "
            f"{len(actor.poses)} poses"
        )
    what = f"a pose of actor {actor.uuid!r}"
    return ActorTrack(times, np.array([_rigid(pose, what) for pose in actor.poses]))


def _rigid(rows: Sequence[Any], what: str) -> Matrix:
    pose = np.array(rows, dtype=np.float64)
    if pose.shape != (4, 4) or np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-2:
        raise ValueError(f"{what} is not a rigid transform [4, 4]: {pose.tolist()}")
    return pose


def _saved_tensor(frame: Frame) -> bytes:
    """A uint8 tensor [H, W, 3] by torch.save, in base64."""
    try:
        torch = importlib.import_module("torch")
    except ImportError as error:
        raise PeerError(
            "images in NeuroNCAP's raw form are torch tensors: pip install torch"
        ) from error
    file = io.BytesIO()
    torch.save(torch.from_numpy(np.array(frame.array, dtype=np.uint8)), file)
    return base64.b64encode(file.getvalue())


def _json(value: Any) -> Answer:
    return Answer(json.dumps(value).encode())


def _refused(status: HTTPStatus, said: str) -> Answer:
    log.warning("%d: %s", status, said)
    return Answer(json.dumps({"detail": said}).encode(), status=status)


def _refused_for(error: Exception, what: str) -> Answer:
    if isinstance(error, ValidationError):
        return _refused(HTTPStatus.UNPROCESSABLE_ENTITY, f"{what}: {describe(error)}")
    if isinstance(error, ValueError | NotFoundError) or (
        isinstance(error, PeerError) and "torch" not in str(error)
    ):
        return _refused(HTTPStatus.UNPROCESSABLE_ENTITY, f"{what}: {error}")
    if isinstance(error, UnreachableError):
        return _refused(HTTPStatus.BAD_GATEWAY, f"{what}: {error}")
    said = str(error) if isinstance(error, Real2SimError) else repr(error)
    return _refused(HTTPStatus.INTERNAL_SERVER_ERROR, f"{what}: {said}")
