"""Steps a second of sessions without cameras, in sum, over sockets: one worker, and two of them.

Planners answer each on their own, as soon as an observation is there. They share the machine with
what they measure, so they do as little as a planner can.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import selectors
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import real2sim
from real2sim_proto.codec import unpack

from ..demo.street import unpack_street
from ..demo.worker import worker_process
from .batch_probe import BatchProbe
from .drive_probe import ANSWER_S, DriveProbe, action

Figures = dict[str, Any]

SCENE = "street"
SHORT_STEP_US = 1_000
START_S, DRIVE_S = 120.0, 600.0


def of_one_worker(sessions: int, steps: int) -> Figures:
    """One session alone, many on a socket each, and the same stepped by one message.

    Args:
        sessions: driven at once.
        steps: of each.
    """
    with _workers(1) as (url,):
        one = _rate(url, 1, steps)
        many = _rate(url, sessions, steps)
        batch = _rate_by_one_message(url, sessions, steps)
    return {
        "sessions": sessions,
        "steps_per_s": many,
        "one_session_steps_per_s": one,
        "ratio": many / one,
        "by_one_message_steps_per_s": batch,
        "by_one_message_ratio": batch / many,
    }


def of_two_workers(sessions: int, steps: int) -> Figures:
    """Half of the sessions on each of two workers, each half driven by a process of its own."""
    half = sessions // 2
    with _workers(2) as urls:
        seconds = _driven_beside_each_other(urls, half, steps)
    return {"sessions": 2 * half, "steps_per_s": 2 * half * steps / max(seconds)}


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


def _rate(url: str, count: int, steps: int) -> float:
    with _driving(url, count) as drive:
        drive(count)
        return count * steps / _seconds(lambda: drive(count * steps))


def _driven_beside_each_other(urls: list[str], count: int, steps: int) -> list[float]:
    """How long each of several clients takes [s], which begin together."""
    spawning = multiprocessing.get_context("spawn")
    together, found = spawning.Barrier(len(urls)), spawning.SimpleQueue()
    clients = [
        spawning.Process(target=_drive, args=(url, count, steps, together, found), daemon=True)
        for url in urls
    ]
    for client in clients:
        client.start()
    for client in clients:
        client.join(START_S + DRIVE_S)
    if any(client.exitcode for client in clients) or found.empty():
        raise RuntimeError("a client of the bench has failed; it has said why")
    return [found.get() for _ in clients]


def _drive(url: str, count: int, steps: int, together: Any, found: Any) -> None:
    """A client in a process of its own."""
    with _driving(url, count) as drive:
        drive(count)
        together.wait(START_S)
        found.put(_seconds(lambda: drive(count * steps)))


@contextlib.contextmanager
def _driving(url: str, count: int) -> Iterator[Callable[[int], None]]:
    """Drives sessions on a socket each: so many steps in sum, and a few more."""
    with real2sim.connect(url) as client, contextlib.ExitStack() as open_sockets:
        client.wait_ready()
        infos = [client.sessions.create(scene=SCENE) for _ in range(count)]
        waiting = open_sockets.enter_context(selectors.DefaultSelector())
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
        for info in infos:
            client.sessions.delete(info.session_id)


def _rate_by_one_message(url: str, count: int, steps: int) -> float:
    with real2sim.connect(url) as client:
        client.wait_ready()
        infos = [client.sessions.create(scene=SCENE) for _ in range(count)]
        with BatchProbe(infos) as probe:
            obs = probe.act(probe.reset(dt_us=SHORT_STEP_US))

            def drive() -> None:
                nonlocal obs
                for _ in range(steps):
                    obs = probe.act(obs)

            rate = count * steps / _seconds(drive)
        for info in infos:
            client.sessions.delete(info.session_id)
    return rate


def _seconds(call: Callable[[], None]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started
