"""Sweep and search jobs of a worker."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from real2sim_proto.sweeps import SweepRequest
from real2sim_server.executors import InProcess
from real2sim_server.scenarios.gallery import corner_case
from real2sim_server.scenarios.openscenario import read_openscenario_text, write_openscenario
from real2sim_server.service import drives, sweeps
from real2sim_server.service.sweeps import write_spec
from real2sim_server.sweeps import load_sweep, run_sweep
from real2sim_server.world.recording import recording_of_bytes
from tests.server.planners import ALL, AND_LIMITS, none_left_running
from tests.waiting import wait_until

from ..waiting import finished

GAP = {"kind": "float", "low": 6.0, "high": 14.0}
CUT_IN = {
    "scene": "tiny",
    "corner_case": "cut_in",
    "reset": {"horizon": 8},
    "parameters": {"gap": GAP},
    "method": {"kind": "grid", "levels": 3},
    "planners": ["idm", "follow_route"],
    "worst": 2,
}


@pytest.fixture(autouse=True)
def _hardly_gives_way(monkeypatch):
    """A sweep that yields to other work would take minutes."""
    monkeypatch.setattr(drives, "NICENESS", 1)


def over(client, job: dict) -> dict:
    return finished(client, f"/v1/jobs/{job['job_id']}")


def wait_driving(client, job: dict) -> None:
    """Wait until a sweep drives its episodes."""
    path = f"/v1/jobs/{job['job_id']}"
    wait_until(lambda: "left" in client.get(path).json()["stage"], lambda: client.get(path).text)


def begun(client, **changes) -> dict:
    answer = client.post("/v1/sweeps", json=CUT_IN | changes)
    assert answer.status_code == 202, answer.text
    return answer.json()


def left(client, job: dict, name: str) -> bytes:
    answer = client.get(f"/v1/jobs/{job['job_id']}/files/{name}")
    assert answer.status_code == 200, answer.text
    return answer.content


def test_a_sweep_of_an_uploaded_scenario_matches_the_command(client, scenes_dir, tmp_path):
    text = write_openscenario(corner_case("cut_in").storyboard()).decode()
    job = over(client, begun(client, corner_case=None, openscenario=text))
    assert job["state"] == "succeeded", job["error"]
    table = left(client, job, "episodes.parquet")
    spec = {
        "case": {"name": "c", "scene": str(scenes_dir / "tiny.r2s"), "reset": CUT_IN["reset"]},
        "storyboard": "gallery:cut_in",
        **{k: CUT_IN[k] for k in ("parameters", "method", "planners", "worst")},
    }
    (tmp_path / "sweep.json").write_text(json.dumps(spec))
    run_sweep(load_sweep(tmp_path / "sweep.json"), tmp_path / "out", InProcess())
    assert table == (tmp_path / "out" / "episodes.parquet").read_bytes()
    episodes = pq.read_table(io.BytesIO(table))
    assert job["result"]["episodes"] == episodes.num_rows == 6
    assert sorted(set(episodes["gap"].to_pylist())) == [6.0, 10.0, 14.0]
    # The worst episodes have recordings and scenario files.
    assert len(job["result"]["worst"]) == 2
    for key in job["result"]["worst"]:
        recording_of_bytes(left(client, job, f"{key}.r2e"), key)
        board = read_openscenario_text(left(client, job, f"{key}.xosc"), key).board
        assert 6.0 <= float(board.parameters["gap"]) <= 14.0
    names = {file["name"] for file in job["files"]}
    assert len(names) == 5


def test_a_road_file_named_by_an_uploaded_scenario_is_not_read(tmp_path, scenes_dir):
    secret = tmp_path / "secret.xodr"
    secret.write_text("<OpenDRIVE/>")
    text = write_openscenario(corner_case("cut_in").storyboard()).decode()
    network = f'<RoadNetwork><LogicFile filepath="{secret}"/></RoadNetwork>'
    text = text.replace("<RoadNetwork/>", network).replace("<RoadNetwork />", network)
    asked = SweepRequest(scene="tiny", openscenario=text, parameters={"gap": GAP})
    write_spec(asked, tmp_path / "job", scenes_dir / "tiny.r2s")
    storyboard = load_sweep(tmp_path / "job" / "sweep.json").storyboard
    read = storyboard.read({"gap": 8.0})
    assert (read.board.roads.kind, read.road_file) == ("map", None)


def test_a_search_saves_its_failures_and_an_archive(client, tmp_path):
    pytest.importorskip("cmaes")
    ask = {"kind": "search", "episodes": 20, "shrink": 0}
    changes = {"method": ask, "planners": ["follow_route"]}
    body = {name: value for name, value in CUT_IN.items() if name != "worst"} | changes
    job = over(client, client.post("/v1/sweeps", json=body).json())
    assert job["state"] == "succeeded", job["error"]
    found = json.loads(left(client, job, "failures.json"))
    assert found["episodes"] == job["result"]["episodes"] == 20
    assert len(found["failures"]) == len(job["result"]["failures"])
    archive = left(client, job, "failures.tar")
    assert b"failures.html" in archive
    assert b"search.journal" not in archive
    assert str(tmp_path).encode() not in archive


@pytest.mark.slow
@pytest.mark.parametrize("limited", AND_LIMITS, ids=["misbehave", "never answer"])
def test_planners_that_misbehave_do_not_end_their_job(client, limited, monkeypatch, tmp_path):
    """Jobs only take planners of the SDK, so others are written into what the job reads."""
    reasons, limit_s = limited
    command = sweeps._command

    def with_planners(request, folder, scene):
        write_spec(request, folder, scene)
        spec = json.loads((folder / sweeps.SPEC).read_text())
        spec["planners"] = [*(ALL[name] for name in reasons), "idm"]
        (folder / sweeps.SPEC).write_text(json.dumps(spec))

    monkeypatch.chdir(Path(__file__).parents[4])
    monkeypatch.setattr(sweeps, "write_spec", with_planners)
    monkeypatch.setattr(sweeps, "_command", lambda *a: [*command(*a), "--plan-limit", str(limit_s)])
    with none_left_running(tmp_path):
        job = over(client, begun(client, method={"kind": "sobol", "count": 1}))
    assert job["state"] == "succeeded", job["error"]["detail"]
    assert job["result"]["planner_failed"] == len(reasons)
    rows = pq.read_table(io.BytesIO(left(client, job, "episodes.parquet"))).to_pylist()
    errors = {row["planner"]: row["error"] for row in rows}
    assert errors.pop("idm") is None
    assert all(errors[ALL[name]].startswith(reason) for name, reason in reasons.items())
    assert client.get("/v1/sessions").json()["sessions"] == []


@pytest.mark.slow
def test_a_sweep_can_be_cancelled(client):
    job = begun(client, method={"kind": "sobol", "count": 400})
    wait_driving(client, job)
    client.delete(f"/v1/jobs/{job['job_id']}")
    assert over(client, job)["state"] == "cancelled"


@pytest.mark.slow
def test_a_sweep_resumes_after_a_worker_restart(start_worker, run_worker, tmp_path):
    with run_worker() as client:
        job = begun(client, method={"kind": "sobol", "count": 50})
        wait_driving(client, job)
    with run_worker() as client:
        done = over(client, client.get(f"/v1/jobs/{job['job_id']}").json())
        assert (done["state"], done["result"]["episodes"]) == ("succeeded", 100)
        assert 0 < done["result"]["driven_now"] < 100


def test_a_search_resumes_after_a_worker_restart(start_worker, run_worker, tmp_path):
    pytest.importorskip("cmaes")
    ask = {"kind": "search", "episodes": 40, "shrink": 0}
    body = {name: value for name, value in CUT_IN.items() if name != "worst"}
    body |= {"method": ask, "planners": ["follow_route"]}
    with run_worker() as client:
        job = client.post("/v1/sweeps", json=body).json()
        wait_driving(client, job)
    with run_worker() as client:
        done = over(client, client.get(f"/v1/jobs/{job['job_id']}").json())
        assert (done["state"], done["result"]["episodes"]) == ("succeeded", 40)
        assert 0 < done["result"]["driven_now"] < 40


REFUSED = (
    ({"corner_case": "cut_off"}, "cut_off"),
    ({"scene": "nowhere"}, "no scene 'nowhere'"),
    ({"planners": ["learned=/etc/passwd"]}, "planners"),
    ({"planners": ["os:system"]}, "planners"),
    ({"method": {"kind": "sobol", "count": 10_000}}, "20000 episodes"),
    ({"reset": {"seed": 3}}, "reset names 'seed'"),
    ({"parameters": {}}, "nothing would vary"),
    ({"method": {"kind": "search"}}, "a search tests exactly one"),
    ({"corner_case": None, "openscenario": "<a/>"}, "a"),
    ({"openscenario": "<a/>"}, "give one of"),
)


def test_an_invalid_sweep_is_refused_before_it_starts(client):
    for changes, words in REFUSED:
        answer = client.post("/v1/sweeps", json=CUT_IN | changes)
        assert answer.status_code in {404, 422}, changes
        assert words in answer.text, changes


def test_an_unknown_scenario_parameter_fails_the_job_with_a_message(client, tmp_path):
    job = over(client, begun(client, parameters={"gapp": GAP}))
    assert job["state"] == "failed"
    assert "no parameter 'gapp'" in job["error"]["detail"]
    assert str(tmp_path) not in job["error"]["detail"]
