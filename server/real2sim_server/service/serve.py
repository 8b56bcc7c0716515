"""Runs a worker: until a signal, or during a ``with`` block."""

from __future__ import annotations

import contextlib
import gc
import http.client
import logging
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import structlog
import uvicorn
from fastapi import FastAPI

from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES

from ..console import is_expected
from ..settings import Settings
from .app import create_app
from .http.auth import check_bind
from .http.connections import watch
from .preflight import bind, check_scenes, listen, url_of
from .storage.connection import StoreError
from .worker import Worker

# --- Garbage collection --------------------------------------------------------------------------

# A full collection takes 0.2 s and blocks all sessions. The default thresholds trigger one every
# few thousand steps, although nearly all objects are created before the first step and never freed.

YOUNG = 20_000
"""New objects between two young collections; a step creates about 200, nearly all freed by
reference counting."""


def collect_rarely() -> None:
    """Raise the thresholds, to keep collections many steps apart."""
    gc.set_threshold(YOUNG, *gc.get_threshold()[1:])


def freeze_objects() -> None:
    """Exclude all current objects from collections. Call it once, after a worker has started:
    current objects that become cyclic garbage are never freed."""
    gc.collect(1)
    gc.freeze()


# --- Logging -------------------------------------------------------------------------------------


def configure_logging(*, level: str = "info", log_format: str = "auto") -> None:
    """Send logs of structlog and the standard library to stderr in one format.

    Args:
        level: minimum level.
        log_format: ``text``, ``json``, or ``auto``: text if stderr is a terminal.
    """
    text = log_format == "text" or (log_format == "auto" and sys.stderr.isatty())
    shared: list[Any] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    structlog.configure(
        processors=[
            structlog.stdlib.filter_by_level,
            *shared,
            structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
        ],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )
    # Plain tracebacks: prettier ones print local variables, which may contain tokens.
    render: list[Any] = (
        [structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)]
        if text
        else [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *render],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level.upper())
    # The worker logs one line per request; the server's access log would duplicate it.
    logging.getLogger("uvicorn.access").disabled = True
    for name in ("uvicorn", "uvicorn.error", "asyncio", "alembic"):
        logging.getLogger(name).setLevel(max(logging.WARNING, root.level))


PING_INTERVAL_S = 10.0
PING_TIMEOUT_S = 20.0
POLL_S = 0.02
LINGER_S = 1.5
"""Time for which a worker that has handed over its sessions still answers clients, until its proxy
has noticed [s]."""


@dataclass(frozen=True)
class RunningWorker:
    """A worker in a thread of this process.

    Attributes:
        url: its address, for example ``http://127.0.0.1:41234``.
        token: token that it requires.
        worker: the worker object.
    """

    url: str
    token: str | None = field(repr=False)
    worker: Worker


def run(settings: Settings) -> int:
    """Serve until SIGINT or SIGTERM; returns the exit code: 1 if the device was lost.

    Raises:
        OpenBindError: an address other than loopback, without a token.
        SceneFolderError: the scene folder is missing.
        AddressError: the address is in use, or does not belong to this machine.
        RenderError: the backend of the settings is not available here.
        StateFolderError: another worker uses the state folder, or it is not writable.
        StoreError: the store cannot be opened.
    """
    check_bind(settings.host, settings.needs_token)
    check_scenes(settings)
    configure_logging(level=settings.log_level, log_format=settings.log_format)
    listener = bind(settings.host, settings.port)
    app = create_app(settings)
    listen(listener)
    worker: Worker = app.state.worker
    print(_announcement(worker, url_of(settings.host, listener)), file=sys.stderr, flush=True)
    server = DrainingServer(server_config(app, settings), worker)
    # A lost device makes the process unusable. It exits, and its supervisor starts a new one.
    worker.engine.on_failure = lambda: setattr(server, "should_exit", True)
    collect_rarely()
    worker.on_ready = freeze_objects
    # The server stops gracefully at a signal and then raises the signal again.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt), _start_errors_logged_once(worker):
        server.run(sockets=[listener])
    if worker.start_error is not None:
        raise worker.start_error
    return 0 if worker.engine.failure is None and server.started else 1


