"""Storyboards of scenarios over REST: JSON, OpenSCENARIO files and the gallery."""

from __future__ import annotations

import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import Storyboard
from real2sim_server.scenarios.gallery import GALLERY, corner_case
from real2sim_server.scenarios.openscenario import write_openscenario

XOSC = {"Content-Type": "application/xml"}
FILE = write_openscenario(corner_case("ccrb").storyboard(gap=9.0))


@pytest.fixture
def url(client) -> str:
    scenario = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    return f"/v1/scenarios/{scenario}"


def stored(client, url) -> Storyboard | None:
    found = client.get(f"{url}/storyboard").json()
    return None if found is None else Storyboard.model_validate(found)


def test_a_storyboard_is_stored_with_its_scenario(client, url):
    assert stored(client, url) is None
    board = corner_case("cut_in").storyboard()
    answer = client.put(f"{url}/storyboard", json=board.model_dump(mode="json"))

    assert answer.headers["ETag"] == '"r1"'
    assert stored(client, url) == board
    assert Storyboard.model_validate(client.get(url).json()["storyboard"]) == board
    client.post(f"{url}/undo")
    assert stored(client, url) is None
    client.post(f"{url}/redo")
    client.delete(f"{url}/storyboard")
    assert stored(client, url) is None


def test_a_storyboard_survives_a_fork_and_an_export(client, url):
    client.post(f"{url}/corner-case", json={"name": "cpna_25", "parameters": {"speed": 1.1}})
    fork = client.post(f"{url}/fork").headers["Location"]
    copy = client.post("/v1/scenarios/import", json=client.get(f"{url}/export").json())

    board = corner_case("cpna_25").storyboard(speed=1.1)
    assert stored(client, fork) == board
    assert stored(client, copy.headers["Location"]) == board


def test_a_negative_time_is_refused_with_the_path_to_it(client, url):
    board = corner_case("cut_in").storyboard().model_dump(mode="json")
    board["parameters"]["duration"] = -2.0
    told = client.put(f"{url}/storyboard", json=board).text

    assert "move_in_lane_change: the time of its dynamics is -2; it must be 0 or more" in told


def test_an_openscenario_file_round_trips(client, url):
    answer = client.put(f"{url}/storyboard.xosc", content=FILE, headers=XOSC)

    assert (answer.status_code, answer.json()["notes"]) == (200, [])
    assert stored(client, url).parameters["gap"] == 9.0
    out = client.get(f"{url}/storyboard.xosc")
    assert out.headers["content-type"] == "application/xml"
    assert out.content == FILE


def test_an_unsupported_element_is_refused_with_its_line(client, url):
    text = FILE.decode().replace("LongitudinalAction>", "TrafficAction>")
    line = text[: text.index("<TrafficAction>")].count("\n") + 1
    refused = client.put(f"{url}/storyboard.xosc", content=text.encode(), headers=XOSC)
    problem = refused.json()

    assert problem["code"] == ErrorCode.INVALID_REQUEST
    assert f"line {line}: <TrafficAction> is not supported" in problem["detail"]
    assert stored(client, url) is None


def test_an_element_without_effect_is_noted_or_refused_if_strict(client, url):
    text = FILE.decode().replace("LongitudinalAction>", "TrailerAction>").encode()
    path = f"{url}/storyboard.xosc"
    strict = client.put(path, params={"strict": True}, content=text, headers=XOSC)
    noted = client.put(path, content=text, headers=XOSC)

    assert "<TrailerAction> is not supported" in strict.json()["detail"]
    assert any("<TrailerAction> is ignored" in note for note in noted.json()["notes"])


def test_unknown_storyboards_cases_and_parameters_are_refused(client, url):
    assert "nothing is written" in client.get(f"{url}/storyboard.xosc").json()["detail"]
    for body, message in (
        ({"name": "cut_on"}, "the gallery has no 'cut_on'"),
        ({"name": "cut_in", "parameters": {"gab": 3}}, "no parameter 'gab'"),
    ):
        assert message in client.post(f"{url}/corner-case", json=body).json()["detail"]


def test_a_change_for_a_stale_revision_is_refused(client, url):
    client.post(f"{url}/corner-case", json={"name": "ccrs"})
    headers = XOSC | {"If-Match": '"r0"'}
    stale = client.put(f"{url}/storyboard.xosc", content=FILE, headers=headers)
    assert stale.json()["code"] == ErrorCode.STALE_REVISION


def test_all_gallery_cases_are_listed(client):
    cases = client.get("/v1/gallery").json()["cases"]
    assert [case["name"] for case in cases] == list(GALLERY)
    assert cases[0] == {
        "name": "ccrs", "title": GALLERY["ccrs"].title, "family": "ahead",
        "parameters": {"gap": 40.0, "offset": 0.0}, "picture": "/v1/gallery/ccrs/picture",
    }  # fmt: skip


def test_each_gallery_case_has_a_picture(client):
    cases = client.get("/v1/gallery").json()["cases"]
    pictures = [client.get(case["picture"]) for case in cases]
    assert {answer.headers["Content-Type"] for answer in pictures} == {"image/svg+xml"}
    assert len({answer.content for answer in pictures}) == len(GALLERY)
    assert client.get("/v1/gallery/cut_on/picture").json()["code"] == "NOT_FOUND"
