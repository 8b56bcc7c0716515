"""Steps a second of sessions without cameras, in sum, over sockets: one worker, and two of them,
each beside a server that does nothing but to answer in the same run.

Planners answer each on their own, as soon as an observation is there. They share the machine with
what they measure, so they do as little as a planner can.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import selectors
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import real2sim
from real2sim_proto import encode
from real2sim_proto.codec import unpack
from real2sim_proto.sessions import SessionInfo

from ..demo.street import unpack_street
from ..demo.worker import worker_process
from .drive_probe import ANSWER_S, DriveProbe, action
from .echo_server import ECHOED, echo_servers, echo_session

Figures = dict[str, Any]

Drive = Callable[[int], None]
"""Makes so many steps in sum, and a few more."""
Driving = Callable[[str, int], AbstractContextManager[Drive]]
"""Connects so many planners to the server at a URL."""

SCENE = "street"
SHORT_STEP_US = 1_000
START_S, DRIVE_S = 120.0, 600.0


def of_one_worker(sessions: int, steps: int, *, echo: bool = True) -> Figures:
    """One session alone, and many on a socket each.

    Args:
        sessions: driven at once.
        steps: of each.
        echo: whether they stand beside servers without worlds.
    """
    with _workers(1) as (url,):
        one = _rate(_sessions, url, 1, steps)
        many = _rate(_sessions, url, sessions, steps)
        observation = _observation(url)
    figures: Figures = {
        "sessions": sessions,
        "steps_per_s": many,
        "one_session_steps_per_s": one,
        "ratio": many / one,
    }
    if echo:
        figures |= _beside_echoes(
            many, observation, lambda urls: _rate(_echoes, urls[0], sessions, steps)
        )
    return figures


def of_two_workers(sessions: int, steps: int, *, echo: bool = True) -> Figures:
    """Half of the sessions on each of two workers, each half driven by a process of its own."""
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
    """Answers a second of servers without worlds: such as only pass bytes, and such as also read
    each action and pack each observation; and what of these ``rate`` is."""
    figures: Figures = {}
    with echo_servers(servers, observation) as urls:
        for what in ECHOED:
            echoed = rate_of([f"{url}/{what}" for url in urls])
            figures[f"echoed_{what}_per_s"], figures[f"of_echoed_{what}"] = echoed, rate / echoed
    return figures


def _observation(url: str) -> bytes:
    """One of a session of a worker, as it is sent."""
    with real2sim.connect(url) as client:
        info = client.sessions.create(scene=SCENE)
        with DriveProbe(info) as probe:
            obs, _ = probe.reset([], dt_us=SHORT_STEP_US)
        client.sessions.delete(info.session_id)
    return encode(obs)


@contextlib.contextmanager
def _workers(count: int) -> Iterator[list[str]]:
    """Where so many workers listen, each with a store of its own."""
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


def _rate(driving: Driving, url: str, count: int, steps: int) -> float:
    with driving(url, count) as drive:
        drive(count)
        return count * steps / _seconds(lambda: drive(count * steps))


class _Meeting(NamedTuple):
    """Of clients that begin together: where they wait, and where each puts its seconds."""

    together: Any
    found: Any


def _driven_beside_each_other(
    driving: Driving, urls: list[str], count: int, steps: int
) -> list[float]:
    """How long each of several clients takes [s], which begin together."""
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
    """A client in a process of its own."""
    with driving(url, count) as drive:
        drive(count)
        meeting.together.wait(START_S)
        meeting.found.put(_seconds(lambda: drive(count * steps)))


@contextlib.contextmanager
def _sessions(url: str, count: int) -> Iterator[Drive]:
    """Drives sessions of a worker, on a socket each."""
    with real2sim.connect(url) as client:
        client.wait_ready()
        infos = [client.sessions.create(scene=SCENE) for _ in range(count)]
        with _planners(infos) as drive:
            yield drive
            for info in infos:
                client.sessions.delete(info.session_id)


@contextlib.contextmanager
def _echoes(url: str, count: int) -> Iterator[Drive]:
    """The same of a server without worlds."""
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