@contextmanager
def running_worker(settings: Settings, *, timeout_s: float = 120.0) -> Iterator[RunningWorker]:
    """A ready worker in a background thread; for tests, demos and benchmarks.

    Args:
        settings: ``port`` 0 uses a free one.
        timeout_s: maximum startup time.

    Raises:
        OpenBindError: an address other than loopback, without a token.
        SceneFolderError: the scene folder is missing.
        AddressError: the address is in use, or does not belong to this machine.
        RuntimeError: the worker ended or was not ready in time; the message gives the reasons.
    """
    check_bind(settings.host, settings.needs_token)
    check_scenes(settings)
    listener = bind(settings.host, settings.port)
    app = create_app(settings)
    listen(listener)
    server = uvicorn.Server(server_config(app, settings))
    worker: Worker = app.state.worker

    def serve() -> None:
        with _start_errors_logged_once(worker):
            server.run(sockets=[listener])

    thread = threading.Thread(target=serve, name="worker", daemon=True)
    thread.start()
    try:
        _wait_until_ready(listener.getsockname(), thread, timeout_s, worker)
        yield RunningWorker(url_of(settings.host, listener), _token(settings), worker)
    finally:
        server.should_exit = True
        thread.join(settings.graceful_seconds + 30)
        listener.close()


@contextmanager
def _start_errors_logged_once(worker: Worker) -> Iterator[None]:
    """Report startup errors once, without an additional traceback in the log."""

    def is_news(_record: logging.LogRecord) -> bool:
        return worker.start_error is None or not is_expected(worker.start_error)

    server_log = logging.getLogger("uvicorn.error")
    server_log.addFilter(is_news)
    try:
        yield
    except SystemExit:
        # uvicorn raises this if it has not started.
        if worker.start_error is None:
            raise
    finally:
        server_log.removeFilter(is_news)


class DrainingServer(uvicorn.Server):
    """uvicorn's server, which drains the worker after SIGTERM: it reports not ready, continues to
    serve for a limited time, then stops.

    Args:
        config: config of the server.
        worker: the worker; its settings limit the duration.
    """

    def __init__(self, config: uvicorn.Config, worker: Worker) -> None:
        super().__init__(config)
        self._worker = worker
        self._stops_at: float | None = None

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle a signal: the first SIGTERM starts draining, any other one stops."""
        if sig == signal.SIGTERM and self._stops_at is None and self.started:
            self._worker.drain()
            self._stops_at = time.monotonic() + self._worker.settings.drain_seconds
            self._captured_signals.append(sig)
        else:
            super().handle_exit(sig, frame)

    async def on_tick(self, counter: int) -> bool:
        """Check ten times a second whether to stop."""
        if self._stops_at is not None and time.monotonic() >= self._stops_at:
            if not self._worker.handed_over and await self._handed_over():
                self._stops_at = time.monotonic() + LINGER_S
            else:
                self.should_exit = True
        return await super().on_tick(counter)

    async def _handed_over(self) -> bool:
        """Whether other workers have taken over this worker's sessions."""
        try:
            return await self._worker.hand_over()
        except StoreError:
            return False


def server_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """uvicorn's configuration for a worker."""
    config = uvicorn.Config(
        app,
        http="h11",
        log_config=None,
        access_log=False,
        server_header=False,
        lifespan="on",
        ws="websockets-sansio",
        # Compressing a frame would take 20 ms without effect: images do not compress.
        ws_per_message_deflate=False,
        ws_max_size=MAX_CLIENT_MESSAGE_BYTES,
        ws_ping_interval=PING_INTERVAL_S,
        ws_ping_timeout=PING_TIMEOUT_S,
        timeout_keep_alive=settings.keep_alive_seconds,
        timeout_graceful_shutdown=max(1, round(settings.graceful_seconds)),
    )
    watch(config, app.state.worker.connections)
    return config


def _announcement(worker: Worker, url: str) -> str:
    """The first lines of a worker's output."""
    settings, device = worker.settings, worker.device
    return (
        f"Real2Sim worker {settings.worker_id} on {url} ({device.backend}: {device.reason}); "
        f"scenes in {settings.scenes_path}\nStudio: {url}/ui/"
    )


def _token(settings: Settings) -> str | None:
    return settings.token.get_secret_value() if settings.token else None


def _wait_until_ready(
    address: tuple[str, int], thread: threading.Thread, timeout_s: float, worker: Worker
) -> None:
    deadline = time.monotonic() + timeout_s
    answer = "no answer yet"
    while time.monotonic() < deadline:
        if not thread.is_alive():
            reason = worker.start_error or "see its log"
            raise RuntimeError(f"the worker ended while it started: {reason}")
        # A short timeout, because a dead worker leaves the connection open without data.
        ready, answer = _ask_readiness(address, timeout_s=0.5)
        if ready:
            return
        time.sleep(POLL_S)
    raise RuntimeError(f"the worker was not ready after {timeout_s:g} s: {answer}")


def _ask_readiness(address: tuple[str, int], *, timeout_s: float) -> tuple[bool, str]:
    connection = http.client.HTTPConnection(address[0], address[1], timeout=timeout_s)
    try:
        connection.request("GET", "/readyz")
        response = connection.getresponse()
        body = response.read().decode("utf-8", "replace")
        return response.status == 200, body
    except (OSError, http.client.HTTPException) as error:
        return False, str(error)
    finally:
        connection.close()
