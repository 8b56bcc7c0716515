"""Consistency of edits and steps written by many clients through the proxy while workers are
killed. Every acknowledged write is stored exactly once."""

from __future__ import annotations

import json
import os
import random
import threading
import urllib.error
import urllib.request
import uuid
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import pytest

from tests.waiting import LIMIT_S, wait_until

from .test_fleet_kill import WORKERS, Fleet, fleet  # noqa: F401, a fixture

pytestmark = [pytest.mark.network, pytest.mark.slow]

WRITES = int(os.environ.get("REAL2SIM_TEST_WRITES", "600"))
SCENARIOS, SESSIONS, CLIENTS, KILLS = 3, 4, 8, 3
GIVE_UP = 0.05
"""Share of writes that are sent once, without reading the answer."""


COMES_AGAIN = (409, 412, 429, 502, 503, 504)
"""Statuses after which a request is retried."""


@dataclass
class History:
    """Writes from the clients' point of view.

    Attributes:
        acknowledged: for each target, the mark of each write and the position in its answer.
        unknown: marks of writes without an answer.
    """

    acknowledged: dict[str, dict[int, int]] = field(default_factory=dict)
    unknown: dict[str, set[int]] = field(default_factory=dict)


def call(url: str, method: str, body: dict | None, headers: dict[str, str]) -> dict:
    data = json.dumps(body).encode() if body is not None else None
    given = {"Content-Type": "application/json"} | headers
    request = urllib.request.Request(url, data, given, method=method)
    with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
        return json.loads(answer.read() or b"null")


def write(url: str, body: dict, headers: dict[str, str], *, once: bool) -> dict | None:
    """The answer to a write. Retried under its key until there is one, unless ``once``."""
    headers = headers | {"Idempotency-Key": uuid.uuid4().hex}
    last = ""

    def tried() -> dict | None:
        nonlocal last
        try:
            return call(url, "POST", body, headers)
        except urllib.error.HTTPError as error:
            if error.code not in COMES_AGAIN:
                raise AssertionError(f"{error.code}: {error.read()!r}") from error
            last = error.read().decode()
            if "EPISODE_OVER" in last:
                return {"over": True}
        except (OSError, ValueError) as error:
            last = repr(error)
        return None

    return tried() if once else wait_until(tried, lambda: f"an answer: {last}")


class Site:
    """Scenarios and sessions of a fleet, and the writes to them."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.history = History()
        self.scenarios = [
            self._new("/v1/scenarios", {"scene": "tiny"})["scenario_id"] for _ in range(SCENARIOS)
        ]
        reset = {"reset": {"action": "control"}}
        made = [self._new("/v1/sessions?scene=tiny", reset) for _ in range(SESSIONS)]
        self.tokens = {m["session_id"]: {"Authorization": f"Bearer {m['token']}"} for m in made}
        for name in [*self.scenarios, *self.tokens]:
            self.history.acknowledged[name], self.history.unknown[name] = {}, set()

    def _new(self, path: str, body: dict) -> dict:
        return call(self.url + path, "POST", body, {})

    def edit(self, mark: int, chance: random.Random) -> None:
        """Move the post by an amount unique to this mark."""
        name = chance.choice(self.scenarios)
        operation = {"op": "translate", "object_id": "post", "x": mark * 1e-6}
        url = f"{self.url}/v1/scenarios/{name}/operations"
        once = chance.random() < GIVE_UP
        answer = write(url, {"operations": [operation]}, {}, once=once)
        self._note(name, mark, answer and answer["revision"])

    def step(self, name: str, mark: int, *, once: bool) -> None:
        """One step of a session. Resets the session when its episode is over."""
        url = f"{self.url}/v1/sessions/{name}/step"
        answer = write(url, {}, self.tokens[name], once=once)
        if answer is not None and answer.get("over"):
            again = url.removesuffix("step") + "reset"
            write(again, {"action": "control"}, self.tokens[name], once=False)
            answer = write(url, {}, self.tokens[name], once=once)
        self._note(name, mark, answer and answer["step"])

    def _note(self, name: str, mark: int, number: int | None) -> None:
        if number is None:
            self.history.unknown[name].add(mark)
        else:
            self.history.acknowledged[name][mark] = number

    def marks_of_scenario(self, name: str) -> list[tuple[int, int]]:
        """Marks and revisions of all recorded edits."""
        url = f"{self.url}/v1/scenarios/{name}/operations"
        entries = call(url, "GET", None, {})["entries"]
        return [(round(e["operations"][0]["x"] * 1e6), e["revision"]) for e in entries]


def check(name: str, found: list[tuple[int, int]], history: History) -> None:
    """Check that each acknowledged write is stored once at its reported position, that no unknown
    mark is stored, and that positions are contiguous."""
    told = history.acknowledged[name]
    times = Counter(mark for mark, _ in found)
    assert not [mark for mark, many in times.items() if many > 1], "written twice"
    assert not set(told) - set(times), "acknowledged and lost"
    assert set(times) <= set(told) | history.unknown[name], "never sent"
    assert [number for _, number in found] == list(range(1, len(found) + 1))
    places = dict(found)
    assert {mark: places[mark] for mark in told} == told


@pytest.mark.timeout(3600)
def test_acknowledged_writes_are_stored_exactly_once_while_workers_are_killed(fleet):  # noqa: F811
    site = Site(fleet.url)
    over, kills = threading.Event(), []
    counter, lock, begun = iter(range(1, WRITES + 1)), threading.Lock(), [0]

    def kill_now_and_then() -> None:
        chance = random.Random(11)
        for k in range(KILLS):
            due = (k + 1) * WRITES // (KILLS + 1)
            wait_until(lambda due=due: begun[0] >= due or over.is_set(), f"{due} writes")
            name = chance.choice(WORKERS)
            fleet.workers[name].kill()
            kills.append(name)
            fleet.workers[name].start()
            fleet.workers[name].wait_ready(120)

    def write_on(client: int) -> None:
        chance = random.Random(client)
        session = list(site.tokens)[client] if client < SESSIONS else None
        while True:
            with lock:
                mark = next(counter, None)
                begun[0] = mark or WRITES
            if mark is None:
                return
            if session is not None:
                # The only client of its session, so that the order of its steps is known.
                site.step(session, mark, once=False)
            else:
                site.edit(mark, chance)

    with ThreadPoolExecutor(CLIENTS + 1) as threads:
        killing = threads.submit(kill_now_and_then)
        try:
            for writer in [threads.submit(write_on, client) for client in range(CLIENTS)]:
                writer.result()
        finally:
            over.set()
            killing.result()

    for name in site.scenarios:
        check(name, site.marks_of_scenario(name), site.history)
    for name in site.tokens:
        # In the order in which they were made: consecutive, restarting with each episode.
        steps = [
            site.history.acknowledged[name][m] for m in sorted(site.history.acknowledged[name])
        ]
        horizon = max(steps)
        assert steps == [1 + k % horizon for k in range(len(steps))]
        state = call(f"{site.url}/v1/sessions/{name}/state", "GET", None, site.tokens[name])
        assert state["step"] == steps[-1]
    assert fleet.logs_are_whole()
    unknown = sum(map(len, site.history.unknown.values()))
    print(f"{WRITES} writes, {len(kills)} kills, {unknown} answers never read")
