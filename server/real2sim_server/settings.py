"""Settings of a worker: ``REAL2SIM_*`` in the environment, or arguments of ``real2sim serve``."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from real2sim_proto.base import bearer_token

GIB = 1024**3
MIB = 1024**2

MIN_TOKEN = 8
"""Shortest token [characters]."""


def _default_data_dir() -> Path:
    state = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(state) / "real2sim"


class Settings(BaseSettings):
    """Configuration of a worker.

    Attributes:
        host, port: listening address; an address beyond loopback requires ``token``.
        token: bearer token required by every request except ``/livez`` and ``/readyz``.
        token_file: file with the token, as mounted by an orchestrator.
        tokens_file: named tokens with limits, created by `real2sim token`; reloaded when it
            changes.
        worker_id: first part of session ids, so that a proxy can find the worker again.
        data_dir: root of the worker's files; default parent of the next five.
        scenes_dir: folder of scene bundles.
        demo: add the demo street to the scene folder at startup, unless a scene named
            ``demo_street`` exists.
        import_root: the only folder that ``POST /v1/scenes`` may read from.
        assets_dir: folder of asset bundles.
        jobs_dir: folder of the output files of jobs.
        store_url: SQLAlchemy URL of scenarios and sessions.
        agent_port: port for HAProxy's agent-check; none by default.
        agent_weight: weight of the worker there, in per cent.
        hot_scene_sessions: number of sessions in a scene, over all workers on a store, from which
            two workers keep it in memory; 0 for never.
        objects_url: object store through which workers share scenes, assets and files of jobs:
            ``file:///folder`` or ``s3://bucket/prefix?endpoint=...``; none by default.
        objects_cache_bytes: disk cache of the object store.
        objects_url_seconds: validity of a signed address of a file.
        lease_seconds: duration of the lease that a worker renews on its store; when it expires,
            other workers may take over its sessions.
        store_timeout_seconds: time after which an unresponsive database counts as unavailable.
        durability: data on disk before it is acknowledged: ``all``; ``edits``, everything except
            the steps of sessions; or ``process``, nothing. The rest survives a killed process, but
            its last seconds are lost in a power failure. SQLite only.
        store_migration: whether a worker upgrades a store with an older schema (``auto``), or
            refuses it with the command to run (``refuse``).
        store_max_bytes: size above which the oldest ended sessions are removed.
        session_retention_days: age at which ended sessions are removed, and unused ones ended.
        job_retention_days: age at which ended jobs are removed, with their files.
        backend: renderer: ``auto`` selects by hardware; ``nvrtc`` are the built-in kernels for a
            GPU, for serving only, not for training.
        threads: of numba and torch; 0 for one per core.
        scene_memory_bytes: budget of resident scenes, assets and shared memory together.
        shared_memory_bytes: per controller on this machine, in four slots, for raw images;
            allocated on demand, and counted in the budget. 0 sends everything over the socket.
        max_sessions: open sessions; further ones are rejected at creation.
        session_idle_seconds: time after which unused sessions without connections leave the
            memory; they are rebuilt from their logs on demand.
        queue_length: jobs that may wait for the engine; further ones are rejected.
        max_request_bytes, max_upload_bytes: body of a request, and of an uploaded splat file.
        max_scene_bytes, max_asset_bytes: memory limit of an imported scene or asset, independent
            of the size of its file.
        import_memory_bytes, import_seconds: limits of the process that reads an import.
        assets_quota, assets_quota_bytes: assets of the library, and their disk space.
        scenes_quota, scenes_quota_bytes: scenes of the scene folder, and their disk space; imports
            beyond are rejected.
        jobs_quota, jobs_quota_bytes: recorded jobs, and the disk space of their files; no job
            starts beyond.
        max_pixels_per_step: pixels over all cameras of one observation or render.
        max_rays_per_step: rays over all LiDARs and radars of one observation or render.
        stall_seconds: `/livez` fails when one job takes longer than this.
        drain_seconds: time for which a stopping worker continues to serve, not ready, so that
            proxies send new work elsewhere; SIGINT, or a second signal, ends it immediately.
        graceful_seconds: time limit of open requests at shutdown.
        max_connections: open connections; fewer if the limit of descriptors is lower. At the
            limit, the connections that have been silent longest while expected to send are closed.
        head_seconds: time limit for the headers of a request.
        body_seconds: time limit for its body, plus the transfer time at 10 kB/s.
        write_seconds: time limit for a client to read its reply, plus the transfer time at that
            rate.
        keep_alive_seconds: time that a connection stays open between requests.
        metrics: whether `/metrics` is served.
        traces_url: OpenTelemetry collector for spans, ``http://host:4318/v1/traces``; none by
            default.
        log_level, log_format: ``auto`` is text on a terminal and JSON elsewhere.
    """

    model_config = SettingsConfigDict(
        env_prefix="REAL2SIM_", frozen=True, extra="forbid", hide_input_in_errors=True
    )

    host: str = "127.0.0.1"
    port: int = Field(default=8600, ge=0, le=65535)
    token_file: Path | None = None
    tokens_file: Path | None = None
    token: SecretStr | None = None
    worker_id: str = Field(default="w0", pattern=r"^w[0-9]{1,6}$")
    data_dir: Path = Field(default_factory=_default_data_dir)
    scenes_dir: Path | None = None
    demo: bool = False
    import_root: Path | None = None
    assets_dir: Path | None = None
    jobs_dir: Path | None = None
    store_url: str | None = None
    agent_port: int | None = Field(default=None, ge=0, le=65535)
    agent_weight: int = Field(default=100, ge=1, le=100)
    hot_scene_sessions: int = Field(default=4, ge=0)
    objects_url: str | None = None
    objects_cache_bytes: int = Field(default=50 * GIB, ge=MIB)
    objects_url_seconds: float = Field(default=300.0, gt=0, le=604_800)
    lease_seconds: float = Field(default=3.0, ge=0.2, le=600)
    store_timeout_seconds: float = Field(default=5.0, ge=0.1, le=600)
    store_migration: Literal["auto", "refuse"] = "auto"
    store_max_bytes: int = Field(default=8 * GIB, ge=MIB)
    session_retention_days: float = Field(default=30.0, gt=0, le=36_500)
    job_retention_days: float = Field(default=30.0, gt=0, le=36_500)
    durability: Literal["all", "edits", "process"] = "edits"
    backend: Literal["auto", "cpu", "cuda", "nvrtc", "reference"] = "auto"
    threads: int = Field(default=0, ge=0, le=1024)
    scene_memory_bytes: int = Field(default=8 * GIB, gt=0)
    shared_memory_bytes: int = Field(default=512 * MIB, ge=0, le=64 * GIB)
    max_sessions: int = Field(default=32, ge=0)
    session_idle_seconds: float = Field(default=1800.0, gt=0)
    queue_length: int = Field(default=64, ge=1)
    max_request_bytes: int = Field(default=4 * MIB, ge=1024)
    max_upload_bytes: int = Field(default=2 * GIB, ge=1024)
    max_scene_bytes: int = Field(default=4 * GIB, ge=1024)
    max_asset_bytes: int = Field(default=256 * MIB, ge=1024)
    import_memory_bytes: int = Field(default=16 * GIB, ge=256 * MIB)
    import_seconds: float = Field(default=600.0, gt=0)
    assets_quota: int = Field(default=1000, ge=0)
    assets_quota_bytes: int = Field(default=20 * GIB, ge=0)
    scenes_quota: int = Field(default=1000, ge=0)
    scenes_quota_bytes: int = Field(default=500 * GIB, ge=0)
    jobs_quota: int = Field(default=10_000, ge=0)
    jobs_quota_bytes: int = Field(default=100 * GIB, ge=0)
    max_pixels_per_step: int = Field(default=64_000_000, ge=1)
    max_rays_per_step: int = Field(default=1 << 19, ge=1)
    stall_seconds: float = Field(default=120.0, gt=0)
    drain_seconds: float = Field(default=5.0, ge=0)
    graceful_seconds: float = Field(default=10.0, ge=0)
    max_connections: int = Field(default=4096, ge=1)
    head_seconds: float = Field(default=10.0, gt=0)
    body_seconds: float = Field(default=30.0, gt=0)
    write_seconds: float = Field(default=30.0, gt=0)
    keep_alive_seconds: int = Field(default=60, gt=0)
    metrics: bool = True
    traces_url: str | None = None
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    log_format: Literal["auto", "json", "text"] = "auto"

    @model_validator(mode="before")
    @classmethod
    def _token_of_file(cls, given: dict[str, Any]) -> dict[str, Any]:
        file = given.get("token_file")
        if not file:
            return given
        if given.get("token") is not None:
            raise ValueError("token and token_file are both given; one of them is enough")
        return given | {"token": read_token(Path(file))}

    @model_validator(mode="before")
    @classmethod
    def _without_white_space(cls, given: dict[str, Any]) -> dict[str, Any]:
        # The last validator runs first. Lines of files may end with a carriage return.
        found = {k: v.strip() if isinstance(v, str) else v for k, v in given.items()}
        for name, value in found.items():
            # The token has rules of its own.
            if name != "token" and isinstance(value, str) and not value.isprintable():
                place = next(k for k, c in enumerate(value) if not c.isprintable())
                raise ValueError(
                    f"setting {name}: character {place + 1} is U+{ord(value[place]):04X}; control "
                    "characters are not allowed"
                )
        return found

    @field_validator("token", mode="before")
    @classmethod
    def _token_fits_a_header(cls, given: Any) -> Any:
        if not isinstance(given, str):
            return given
        token = bearer_token(given)
        if len(token) < MIN_TOKEN:
            raise ValueError(
                f"it is shorter than {MIN_TOKEN} characters; take the output of `openssl rand -hex "
                "16`, or unset it"
            )
        return token

    @property
    def needs_token(self) -> bool:
        """Whether requests need a token."""
        return self.token is not None or self.tokens_file is not None

    @property
    def scenes_path(self) -> Path:
        """Folder of scene bundles."""
        return self.scenes_dir or self.data_dir / "scenes"

    @property
    def import_path(self) -> Path:
        """Folder that imports are read from."""
        return self.import_root or self.data_dir / "import"

    @property
    def assets_path(self) -> Path:
        """Folder of asset bundles."""
        return self.assets_dir or self.data_dir / "assets"

    @property
    def jobs_path(self) -> Path:
        """Folder of the files that jobs leave."""
        return self.jobs_dir or self.data_dir / "jobs"

    @property
    def database_url(self) -> str:
        """SQLAlchemy URL of the store."""
        return self.store_url or f"sqlite:///{self.data_dir / 'real2sim.db'}"


OTHER_VARIABLES = frozenset(
    {"REAL2SIM_DEBUG", "REAL2SIM_MEMORY", "REAL2SIM_SCENES", "REAL2SIM_TEST_DATA", "REAL2SIM_URL"}
)
"""Settings of the client, the compose file and the tests."""

LIKENESS = 0.8
"""Minimum share of equal letters for a name to count as misspelt."""


def read_token(file: Path) -> str:
    """The token in a file, without a byte-order mark and the newline at its end.

    Raises:
        ValueError: the file cannot be read, or does not contain a token.
    """
    try:
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise ValueError(f"the token cannot be read from {str(file)!r}: {reason}") from error
    try:
        return bearer_token(text)
    except ValueError as error:
        raise ValueError(f"{str(file)!r}: {error}") from None


def unknown_variables(names: Iterable[str]) -> dict[str, str | None]:
    """Variables of the environment that look like settings and are none.

    Returns:
        For each the setting that it is probably meant to be, or None.
    """
    known = {f"REAL2SIM_{name.upper()}" for name in Settings.model_fields} | OTHER_VARIABLES
    found: dict[str, str | None] = {}
    for name in sorted(names):
        if name.upper().startswith("REAL2SIM_") and name.upper() not in known:
            near = difflib.get_close_matches(name.upper(), known, n=1, cutoff=LIKENESS)
            found[name] = near[0] if near else None
    return found
