"""Telemetry of a worker: Prometheus metrics, and OpenTelemetry traces if configured."""

from __future__ import annotations

import asyncio
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..accounts import Account

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider


# --- Metrics --------------------------------------------------------------------------------------

# Label values are from closed sets, never client text or ids.

FAST_BUCKETS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10)
LOAD_BUCKETS = (0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120)


METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
OTHER = "other"


class Metrics:
    """All metrics of a worker, in a separate registry because a process can run several workers."""

    def __init__(self) -> None:
        registry = self.registry = CollectorRegistry()
        self.build = Info("real2sim_build", "version and backend", registry=registry)
        self._exposing = threading.Lock()
        self.engine_seconds = 0.0
        self.requests = Histogram(
            "real2sim_http_request_duration_seconds",
            "time to answer a request",
            ("method", "route", "status"),
            buckets=FAST_BUCKETS,
            registry=registry,
        )
        self.queue_wait = Histogram(
            "real2sim_engine_queue_wait_seconds",
            "time a job waited for the engine",
            buckets=FAST_BUCKETS,
            registry=registry,
        )
        self.jobs = Histogram(
            "real2sim_engine_job_duration_seconds",
            "time a job ran on the engine",
            ("label",),
            buckets=FAST_BUCKETS,
            registry=registry,
        )
        self.queue_depth = Gauge(
            "real2sim_engine_queue_depth", "jobs that wait for the engine", registry=registry
        )
        self.scenes = Gauge("real2sim_scenes", "scenes by state", ("state",), registry=registry)
        self.scene_bytes = Gauge(
            "real2sim_scene_memory_bytes",
            "bytes of resident scenes and their levels of detail",
            registry=registry,
        )
        self.shared_memory_bytes = Gauge(
            "real2sim_shared_memory_bytes",
            "bytes that controllers on this machine read images from",
            registry=registry,
        )
        self.scene_loads = Histogram(
            "real2sim_scene_load_duration_seconds",
            "time to load a scene",
            buckets=LOAD_BUCKETS,
            registry=registry,
        )
        self.stages = LoopHistogram(
            "real2sim_frame_stage_duration_seconds",
            "time of one stage on the way to frames",
            "stage",
            buckets=FAST_BUCKETS,
            registry=registry,
        )
        self.frames = Counter(
            "real2sim_frames", "images sent", ("stream", "codec"), registry=registry
        )
        self.edits = Counter(
            "real2sim_edits", "operations in effect, by kind", ("op",), registry=registry
        )
        self.edit_conflicts = Counter(
            "real2sim_edit_conflicts", "edits refused as stale", registry=registry
        )
        self.replays = Counter(
            "real2sim_idempotent_replays", "requests answered from memory", registry=registry
        )
        self.sessions = Gauge("real2sim_sessions", "open sessions", registry=registry)
        self.session_limit = Gauge(
            "real2sim_session_limit", "sessions that may be open", registry=registry
        )
        self.connections = Gauge(
            "real2sim_connections", "open connections of clients", registry=registry
        )
        self.connection_limit = Gauge(
            "real2sim_connection_limit", "connections that may be open", registry=registry
        )
        self.dropped_connections = Counter(
            "real2sim_dropped_connections",
            "connections closed by the worker, by reason",
            ("reason",),
            registry=registry,
        )
        self.auth_failures = Counter(
            "real2sim_auth_failures",
            "wrong or missing tokens, by where they were wanted",
            ("where",),
            registry=registry,
        )
        self.sockets = Gauge("real2sim_sockets", "open sockets", ("kind",), registry=registry)
        steps = LoopHistogram(
            "real2sim_step_duration_seconds",
            "time from an action to its observation, as the worker sees it",
            buckets=FAST_BUCKETS,
            registry=registry,
        )
        self.steps = steps.labels()
        self.missed_deadlines = Counter(
            "real2sim_missed_deadlines", "actions that came too late", registry=registry
        )
        self.store_calls = Histogram(
            "real2sim_store_duration_seconds",
            "time of a read or write of the store",
            ("call",),
            buckets=FAST_BUCKETS,
            registry=registry,
        )
        self.store_failures = Counter(
            "real2sim_store_failures", "reads and writes that failed", ("call",), registry=registry
        )
        self.ended_jobs = Counter(
            "real2sim_ended_jobs",
            "jobs by kind and how they ended",
            ("kind", "state"),
            registry=registry,
        )
        self.loop_lag = Histogram(
            "real2sim_event_loop_lag_seconds",
            "how late the event loop runs",
            buckets=(0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.5),
            registry=registry,
        )

    def observe_job(self, label: str, waited_s: float, ran_s: float) -> None:
        """Record an engine job."""
        self.engine_seconds += ran_s
        self.queue_wait.observe(waited_s)
        self.jobs.labels(label).observe(ran_s)

    def observe_store(self, call: str, seconds: float, done: bool) -> None:
        """Record a read or write of the store."""
        self.store_calls.labels(call).observe(seconds)
        if not done:
            self.store_failures.labels(call).inc()

    def observe_ended_job(self, kind: str, state: str) -> None:
        """Record a finished job."""
        self.ended_jobs.labels(kind, state).inc()

    def observe_request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Record one reply; ``route`` is the path of a route, or a placeholder."""
        known = method if method in METHODS else OTHER
        self.requests.labels(known, route, str(status)).observe(seconds)

    @contextmanager
    def open_socket(self, kind: str) -> Iterator[None]:
        """Count a socket during the block; ``kind``: ``drive`` or ``view``."""
        with self.sockets.labels(kind).track_inprogress():
            yield

    def watch(self, gauge: Gauge, read: Callable[[], float]) -> None:
        """Make ``gauge`` call ``read`` whenever metrics are collected."""
        gauge.set_function(read)

    def watch_accounts(
        self, accounts: Iterable[Account], sessions: Callable[[], Mapping[str, int]]
    ) -> None:
        """Export usage by token name; ``sessions`` counts sessions by owner."""
        self.registry.register(_AccountCollector(accounts, sessions))

    async def exposition(self) -> tuple[bytes, str]:
        """Body and media type of ``/metrics``, computed on another thread, one at a time."""
        return await asyncio.to_thread(self._expose), CONTENT_TYPE_LATEST

    def _expose(self) -> bytes:
        with self._exposing:
            return generate_latest(self.registry)


class Durations:
    """Durations of a :class:`LoopHistogram`, for one label value."""

    def __init__(self, bounds: Sequence[float]) -> None:
        self._bounds = bounds
        self.counts = [0] * (len(bounds) + 1)
        self.total = 0.0

    def observe(self, seconds: float) -> None:
        """Count one duration."""
        self.counts[bisect_left(self._bounds, seconds)] += 1
        self.total += seconds


class LoopHistogram(Collector):
    """A histogram for the event loop, which updates it several times per step. Without the locks of
    the client library's histogram it is ten times faster.

    Args:
        name, text: name and help text of the metric.
        label: name of its label, or None.
        buckets: upper bounds, increasing [s].
        registry: registry of the metric.
    """

    def __init__(
        self,
        name: str,
        text: str,
        label: str | None = None,
        *,
        buckets: Sequence[float],
        registry: CollectorRegistry,
    ) -> None:
        self._name, self._text = name, text
        self._labels = [] if label is None else [label]
        self._bounds = tuple(buckets)
        self._series: dict[tuple[str, ...], Durations] = {}
        registry.register(self)

    def observe_ms(self, named: Mapping[str, float]) -> None:
        """Record one duration [ms] for each of several label values."""
        for name, ms in named.items():
            series = self._series.get((name,)) or self.labels(name)
            seconds = ms / 1e3
            series.counts[bisect_left(self._bounds, seconds)] += 1
            series.total += seconds

    def labels(self, *value: str) -> Durations:
        """Durations of a label value."""
        found = self._series.get(value)
        if found is None:
            found = self._series[value] = Durations(self._bounds)
        return found

    def describe(self) -> Iterable[Metric]:
        """The same without values."""
        return [HistogramMetricFamily(self._name, self._text, labels=self._labels)]

    def collect(self) -> Iterable[Metric]:
        """Collect every series, on the thread that exposes metrics."""
        family = HistogramMetricFamily(self._name, self._text, labels=self._labels)
        bounds = [*map(floatToGoString, self._bounds), "+Inf"]
        for value, durations in list(self._series.items()):
            below = accumulate(durations.counts)
            family.add_metric(value, list(zip(bounds, below, strict=True)), durations.total)
        return [family]


class _AccountCollector:
    """Account metrics, read at collection; accounts do not depend on metrics."""

    def __init__(
        self, accounts: Iterable[Account], sessions: Callable[[], Mapping[str, int]]
    ) -> None:
        self._accounts = accounts
        self._sessions = sessions

    def describe(self) -> Iterable[Metric]:
        """The same without values."""
        return [CounterMetricFamily(name, text, labels=["token"]) for name, text, _ in _FIGURES]

    def collect(self) -> Iterator[Metric]:
        """Every metric, with one sample per account name."""
        accounts = list(self._accounts)
        for name, text, read in _FIGURES:
            family = CounterMetricFamily(name, text, labels=["token"])
            for account in accounts:
                family.add_metric([account.name], read(account))
            yield family
        refused = CounterMetricFamily(
            "real2sim_token_refusals", "refused by a limit of a token", labels=["token", "limit"]
        )
        for account in accounts:
            for limit, count in account.refusals.items():
                refused.add_metric([account.name, limit.value], count)
        yield refused
        owned = self._sessions()
        present = GaugeMetricFamily(
            "real2sim_token_sessions", "open sessions by token", labels=["token"]
        )
        for account in accounts:
            present.add_metric([account.name], owned.get(account.name, 0))
        yield present


_FIGURES: tuple[tuple[str, str, Callable[[Account], float]], ...] = (
    ("real2sim_token_requests", "requests and messages let in", lambda a: a.requests),
)


# --- Traces ---------------------------------------------------------------------------------------

# Enabled if ``REAL2SIM_TRACES_URL`` names a collector. A request continues the trace of its
# ``traceparent`` header, which the shipped proxy adds if missing, so the proxy's log, the worker's
# log and the spans share an id.

OnEngine = Callable[[str, float, float], None]
"""Called with the label of a job and the seconds it waited and ran, at its end."""

_QUIET = ("/livez", "/readyz", "/metrics")


def traces_to(url: str, *, worker_id: str) -> TracerProvider:
    """A tracer provider that sends spans to a collector, in batches, on a separate thread.

    Args:
        url: OTLP/HTTP address of the collector, such as ``http://host:4318/v1/traces``.
        worker_id: id of this worker.

    Raises:
        ValueError: the extra ``tracing`` is not installed.
    """
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise ValueError(
            "REAL2SIM_TRACES_URL needs OpenTelemetry: pip install 'real2sim[tracing]'"
        ) from error
    provider = provider_of(worker_id)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=url)))
    return provider


def provider_of(worker_id: str) -> TracerProvider:
    """Tracer provider of a worker, without an exporter."""
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider

    about = {"service.name": "real2sim", "service.instance.id": worker_id}
    return TracerProvider(resource=Resource.create(about))


class Tracing:
    """ASGI middleware: one span per request, the parent of its engine spans.

    Args:
        app: the application.
        provider: the tracer provider.
    """

    def __init__(self, app: ASGIApp, *, provider: TracerProvider) -> None:
        self._app = app
        self._tracer = provider.get_tracer("real2sim")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket") or scope["path"] in _QUIET:
            await self._app(scope, receive, send)
            return
        from opentelemetry import trace
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        headers = {name.decode("latin-1"): v.decode("latin-1") for name, v in scope["headers"]}
        above = TraceContextTextMapPropagator().extract(headers)
        method = scope.get("method", "WEBSOCKET")

        with self._tracer.start_as_current_span(
            method, context=above, kind=trace.SpanKind.SERVER
        ) as span:

            async def send_noted(message: Message) -> None:
                if message["type"] == "http.response.start":
                    span.set_attribute("http.response.status_code", message["status"])
                await send(message)

            try:
                await self._app(scope, receive, send_noted)
            finally:
                route = getattr(scope.get("route"), "path", None) or "unmatched"
                span.update_name(f"{method} {route}")
                for name, value in _about(scope, method, route).items():
                    span.set_attribute(name, value)


def engine_spans(provider: TracerProvider) -> Callable[[], OnEngine | None]:
    """For :class:`.engine.Engine`: called when a job is queued. The returned function is called
    when the job ends, on the engine's thread.

    Args:
        provider: the tracer provider.
    """
    from opentelemetry import trace

    tracer = provider.get_tracer("real2sim")

    def begin() -> OnEngine | None:
        above = trace.get_current_span()
        if not above.get_span_context().is_valid:
            return None
        context = trace.set_span_in_context(above)

        def end(label: str, waited_s: float, ran_s: float) -> None:
            now = time.time_ns()
            began = now - round((waited_s + ran_s) * 1e9)
            span = tracer.start_span(f"engine {label}", context=context, start_time=began)
            span.set_attribute("real2sim.queue_wait_s", waited_s)
            span.end(end_time=now)

        return end

    return begin


def _about(scope: Scope, method: str, route: str) -> dict[str, Any]:
    found = {"http.request.method": method, "http.route": route, "url.path": scope["path"]}
    for name in ("session_id", "scenario_id", "job_id", "scene"):
        if value := (scope.get("path_params") or {}).get(name):
            found[f"real2sim.{name}"] = str(value)
    return found
