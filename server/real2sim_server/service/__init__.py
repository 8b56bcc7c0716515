"""The HTTP and WebSocket service of a worker; the only package that uses HTTP.

Modules and packages, lowest first. Each imports only earlier ones:

- ``clock``: the worker's clock.
- ``storage``: a ``Database`` that executes statements, and a ``Store`` of scenarios, sessions, jobs
  and stored replies.
- ``shared_objects``: content-addressed bundles and files shared by workers.
- ``accounts``: named tokens with roles and limits, and their usage.
- ``preflight``: checks before heavy imports, and a second process that compiles kernels.
- ``warm_up``: compiles or loads kernels ahead of use.
- ``engine``: the thread that owns the device, and its queue.
- ``http``: shared by all replies: errors, authorisation, idempotency, limits, telemetry and
  connections.
- ``library``: scenes and assets, on disk and in memory.
- ``frames``: images as frames of the protocol.
- ``render_background``: background work of the renderer.
- ``renderer``: render requests.
- ``scenario_cache``: scenarios and sessions' states in memory.
- ``scenarios``: edits under one lock per scenario, stored before they take effect.
- ``jobs``: long-running work and its queue.
- ``exports``, ``rollouts``: the work of jobs: videos, data sets, physics, calibration.
- ``sessions``: closed loops; ``pipeline`` processes a step from the socket to the encoded reply.
- ``drives``: jobs in which planners drive sessions.
- ``sweeps``: sweeps and searches as jobs, in separate processes.
- ``membership``: a worker in a fleet: its lease, shared objects, prewarmed scenes, reports.
- ``audit``: the audit log.
- ``maintenance``: removes leftovers and data above the limits.
- ``worker``: assembles the parts.
- ``routes``: REST calls and sockets; ``ui`` is the studio, served as files.
- ``app``, ``serve``: the ASGI application, and the server that runs it.
"""
