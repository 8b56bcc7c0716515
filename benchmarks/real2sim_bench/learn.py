"""``real2sim bench learn``: steps and images per second for learned planners.

Each figure is compared with its alternative in the same run: batched worlds with a single world,
small images with images of all Gaussians, many sessions with one.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import selectors
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import uvicorn
from rich.console import Console
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

import real2sim
from real2sim_proto import DRIVE_SUBPROTOCOL, encode
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES, unpack
from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control
from real2sim_proto.sessions import SessionInfo
from real2sim_server.console import print_figures
from real2sim_server.demo.run import worker_process
from real2sim_server.demo.street import SHIPPED, unpack_street
from real2sim_server.edit import ScenarioState, instances_at
from real2sim_server.learning import VectorDriveEnv, fitted
from real2sim_server.render import RasterOptions, View, rasterize, rasterize_batch
from real2sim_server.scene import Scene
from real2sim_server.scene.io import read_packed
from real2sim_server.service.preflight import bind, listen, url_of
from real2sim_server.service.sessions.messages import action_in
from real2sim_server.world import World
from real2sim_server.world.batch import BatchWorld

from .drive_probe import ANSWER_S, DriveProbe, action

# Upper bound: an echo server on the worker's stack, without world and log, that answers each action
# with a prepared observation.

Answer = Callable[[bytes], bytes]
"""Returns the reply to an action."""

HOST = "127.0.0.1"
ECHO_START_S = 300.0
ECHOED = ("bytes", "messages")
"""Paths of an echo server: it replies with prepared bytes, or it parses and validates each action
like a worker and serialises each observation."""


@contextlib.contextmanager
def echo_servers(count: int, observation: bytes) -> Iterator[list[str]]:
    """Run echo servers in separate processes; yields their URLs.

    Args:
        count: number of servers.
        observation: reply to every action, unchanged; its id must not be 0.

    Raises:
        RuntimeError: a server does not start.
    """
    spawning = multiprocessing.get_context("spawn")
    with contextlib.ExitStack() as running:
        ways = [spawning.Pipe(duplex=False) for _ in range(count)]
        for _, child in ways:
            process = spawning.Process(target=_serve, args=(child, observation), daemon=True)
            process.start()
            running.callback(process.join)
            running.callback(process.terminate)
        yield [_told(way) for way, _ in ways]


def echo_session(url: str) -> SessionInfo:
    """Session info of an echo server for a client."""
    return SessionInfo(
        session_id="echo", scene="none", ws_url=url, token="", created_at="", reset=ResetSpec()
    )


def _told(way: Connection) -> str:
    if not way.poll(ECHO_START_S):
        raise RuntimeError(f"a server of the bench has not started within {ECHO_START_S:g} s")
    url: str = way.recv()
    return url


def _serve(told: Connection, observation: bytes) -> None:
    """Main function of a server process; runs until terminated."""
    listener = bind(HOST, 0)
    listen(listener)
    told.send(url_of(HOST, listener).replace("http", "ws", 1))
    config = uvicorn.Config(
        echo_app(observation),
        log_config=None,
        access_log=False,
        lifespan="off",
        ws="websockets-sansio",
        ws_per_message_deflate=False,
        ws_max_size=MAX_CLIENT_MESSAGE_BYTES,
    )
    uvicorn.Server(config).run(sockets=[listener])


def echo_app(observation: bytes) -> ASGIApp:
    """ASGI app of an echo server; the path of a connection is one of ``ECHOED``."""
    fields = unpack(observation)

    def read_and_packed(action: bytes) -> bytes:
        action_in(action)
        return encode(fields)

    answers = dict(zip(ECHOED, (lambda _action: observation, read_and_packed), strict=True))

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        # A client that disconnects is not an error.
        with contextlib.suppress(WebSocketDisconnect):
            await _echo(WebSocket(scope, receive, send), answers[scope["path"].strip("/")])

    return app


async def _echo(socket: WebSocket, answer: Answer) -> None:
    """Handle hello, reset and actions."""
    await socket.accept(subprotocol=DRIVE_SUBPROTOCOL)
    hello: dict[str, Any] = unpack(await socket.receive_bytes())
    welcome = {"v": 1, "type": "welcome", "id": hello["id"], "resume_token": ""}
    await socket.send_bytes(encode(welcome))
    while True:
        await socket.send_bytes(answer(await socket.receive_bytes()))


# Steps per second over sockets, for one and two workers, compared with the echo server. Planners
# run on the same machine as the worker, so they do as little as possible.

Figures = dict[str, Any]

Drive = Callable[[int], None]
"""Runs at least the given total number of steps."""
Driving = Callable[[str, int], AbstractContextManager[Drive]]
"""Connects a number of planners to the server at a URL."""

SCENE = "street"
SHORT_STEP_US = 1_000
START_S, DRIVE_S = 120.0, 600.0


def of_one_worker(sessions: int, steps: int, *, echo: bool = True) -> Figures:
    """Measure a single session, and many sessions with a socket each.

    Args:
        sessions: number of concurrent sessions.
        steps: steps per session.
        echo: whether to compare with echo servers.
    """
    with _workers(1) as (url,):
        one = _sessions_rate(_sessions, url, 1, steps)
        many = _sessions_rate(_sessions, url, sessions, steps)
        observation = _observation(url)
    figures: Figures = {
        "sessions": sessions,
        "steps_per_s": many,
        "one_session_steps_per_s": one,
        "ratio": many / one,
    }
    if echo:
        figures |= _beside_echoes(
            many, observation, lambda urls: _sessions_rate(_echoes, urls[0], sessions, steps)
        )
    return figures


def of_two_workers(sessions: int, steps: int, *, echo: bool = True) -> Figures:
    """Measure two workers with half of the sessions each; each has its own client process."""
    half = sessions // 2

    def rate(driving: Driving, urls: list[str]) -> float:
        return 2 * half * steps / max(_driven_beside_each_other(driving, urls, half, steps))

    with _workers(2) as urls:
        both = rate(_sessions, urls)
        observation = _observation(urls[0])
    figures: Figures = {"sessions": 2 * half, "steps_per_s": both}
    if echo:
        figures |= _beside_echoes(both, observation, partial(rate, _echoes), servers=2)
    return figures


def _beside_echoes(
    rate: float, observation: bytes, rate_of: Callable[[list[str]], float], *, servers: int = 1
) -> Figures:
    """Replies per second of echo servers by path in ``ECHOED``, and ``rate`` relative to them."""
    figures: Figures = {}
    with echo_servers(servers, observation) as urls:
        for what in ECHOED:
            echoed = rate_of([f"{url}/{what}" for url in urls])
            figures[f"echoed_{what}_per_s"], figures[f"of_echoed_{what}"] = echoed, rate / echoed
    return figures


def _observation(url: str) -> bytes:
    """A serialised observation of a worker's session."""
    with real2sim.connect(url) as client:
        info = client.sessions.create(scene=SCENE)
        with DriveProbe(info) as probe:
            obs, _ = probe.reset([], dt_us=SHORT_STEP_US)
        client.sessions.delete(info.session_id)
    return encode(obs)


