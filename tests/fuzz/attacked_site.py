"""A worker under attack in this process, its resources, and a concurrent drive."""

from __future__ import annotations

import contextlib
import http.client
import json
import logging
import shutil
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import readers
import structlog
from websockets.sync.client import connect

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_server.scene.io import save_scene, write_splats
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.settings import Settings
from tests.waiting import LIMIT_S, wait_until

TOKEN = "a long enough secret"
DEAD_S = LIMIT_S
"""A worker silent for this long hangs, even on a busy machine [s]."""
PATIENT_S = 600
EPISODE_STEPS = 15
SENSOR = {"camera": "front", "width": 16, "codec": "raw"}


class Log:
    """Collects every error that the worker's process logs. None is expected.

    Attributes:
        errors: entries since the last :meth:`taken`.
    """

    def __init__(self) -> None:
        self.errors: list[str] = []
        structlog.configure(
            processors=[structlog.processors.format_exc_info, self._note],
            wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        )
        handler = logging.Handler(logging.ERROR)
        handler.setFormatter(logging.Formatter())
        handler.emit = lambda record: self.errors.append(handler.format(record))
        logging.getLogger().addHandler(handler)
        sys.unraisablehook = lambda u: self.errors.append(f"unraisable: {u.exc_value!r} {u.object}")
        threading.excepthook = lambda e: self.errors.append(f"thread: {e.exc_value!r}")

    def _note(self, _logger: Any, level: str, entry: dict[str, Any]) -> Any:
        if level in ("error", "critical", "exception") or "exception" in entry:
            self.errors.append(json.dumps(entry, default=str))
        raise structlog.DropEvent

    def taken(self) -> str:
        """Errors since the last call, as one text."""
        told, self.errors[:] = "\n".join(self.errors), []
        return told[-4000:]


class Site:
    """A running worker with a scene and one resource of every kind.

    Args:
        running: the worker.
        log: log of its process.

    Attributes:
        known: ids by parameter name.
    """

    def __init__(self, running: RunningWorker, log: Log) -> None:
        self.worker = running.worker
        self.url = running.url
        host, port = running.url.removeprefix("http://").split(":")
        self.address = (host, int(port))
        self.log = log
        self._beside = http.client.HTTPConnection(host, int(port), timeout=DEAD_S)
        self.known: dict[str, Any] = {"scene": "tiny", "camera": "front", "name": "video.webm"}
        self.known |= {"t_us": 500_000, "width": 32, "after": 0, "asset_id": "post"}
        self.restore()
        self.driver = Driver(self)

    # --- valid requests ---------------------------------------------------------------------------

    def ask(
        self,
        method: str,
        path: str,
        body: Any = None,
        *,
        token: str = TOKEN,
        may_conflict: bool = False,
    ) -> Any:
        """The JSON body of a response. None if not found, or on a conflict if ``may_conflict``."""
        connection = http.client.HTTPConnection(*self.address, timeout=PATIENT_S)
        headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        try:
            connection.request(method, path, json.dumps(body) if body else None, headers)
            answer = connection.getresponse()
            text = answer.read()
        finally:
            connection.close()
        if answer.status in (404, 410) or (may_conflict and answer.status == 409):
            return None
        assert answer.status < 400, f"{method} {path}: {answer.status} {text[:500]!r}"
        return json.loads(text) if text else {}

    def restore(self) -> None:
        """Create again what the attack has removed."""
        known = self.known
        if not self._has("scenarios", "scenario_id"):
            known["scenario_id"] = self.ask("POST", "/v1/scenarios", {"scene": "tiny"})[
                "scenario_id"
            ]
            known["scenario"] = known["scenario_id"]
        if not self._has("sessions", "session_id"):
            made = self.ask("POST", "/v1/sessions?scene=tiny", {"reset": {"sensors": [SENSOR]}})
            known |= {"session_id": made["session_id"], "token": made["token"]}
        asset = {"scene": "tiny", "object_id": "post"}
        # An asset that is being removed can be neither found nor created.
        wait_until(
            lambda: (
                self._has("assets", "asset_id")
                or self.ask("POST", "/v1/assets", asset, may_conflict=True) is not None
            ),
            "the asset to be made",
        )
        if not self._has("jobs", "job_id"):
            body = {"scene": "tiny", "camera": "front", "fps": 1, "width": 32}
            known["job_id"] = self.ask("POST", "/v1/exports", body)["job_id"]

    def _has(self, kind: str, name: str) -> bool:
        return name in self.known and self.ask("GET", f"/v1/{kind}/{self.known[name]}") is not None

    def tidy(self) -> None:
        """Remove everything that the attack has created."""
        kept = {self.driver.session_id, *map(str, self.known.values())}
        for kind, name in (("jobs", "job_id"), ("jobs", "job_id"), ("sessions", "session_id")):
            self._remove(kind, name, kept)  # Delete jobs twice: the first time cancels them.
        self._remove("scenarios", "scenario_id", kept)
        self._remove("assets", "asset_id", kept)
        for scene in self.ask("GET", "/v1/scenes")["scenes"]:
            if scene["scene"] != "tiny":
                # No route removes scenes, which are folders of the operator.
                self.ask("DELETE", f"/v1/scenes/{scene['scene']}/residency")
                shutil.rmtree(self.worker.settings.scenes_path / f"{scene['scene']}.r2s")

    def _remove(self, kind: str, name: str, kept: set[str]) -> None:
        for item in self.ask("GET", f"/v1/{kind}")[kind]:
            if item[name] not in kept:
                self.ask("DELETE", f"/v1/{kind}/{item[name]}")

    # --- bytes ----------------------------------------------------------------------------------

    def connected(self) -> socket.socket:
        """Open a new connection."""
        return socket.create_connection(self.address, timeout=DEAD_S)

    def settle(self) -> None:
        """Wait until the event loop has handled everything sent so far."""
        self._beside.request("GET", "/livez")
        answer = self._beside.getresponse()
        answer.read()
        assert answer.status == 200, answer.status


