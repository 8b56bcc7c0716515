"""What a request to simulate asks for: the background as colliders, the ego as an object."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.jobs import SimulateRequest
from real2sim_server.edit import ScenarioState
from real2sim_server.service.http.responses import ServiceError
from real2sim_server.service.rollouts import RolloutPlayback, plan_rollout, run_rollout
from real2sim_server.simulation.result import SimulationResult

SHORT = {"end_us": 100_000, "frame_us": 100_000}


@pytest.mark.parametrize(("given", "solid"), [(None, True), (True, True), (False, False)])
def test_the_background_is_solid_unless_it_is_left_out(tiny_scene, given, solid):
    request = SimulateRequest(**SHORT, objects=["car_red"], background=given)
    plan = plan_rollout(tiny_scene, ScenarioState.of(tiny_scene), request)
    assert plan.options.background is solid


def test_the_ego_takes_part_and_is_seen_from_outside_alone(tiny_scene, tmp_path):
    state = ScenarioState.of(tiny_scene)
    plan = plan_rollout(tiny_scene, state, SimulateRequest(**SHORT, objects=["ego"]))
    told, _ = run_rollout(plan, tmp_path, progress=lambda share: None, cancelled=lambda: False)
    assert told["objects"] == ["ego"]
    assert told["figures"]["background"] == []
    result = SimulationResult.load(tmp_path)
    assert result.objects["ego"].velocities[0] == pytest.approx([5.0, 0.0, 0.0], abs=0.01)
    playback = RolloutPlayback(tiny_scene, state, result)
    aboard, outside = (playback.instances(100_000, aboard=where) for where in (True, False))
    new = {i.instance_id for i in outside} - {i.instance_id for i in aboard}
    assert new == {1 + max(o.instance_id for o in state.visible)}
    (ego,) = (i for i in outside if i.instance_id in new)
    assert np.ptp(ego.cloud.means.numpy(), axis=0)[0] == pytest.approx(4.6, abs=0.05)


def test_who_is_not_there_is_named(tiny_scene):
    request = SimulateRequest(**SHORT, objects=["ego", "nobody"])
    with pytest.raises(ServiceError, match="nobody"):
        plan_rollout(tiny_scene, ScenarioState.of(tiny_scene), request)
