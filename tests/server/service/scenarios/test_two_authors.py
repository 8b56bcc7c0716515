"""Two clients edit one scenario concurrently, each with its last known revision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from real2sim_proto.scenarios import HistoryEntry
from real2sim_server.edit import EditError, PlannedEntry, Scenario, ScenarioState
from real2sim_server.service.scenario_cache import ScenarioView, replayed

NAMES = ("anna", "bert")
OBJECTS = st.sampled_from(["car_red", "car_blue", "post", "car_red_copy1"])
METRES = st.floats(-5, 5).map(lambda v: round(v, 3))
OPERATIONS = st.one_of(
    st.fixed_dictionaries({"op": st.just("translate"), "object_id": OBJECTS, "x": METRES}),
    st.fixed_dictionaries({"op": st.just("rotate"), "object_id": OBJECTS, "angle": METRES}),
    st.fixed_dictionaries({"op": st.sampled_from(["delete", "restore"]), "object_id": OBJECTS}),
    st.fixed_dictionaries({"op": st.just("duplicate"), "object_id": OBJECTS, "y": METRES}),
)
MOVES = st.one_of(
    st.lists(OPERATIONS, min_size=1, max_size=3), st.just("undo"), st.just("undo"), st.just("redo")
)
TURNS = st.lists(st.tuples(st.sampled_from(NAMES), MOVES), min_size=1, max_size=14)


@dataclass
class Author:
    """A client that updates its local copy only from server answers."""

    http: Any
    url: str
    name: str
    own: Scenario

    def act(self, move: list[dict[str, Any]] | str) -> int | None:
        """The acknowledged revision, or None if the server refused."""
        call = "operations" if isinstance(move, list) else move
        answer = self.http.post(
            f"{self.url}/{call}",
            json={"operations": move} if isinstance(move, list) else None,
            headers={"If-Match": f'"r{self.own.revision}"', "X-Real2Sim-Client": self.name},
        )
        if answer.status_code == 412:
            told = answer.json()
            assert told["missed"], "a stale edit must be told what it missed"
            self.learn(told["missed"])
            assert self.own.revision == told["revision"]
            return None
        entry = {"revision": self.own.revision + 1} | self._kind(move)
        if answer.status_code != 200:
            # Nothing was missed, so the author can derive the reason from its own state.
            with pytest.raises(EditError) as seen:
                self._planned(HistoryEntry(created_at="", **entry))
            assert answer.json()["code"] == seen.value.code
            return None
        assert answer.json()["revision"] == entry["revision"]
        self.learn([entry | {"created_at": ""}])
        return self.own.revision

    def learn(self, entries: list[dict[str, Any]]) -> None:
        for entry in map(HistoryEntry.model_validate, entries):
            planned = self._planned(entry)
            assert planned.entry.revision == entry.revision
            assert planned.entry.target == entry.target or entry.created_at == ""
            self.own.commit(planned)

    def catch_up(self) -> None:
        answer = self.http.get(f"{self.url}/operations", params={"after": self.own.revision})
        self.learn(answer.json()["entries"])

    def _planned(self, entry: HistoryEntry) -> PlannedEntry:
        match entry.kind:
            case "edit":
                return self.own.plan_edit(entry.operations)
            case "undo":
                return self.own.plan_undo()
            case "redo":
                return self.own.plan_redo()

    def _kind(self, move: list[dict[str, Any]] | str) -> dict[str, Any]:
        if isinstance(move, list):
            return {"kind": "edit", "operations": move}
        return {"kind": move}


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(turns=TURNS)
def test_any_interleaving_leads_both_authors_to_the_server_state(client, turns):
    url = client.post("/v1/scenarios", json={"scene": "tiny"}).headers["Location"]
    view = client.portal.call(client.app.state.worker.scenarios.view, url.rsplit("/", 1)[-1])
    initial = ScenarioState.of(view.summary)
    authors = {name: Author(client, url, name, Scenario(initial)) for name in NAMES}
    acknowledged: list[tuple[int, str]] = []

    for name, move in turns:
        revision = authors[name].act(move)
        if revision is not None:
            acknowledged.append((revision, name))
    for author in authors.values():
        author.catch_up()

    history = client.get(f"{url}/operations").json()["entries"]
    assert [(e["revision"], e["who"]) for e in history] == acknowledged
    log = [HistoryEntry.model_validate(e) for e in history]
    found = client.get(url).json()
    for scenario in (
        *(a.own for a in authors.values()),
        replayed(view.row, view.summary, log, None),
    ):
        assert _as_service_error(view, scenario) == found


def _as_service_error(view: ScenarioView, scenario: Scenario) -> dict[str, Any]:
    """The server's description of this scenario."""
    shown = ScenarioView(
        row=view.row,
        summary=view.summary,
        state=scenario.state,
        revision=scenario.revision,
        can_undo=scenario.can_undo,
        can_redo=scenario.can_redo,
    )
    return shown.info().model_dump(mode="json")