class Driver:
    """A client that drives its own session. Every episode equals the first."""

    def __init__(self, site: Site) -> None:
        made = site.ask("POST", "/v1/sessions?scene=tiny")
        self.session_id = made["session_id"]
        self._site = site
        self._socket = connect(
            made["ws_url"], subprotocols=[DRIVE_SUBPROTOCOL], compression=None, proxy=None
        )
        self._id = 0
        self._step = -1
        self._poses: list[Any] = []
        self._first: list[Any] = []
        hello = {"protocols": [DRIVE_SUBPROTOCOL], "token": made["token"]}
        while self._ask("hello", **hello)["type"] == "progress":
            pass

    def drive(self) -> None:
        """Drive one step. Raises AssertionError if it differs from the first episode."""
        if self._step in (-1, EPISODE_STEPS):
            if self._step == EPISODE_STEPS:
                self._first = self._first or self._poses
                assert self._poses == self._first, "another episode than alone"
            self._poses, self._step = [], 0
            said = self._ask("reset", spec={"sensors": [SENSOR], "on_collision": "continue"})
        else:
            times = [self._now + 100_000 * (k + 1) for k in range(4)]
            plan = {"kind": "trajectory", "times_us": times}
            plan["poses"] = [(0.6 * (k + 1), 0.0, 0.0) for k in range(4)]
            said = self._ask("action", step=self._step, plan=plan)
            self._step += 1
        assert said["type"] == "obs", said
        assert said["step"] == self._step, said
        self._now = said["t_us"]
        self._poses.append(json.dumps(said["ego"], default=str))

    def leave(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _ask(self, kind: str, **fields: Any) -> dict[str, Any]:
        self._id += 1
        self._socket.send(encode({"v": 1, "type": kind, "id": self._id, **fields}))
        return decode(self._socket.recv(timeout=DEAD_S, decode=False))


@contextlib.contextmanager
def attacked(folder: Path) -> Iterator[Site]:
    """A worker with low limits and a state folder below ``folder``."""
    street = readers.scene()
    save_scene(street, folder / "scenes" / "tiny.r2s")
    (folder / "import").mkdir()
    write_splats(street.background, folder / "import" / "street.ply")
    settings = Settings(
        data_dir=folder / "data",
        scenes_dir=folder / "scenes",
        import_root=folder / "import",
        port=0,
        backend="cpu",
        token=TOKEN,
        max_sessions=8,
        max_pixels_per_step=100_000,
        max_scene_bytes=64 << 20,
        max_asset_bytes=16 << 20,
        max_upload_bytes=4 << 20,
        max_request_bytes=1 << 20,
        scene_memory_bytes=512 << 20,
        scenes_quota=40,
        assets_quota=40,
        jobs_quota=40,
        drain_seconds=0,
        graceful_seconds=1,
    )
    log = Log()
    with running_worker(settings, timeout_s=600) as running:
        yield Site(running, log)