@contextlib.contextmanager
def _workers(count: int) -> Iterator[list[str]]:
    """Run workers with separate data folders; yields their URLs."""
    with (
        tempfile.TemporaryDirectory(prefix="real2sim-bench-") as folder,
        contextlib.ExitStack() as running,
    ):
        scenes = Path(folder) / "scenes"
        unpack_street(scenes, f"{SCENE}.r2s")
        urls = []
        for k in range(count):
            data, log_file = Path(folder) / f"data{k}", Path(folder) / f"worker{k}.log"
            started = worker_process(scenes=scenes, data=data, log_file=log_file)
            urls.append(running.enter_context(started).url)
        yield urls


def _sessions_rate(driving: Driving, url: str, count: int, steps: int) -> float:
    with driving(url, count) as drive:
        drive(count)
        return count * steps / _seconds(lambda: drive(count * steps))


class _Meeting(NamedTuple):
    """Synchronisation of clients: the start barrier, and the queue of their times [s]."""

    together: Any
    found: Any


def _driven_beside_each_other(
    driving: Driving, urls: list[str], count: int, steps: int
) -> list[float]:
    """Times of client processes that start simultaneously [s]."""
    spawning = multiprocessing.get_context("spawn")
    meeting = _Meeting(spawning.Barrier(len(urls)), spawning.SimpleQueue())
    clients = [
        spawning.Process(target=_drive, args=(driving, url, count, steps, meeting), daemon=True)
        for url in urls
    ]
    for client in clients:
        client.start()
    for client in clients:
        client.join(START_S + DRIVE_S)
    if any(client.exitcode for client in clients) or meeting.found.empty():
        raise RuntimeError("a client of the bench has failed; it has said why")
    return [meeting.found.get() for _ in clients]


