"""The protocol page documents what a client in another language needs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from real2sim_proto import HTTP_STATUS, ErrorCode
from real2sim_proto.drive import EgoState, Event, EventType, Hello, Obs, Resume
from real2sim_server.service.sessions.connection import NORMAL_CLOSURE
from real2sim_server.service.sessions.messages import POLICY_VIOLATION
from real2sim_server.world.scoring import METRICS

pytestmark = pytest.mark.network

PAGE = (Path(__file__).resolve().parents[4] / "docs" / "protocol.md").read_text("utf-8")


def section(title: str) -> str:
    """Text under a heading, up to the next heading of the same level."""
    found = re.search(rf"^(#+) {title}\n(.*?)(?=^#|\Z)", PAGE, re.M | re.S)
    assert found, title
    return found.group(2)


def first_cells(text: str) -> set[str]:
    """Backquoted names and numbers in the first column of tables."""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("|")]
    return {word for cell in cells for word in re.findall(r"[a-z_0-9]+", cell)}


@pytest.fixture
def observed(site, join) -> dict[str, Any]:
    """An observation with an image, after a collision with the lead vehicle."""
    planner = join(site.create())
    sensors = [{"camera": "front", "codec": "raw"}]
    contact = {"on_collision": "continue", "contact": {"dents": False}}
    obs = planner.reset(sensors=sensors, privileged=True, **contact)
    while not obs["events"] or obs["step"] < 5:
        obs = planner.act(obs["step"], acceleration=20.0)
        if obs["truncated"]:
            break
    return obs


def test_every_close_code_is_documented():
    rows = first_cells(section("Closing"))
    ours = {NORMAL_CLOSURE, POLICY_VIOLATION}
    # Sent by libraries: invalid UTF-8, too large, error or missing pong, stopping, restarting.
    theirs = {1007, 1009, 1011, 1001, 1012}
    assert {str(code) for code in ours | theirs} <= rows


def test_documented_handshake_statuses_match_their_codes():
    text = section("Closing").partition("A handshake that fails")[2]
    named = re.findall(r"(\d{3}) \(`(\w+)`", text)
    assert len(named) == 4
    assert all(HTTP_STATUS[ErrorCode(code)] == int(status) for status, code in named)


def test_every_event_and_its_data_are_documented(observed):
    text = section("Observations")
    assert set(get_args(EventType)) <= first_cells(text)
    declared = Event.model_json_schema()["properties"]["type"]["enum"]
    assert set(declared) == set(get_args(EventType))
    for event in observed["events"]:
        lacking = [name for name in event["data"] if f"`{name}`" not in text]
        assert lacking == [], event["type"]


def test_every_metric_is_documented(observed):
    rows = first_cells(section("Observations"))
    assert set(observed["metrics"]) <= rows
    assert {name for name, metric in METRICS.items() if metric.streamed} <= rows
    assert "ttc" in rows


def test_every_observation_field_is_documented():
    text = section("Observations")
    fields = (set(Obs.model_fields) | set(EgoState.model_fields)) - {"v", "type", "id"}
    assert [name for name in sorted(fields) if f"`{name}`" not in text] == []


def test_arrays_have_the_documented_shapes(observed):
    frame = observed["frames"][0]
    arrays = {"route": observed["route"], "K": frame["K"]}
    arrays["T_world_sensor"] = frame["T_world_sensor"]
    text = re.sub(r"\s+", " ", PAGE)
    for name, array in arrays.items():
        assert isinstance(array, np.ndarray)
        said = re.search(rf"`{name}`(?: \|)?,? (\w+) (\[[\d, ]+\])", text)
        assert said, name
        assert said.groups() == (array.dtype.name, str(list(array.shape)))


def test_the_fields_of_resume_are_documented():
    text = section("Resuming")
    assert all(re.search(rf"\b{name}\b", text) for name in Resume.model_fields)
    assert "resume" in Hello.model_fields
    assert "`id` 0" in text


def test_a_session_requires_its_token_even_without_a_worker_token(site):
    info = site.create()
    url = f"/v1/sessions/{info['session_id']}"
    refused = site.http.get(url)
    assert (refused.status_code, refused.json()["code"]) == (401, "UNAUTHORIZED")
    assert site.call("GET", info).status_code == 200


def test_unsolicited_messages_are_documented_with_id_0():
    text = section("Rules")
    assert all(name in text for name in ("`obs`", "`progress`", "`error`", "`deadline_missed`"))
    assert "`id` 0" in text
