"""The worker on the network; the only package that knows HTTP.

Its parts, lowest first; each imports only those before it, and no file is part of a circle:

- ``clock``: time as the worker reads it.
- ``storage``: a ``Database`` that executes statements, and a ``Store`` of scenarios, sessions, jobs
  and stored answers.
- ``shared_objects``: bundles and files that workers share, stored by content.
- ``accounts``: named tokens with roles and limits, and what their holders use.
- ``preflight``: checks, and a second process that compiles kernels, before heavy imports.
- ``warm_up``: kernels compiled or loaded before they are needed.
- ``engine``: the thread that owns the device, and its queue.
- ``http``: what all replies share: errors, authorisation, idempotency, limits, telemetry and
  connections.
- ``library``: scenes and assets, on disk and in memory.
- ``rendering``: render requests, and images as frames of the wire.
- ``scenarios``: edited under a lock each, cached, recorded before they take effect.
- ``jobs``: long work: rollouts, videos, data sets.
- ``sessions``: closed loops; ``pipeline`` takes a step from the socket to the bytes of its answer.
- ``drives``: planners that drive sessions as jobs.
- ``sweeps``: sweeps and searches, in processes of their own, as jobs.
- ``membership``: a worker in a fleet: its lease, shared objects, prewarmed scenes, reports.
- ``audit``: the audit log.
- ``maintenance``: removes leftovers and whatever exceeds the limits.
- ``worker``: puts all of it together.
- ``routes``: calls and sockets; ``ui`` is the studio that they serve as files.
- ``app``, ``serve``: the ASGI application, and the server that runs it.
"""
