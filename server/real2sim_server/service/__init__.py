"""The worker on the network; the only package that knows HTTP.

Its parts, lowest first; each imports only those before it, and no file is part of a circle:

- ``clock``: time as the worker reads it.
- ``storage``: a ``Database`` that executes, a ``Store`` of what is asked of it: scenarios,
  sessions, jobs, stored answers; who owns them.
- ``objects``: a store of what workers share, by content.
- ``token_file``, ``accounts``: named tokens, and what their holders take.
- ``preflight``: what is refused before anything heavy is loaded.
- ``first_run``: a second process that compiles, begun before anything heavy is loaded.
- ``warm_up``: kernels compiled or loaded before they are needed, or beside what does not need them.
- ``lanes``, ``engine``: the thread that owns the device, and whose turn it is.
- ``http``: what every answer shares: errors, authorisation, idempotency, limits, metrics,
  connections, sockets.
- ``library``: scenes and assets, on disk and in memory.
- ``rendering``: render requests, and images as frames of the wire.
- ``scenarios``: edited under a lock each, cached, on record before they take effect.
- ``jobs``: long work: rollouts and videos.
- ``sessions``: closed loops; ``pipeline`` takes a step from the socket to the bytes of its answer.
- ``drives``: planners that drive sessions as jobs.
- ``sweeps``: sweeps and searches, in processes of their own, as jobs.
- ``sharing``: scenes, assets and files of jobs that workers have in common.
- ``membership``, ``prewarming``, ``agent``: a worker among those that share its store: its lease,
  scenes that it loads ahead, and what it tells its proxy.
- ``tracing``: spans of requests and of the engine, where they are asked for.
- ``audit``: who did what, on record.
- ``upkeep``: leftovers and what has been kept long enough go by themselves.
- ``worker``: all of it put together once.
- ``routes``: calls and sockets; ``ui`` is the studio that they serve as files.
- ``app``, ``garbage``, ``serve``: the ASGI application, how seldom its process looks for garbage,
  and the server that runs it.
"""