def _drive(driving: Driving, url: str, count: int, steps: int, meeting: _Meeting) -> None:
    """Main function of a client process."""
    with driving(url, count) as drive:
        drive(count)
        meeting.together.wait(START_S)
        meeting.found.put(_seconds(lambda: drive(count * steps)))


@contextlib.contextmanager
def _sessions(url: str, count: int) -> Iterator[Drive]:
    """Drive sessions of a worker, one socket each."""
    with real2sim.connect(url) as client:
        client.wait_ready()
        infos = [client.sessions.create(scene=SCENE) for _ in range(count)]
        with _planners(infos) as drive:
            yield drive
            for info in infos:
                client.sessions.delete(info.session_id)


@contextlib.contextmanager
def _echoes(url: str, count: int) -> Iterator[Drive]:
    """Drive sessions of an echo server, one socket each."""
    with _planners([echo_session(url)] * count) as drive:
        yield drive


@contextlib.contextmanager
def _planners(infos: Sequence[SessionInfo]) -> Iterator[Drive]:
    with (
        contextlib.ExitStack() as open_sockets,
        selectors.DefaultSelector() as waiting,
    ):
        for info in infos:
            probe = open_sockets.enter_context(DriveProbe(info))
            obs, _ = probe.reset([], dt_us=SHORT_STEP_US)
            waiting.register(probe.socket.socket, selectors.EVENT_READ, probe)
            probe.send(action(obs))

        def drive(steps: int) -> None:
            done = 0
            while done < steps:
                ready = waiting.select(ANSWER_S)
                if not ready:
                    raise TimeoutError(f"no observation within {ANSWER_S:g} s")
                for key, _ in ready:
                    probe: DriveProbe = key.data
                    probe.send(action(unpack(bytes(probe.socket.recv(ANSWER_S)))))
                    done += 1

        yield drive


