"""A worker without scenes that speaks the protocol over a real socket, and misbehaves on request.

The vehicle follows its plans exactly. One camera shows a grey ramp.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import simplejpeg
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.drive import CLIENT_MESSAGE, Action, Edit, Hello, Render, Reset, ResetSpec
from real2sim_proto.operations import Delete, Duplicate
from real2sim_proto.scenarios import OperationBatch
from tests.waiting import wait_until, wait_until_async

from .fake_episode import CAMERA, IMAGE, Episode, frame

OBJECT = {
    "object_id": "car_3",
    "category": "car",
    "size": (4.5, 1.9, 1.6),
    "instance_id": 1,
    "gaussians": 100,
    "start_us": 0,
    "end_us": 10_000_000,
}
SHORT_S = 0.05
"""Timeout that tests let expire [s]. Never used for an answer that must arrive."""
SCENE = {"scene": "street", "state": "resident", "cameras": [CAMERA], "objects": [OBJECT]}


class FakeWorker:
    """State of the fake worker. Set ``mischief`` to make it misbehave.

    Attributes:
        goes_on: set by a test to let delayed answers through.
    """

    def __init__(self) -> None:
        self.url = ""
        self.forget()
        self.app = Starlette(
            routes=[
                Route("/readyz", self.ready),
                Route("/v1/server", self.server),
                Route("/v1/scenes", self.scenes),
                Route("/v1/scenes/street/render", self.render),
                Route("/v1/scenarios", self.create_scenario, methods=["POST"]),
                Route("/v1/scenarios/{id}", self.scenario),
                Route("/v1/scenarios/{id}", self.delete_scenario, methods=["DELETE"]),
                Route("/v1/scenarios/{id}/operations", self.edit, methods=["POST"]),
                Route("/v1/sessions", self.create_session, methods=["POST"]),
                Route("/v1/sessions/{id}", self.delete_session, methods=["DELETE"]),
                WebSocketRoute("/v1/sessions/{id}/drive", self.drive),
            ]
        )

    def forget(self) -> None:
        """Reset the state."""
        self.mischief = ""
        self.goes_on = False
        self.requests: list[tuple[str, str, dict[str, str]]] = []
        self.messages: list[dict[str, Any]] = []
        self.deleted: list[str] = []
        self.objects: dict[str, dict[str, Any]] = {"car_3": OBJECT}
        self.log: list[dict[str, Any]] = []

    @contextmanager
    def running(self) -> Iterator[FakeWorker]:
        """Serve on a free local port in a thread."""
        listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        config = uvicorn.Config(
            self.app,
            ws="websockets-sansio",
            log_config=None,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        wait_until(lambda: server.started or not thread.is_alive(), "the worker to start")
        assert server.started
        try:
            yield self
        finally:
            server.should_exit = True
            thread.join()
            listener.close()

    # --- REST -----------------------------------------------------------------------------

    async def ready(self, request: Request) -> Response:
        return JSONResponse({"ready": True})

    async def server(self, request: Request) -> Response:
        limits = dict.fromkeys(
            (
                "max_sessions",
                "max_request_bytes",
                "max_message_bytes",
                "max_operations_per_request",
                "max_cameras_per_step",
                "max_pixels_per_step",
                "max_steps_per_request",
                "scene_memory_bytes",
                "queue_length",
            ),
            8,
        )
        return JSONResponse(
            {
                "version": "0.1.0",
                "protocol_version": 1,
                "subprotocols": [DRIVE_SUBPROTOCOL],
                "worker_id": "w0",
                "device": {"backend": "fake", "reason": "test", "device": "cpu", "threads": 1},
                "limits": limits,
                "codecs": ["raw", "jpeg"],
                "modalities": ["rgb"],
                "conventions": {},
            }
        )

    async def scenes(self, request: Request) -> Response:
        self._note(request)
        return JSONResponse({"scenes": [SCENE]})

    async def render(self, request: Request) -> Response:
        self._note(request)
        if request.headers["accept"] == "image/jpeg":
            return Response(simplejpeg.encode_jpeg(IMAGE), media_type="image/jpeg")
        return Response(encode(frame("raw")), media_type="application/msgpack")

    async def create_scenario(self, request: Request) -> Response:
        self._note(request)
        return JSONResponse(self._scenario_info(), 201)

    async def scenario(self, request: Request) -> Response:
        return JSONResponse(self._scenario_info())

    async def delete_scenario(self, request: Request) -> Response:
        self.deleted.append(request.path_params["id"])
        return Response(status_code=204)

    async def edit(self, request: Request) -> Response:
        self._note(request)
        revision = len(self.log)
        if request.headers["if-match"] != f'"r{revision}"':
            return self._stale(request)
        batch = OperationBatch.model_validate_json(await request.body())
        if self.mischief == "refuses edits":
            return _problem(422, "INVALID_OPERATION", "refused by the test")
        if batch.dry_run:
            return JSONResponse({"revision": revision, "etag": f'"r{revision}"', "dry_run": True})
        created = []
        for op in batch.operations:
            if isinstance(op, Duplicate):
                created.append(op.new_id or f"{op.object_id}_copy1")
                self.objects[created[-1]] = OBJECT | {"object_id": created[-1]}
            elif isinstance(op, Delete):
                del self.objects[op.object_id]
        self.record([op.model_dump(mode="json") for op in batch.operations])
        answer = {"revision": revision + 1, "etag": f'"r{revision + 1}"', "created": created}
        return JSONResponse(answer)

    def record(self, operations: list[dict[str, Any]]) -> None:
        """Append to the history, as if another client had edited."""
        self.log.append(
            {
                "revision": len(self.log) + 1,
                "kind": "edit",
                "operations": operations,
                "created_at": "2026-01-01T00:00:00Z",
            }
        )

    async def create_session(self, request: Request) -> Response:
        self._note(request)
        info = {
            "session_id": "w0.abc",
            "scene": "street",
            "ws_url": "ws://unreachable.invalid/drive",
            "token": "session-secret",
            "created_at": "2026-01-01T00:00:00Z",
            "reset": ResetSpec().model_dump(mode="json"),
        }
        return JSONResponse(info, 201)

    async def delete_session(self, request: Request) -> Response:
        self.deleted.append(request.path_params["id"])
        return Response(status_code=204)

    def _note(self, request: Request) -> None:
        self.requests.append((request.method, request.url.path, dict(request.headers)))

    def _scenario_info(self) -> dict[str, Any]:
        return {
            "scenario_id": "sc_1",
            "name": "",
            "scene": "street",
            "scene_hash": "00",
            "revision": len(self.log),
            "etag": f'"r{len(self.log)}"',
            "created_at": "2026-01-01T00:00:00Z",
            "can_undo": bool(self.log),
            "can_redo": False,
            "objects": list(self.objects.values()),
        }

    def _stale(self, request: Request) -> Response:
        seen = int(request.headers["if-match"].strip('"r'))
        return JSONResponse(
            {
                "title": "Stale revision",
                "status": 412,
                "code": "STALE_REVISION",
                "detail": f"the edit was made for revision {seen}",
                "revision": len(self.log),
                "missed": self.log[seen:],
            },
            412,
            media_type="application/problem+json",
        )

    # --- drive socket ---------------------------------------------------------------------

    async def drive(self, socket: WebSocket) -> None:
        if self.mischief == "426 at the handshake":
            problem = {
                "status": 426,
                "code": "UNSUPPORTED_PROTOCOL",
                "detail": "the client offers real2sim.v1.msgpack; this worker speaks real2sim.v9",
                "hint": "install a newer client",
            }
            await socket.send_denial_response(JSONResponse(problem, 426))
            return
        chosen = None if self.mischief == "no subprotocol" else DRIVE_SUBPROTOCOL
        await socket.accept(subprotocol=chosen)
        episode = Episode()
        try:
            while True:
                await self._answer(socket, episode, decode(await socket.receive_bytes()))
        except WebSocketDisconnect:
            return

    async def _answer(self, socket: WebSocket, episode: Episode, fields: dict[str, Any]) -> None:
        self.messages.append(fields)
        message = CLIENT_MESSAGE.validate_python(fields)
        if isinstance(message, Hello):
            answer = self._welcome()
        elif isinstance(message, Reset):
            answer = episode.reset(message.spec)
        elif isinstance(message, Action):
            if await self._misbehave(socket, message):
                return
            answer = episode.step(message)
        elif isinstance(message, Edit):
            episode.revision += 1
            answer = {"type": "edited", "revision": episode.revision, "created": ["car_3_copy1"]}
        elif isinstance(message, Render):
            if self.mischief == "late images":
                await asyncio.sleep(5 * SHORT_S)  # Longer than the reply timeout of the test.
            answer = {
                "type": "view",
                "t_us": episode.t_us,
                "revision": episode.revision,
                "frames": [frame(s.codec) for s in message.sensors],
            }
        else:
            answer = {
                "type": "result",
                "steps": episode.count,
                "t_us": episode.t_us,
                "reason": "bye",
                "metrics": {"progress": 1.0},
            }
        await socket.send_bytes(encode(answer | {"v": 1, "id": message.id}))

    def _welcome(self) -> dict[str, Any]:
        if self.mischief == "error after hello":
            return {
                "type": "error",
                "code": "UNSUPPORTED_PROTOCOL",
                "detail": "the client offers x; this worker speaks y",
                "fatal": True,
            }
        return {
            "type": "welcome",
            "protocol": DRIVE_SUBPROTOCOL,
            "session_id": "w0.abc",
            "role": "controller",
            "versions": {"server": "0.1.0"},
            "limits": {},
            "cameras": [CAMERA],
            "objects": [OBJECT | {"size": list(OBJECT["size"])}],
            "start_us": 0,
            "end_us": 10_000_000,
            "step": None,
        }

    async def _misbehave(self, socket: WebSocket, action: Action) -> bool:
        """Whether the message has been answered or will not be answered."""
        mischief, self.mischief = self.mischief, ""
        envelope = {"v": 1, "id": action.id}
        match mischief:
            case "hang":
                return True
            case "late":
                # The client has timed out by now, so it gets two answers.
                await wait_until_async(lambda: self.goes_on, "the test to go on")
                return False
            case "restart":
                await socket.close(1012, "restarting")
                raise WebSocketDisconnect
            case "garbage":
                await socket.send_bytes(b"\xc1\xff\x00")
                return True
            case "text":
                await socket.send_text("{}")
                return True
            case "another type":
                answer = {"type": "edited", "revision": 1}
            case "missing fields":
                answer = {"type": "obs", "step": 1}
            case "version 2":
                answer = {"type": "obs", "v": 2}
            case "progress":
                await socket.send_bytes(
                    encode({"type": "progress", "phase": "compiling", "eta_s": 1.0} | envelope)
                )
                return False
            case "":
                return False
            case code:
                code, _, retry = code.partition(" ")
                answer = {"type": "error", "code": code, "detail": "refused by the test", "step": 7}
                answer |= {"retry_after_s": 7} if retry else {}
        await socket.send_bytes(encode(envelope | answer))
        return True


def _problem(status: int, code: str, detail: str) -> Response:
    content = {"title": code, "status": status, "code": code, "detail": detail}
    return JSONResponse(content, status, media_type="application/problem+json")
