"""Rollout plans made from simulation requests."""

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
def test_the_background_is_solid_unless_excluded(tiny_scene, given, solid):
    request = SimulateRequest(**SHORT, objects=["car_red"], background=given)
    plan = plan_rollout(tiny_scene, ScenarioState.of(tiny_scene), request)
    assert plan.options.background is solid


def test_the_ego_is_simulated_and_visible_only_from_outside(tiny_scene, tmp_path):
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


def test_an_unknown_object_is_named_in_the_error(tiny_scene):
    request = SimulateRequest(**SHORT, objects=["ego", "nobody"])
    with pytest.raises(ServiceError, match="nobody"):
        plan_rollout(tiny_scene, ScenarioState.of(tiny_scene), request)