def _seconds(call: Callable[[], None]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


SIZE = 84
LARGER = 6
"""Scale of the large image that is downscaled as ground truth."""
IMAGE_TIMES_S = (0.0, 2.0, 5.0, 8.0)
FULL = RasterOptions(depth=False, instance=False)
REDUCED = RasterOptions(depth=False, instance=False, detail="auto")


@dataclass(frozen=True)
class LearnBenchOptions:
    """Size of the benchmark.

    Attributes:
        worlds: worlds per batch.
        steps: steps of the batch, for each kind of traffic.
        image_steps: steps of the environment with images.
        repetitions: repetitions of a single image; the best counts.
        sessions: number of concurrent sessions over sockets.
        socket_steps: steps per session.
        echo: whether to compare sessions with echo servers.
    """

    worlds: int = 64
    steps: int = 200
    image_steps: int = 30
    repetitions: int = 10
    sessions: int = 16
    socket_steps: int = 300
    echo: bool = True


def run(options: LearnBenchOptions | None = None) -> Figures:
    """Measure, print and return all figures."""
    options = options or LearnBenchOptions()
    console = Console()
    scene = read_packed(SHIPPED)
    figures: Figures = {}
    for name, measure in PARTS.items():
        with console.status(name):
            figures[name] = measure(scene, options)
        print_figures(name, figures[name])
    return figures


def batched_worlds(scene: Scene, options: LearnBenchOptions) -> Figures:
    """World steps per second, batched and single."""
    return {
        traffic: _batched(scene, ResetSpec(action="control", agents={"default": traffic}), options)
        for traffic in ("log", "idm")
    }


def _batched(scene: Scene, spec: ResetSpec, options: LearnBenchOptions) -> Figures:
    batch = BatchWorld(scene, spec, options.worlds)
    commands = np.tile([0.5, 0.0], (options.worlds, 1))

    def step() -> int:
        going = int((~batch.over).sum())
        batch.step(commands)
        if batch.over.any():
            batch.reset(batch.over)
        return going

    step()
    batched = _rate(step, options.steps)
    alone = _single_rate(scene, spec, options.steps)
    return {"steps_per_s": batched, "single_world_steps_per_s": alone, "ratio": batched / alone}


def _single_rate(scene: Scene, spec: ResetSpec, steps: int) -> float:
    """Steps per second of a single world, excluding the creation of the next world."""
    state = ScenarioState.of(scene)
    plan = Control(acceleration=0.5, steering=0.0)
    world = World(scene, state, spec)
    world.step(plan)
    spent = 0.0
    for _ in range(steps):
        if world.over:
            world = World(scene, state, spec)
        started = time.perf_counter()
        world.step(plan)
        spent += time.perf_counter() - started
    return steps / spent


def vector_environment(_scene: Scene, options: LearnBenchOptions) -> Figures:
    """Images per second of the environment, including world steps."""
    env = VectorDriveEnv(
        options.worlds,
        cameras=["front"],
        size=(SIZE, SIZE),
        options={"horizon": 50},
        random_start=4.0,
    )
    env.reset(seed=0)
    actions = np.tile([0.2, 0.0], (options.worlds, 1))

    def step() -> int:
        env.step(actions)
        return options.worlds

    step()
    return {"worlds": options.worlds, "images_per_s": _rate(step, options.image_steps)}


def small_images(scene: Scene, options: LearnBenchOptions) -> Figures:
    """Milliseconds per image, and PSNR against a downscaled large image."""
    rows = [_small_image(scene, t, options.repetitions) for t in IMAGE_TIMES_S]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return {
        **means,
        "worst_ms": max(row["ms"] for row in rows),
        "worst_gain_db": min(row["psnr_db"] - row["full_psnr_db"] for row in rows),
        "ratio": means["full_ms"] / means["ms"],
    }


def _small_image(scene: Scene, seconds: float, repetitions: int) -> dict[str, float]:
    t_us = scene.start_us + round(seconds * 1e6)
    camera = fitted(scene.rig["front"], SIZE, SIZE)
    instances = instances_at(scene, ScenarioState.of(scene), t_us)
    viewmat = camera.viewmat(scene.ego.transform(t_us))

    def full(times: int = 1) -> np.ndarray:
        K = np.diag([times, times, 1.0]) @ camera.K
        size = SIZE * times
        drawn = rasterize(
            instances, viewmat[None], K[None], size, size, sky=scene.sky, options=FULL
        )
        return drawn.rgb[0].cpu().numpy().clip(0, 1)

    def reduced() -> np.ndarray:
        views = [View(instances, viewmat, camera.K)]
        drawn = rasterize_batch(views, SIZE, SIZE, sky=scene.sky, options=REDUCED)
        return drawn.rgb[0].cpu().numpy().clip(0, 1)

    truth = full(LARGER).reshape(SIZE, LARGER, SIZE, LARGER, 3).mean((1, 3))
    return {
        "ms": _best_ms(reduced, repetitions),
        "full_ms": _best_ms(full, repetitions),
        "psnr_db": _psnr(reduced(), truth),
        "full_psnr_db": _psnr(full(), truth),
    }


def sessions_over_sockets(_scene: Scene, options: LearnBenchOptions) -> Figures:
    """Steps per second of sessions without cameras, see :func:`of_one_worker`."""
    steps, echo = options.socket_steps, options.echo
    return of_one_worker(options.sessions, steps, echo=echo)


def sessions_of_two_workers(_scene: Scene, options: LearnBenchOptions) -> Figures:
    """Like :func:`sessions_over_sockets`, with half of the sessions in a second worker."""
    steps, echo = options.socket_steps, options.echo
    return of_two_workers(options.sessions, steps, echo=echo)


PARTS: dict[str, Callable[[Scene, LearnBenchOptions], Figures]] = {
    "small_images": small_images,
    "batched_worlds": batched_worlds,
    "vector_environment": vector_environment,
    "sessions_over_sockets": sessions_over_sockets,
    "sessions_of_two_workers": sessions_of_two_workers,
}


def _rate(call: Callable[[], int], times: int) -> float:
    """Sum of the results of ``times`` calls, per second."""
    started = time.perf_counter()
    done = sum(call() for _ in range(times))
    return done / (time.perf_counter() - started)


def _best_ms(draw: Callable[[], object], repetitions: int) -> float:
    draw()
    times = []
    for _ in range(repetitions):
        started = time.perf_counter()
        draw()
        times.append((time.perf_counter() - started) * 1e3)
    return min(times)


def _psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(((image - truth) ** 2).mean()))
