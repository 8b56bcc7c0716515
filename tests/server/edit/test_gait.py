"""Edits that change how a person walks."""

from __future__ import annotations

import pytest
import torch

from real2sim_proto.operations import Insert, SetGait
from real2sim_server.edit import EditError, ScenarioState, apply_operations, instances_at
from real2sim_server.edit.compose import figure_of
from real2sim_server.edit.state import pack_state, unpack_state
from real2sim_server.scene.asset import person_asset
from real2sim_server.service.library.assets import LibraryAsset

ANNA = LibraryAsset(person_asset("anna", "woman"))
HALF = 2**-0.5
TRACK = {
    "times_us": [0, 2_000_000],
    "positions": [[7.0, -1.4, 0.8], [7.0, 1.4, 0.8]],
    "quaternions": [[HALF, 0.0, 0.0, HALF]] * 2,
}


@pytest.fixture
def state(tiny_scene) -> ScenarioState:
    before = ScenarioState.of(tiny_scene, assets={"anna": ANNA}.get)
    insert = Insert.model_validate({"asset_id": "anna", "object_id": "a", "trajectory": TRACK})
    return apply_operations(before, [insert]).state


def drawn(scene, state) -> torch.Tensor:
    return instances_at(scene, state, 900_000)[-2].cloud.means


def walked(state, **gait):
    return apply_operations(state, [SetGait(object_id="a", **gait)])


def test_a_gait_edit_changes_the_walk_and_undo_restores_it(tiny_scene, state):
    changed = walked(state, stride=0.7, lean=0.2)
    figure = figure_of(tiny_scene, changed.state.objects["a"])
    assert (figure.style.stride, figure.style.lean, figure.style.arms) == (0.7, 0.2, 1.0)
    assert not torch.equal(drawn(tiny_scene, changed.state), drawn(tiny_scene, state))
    back = apply_operations(changed.state, changed.inverse).state
    assert torch.equal(drawn(tiny_scene, back), drawn(tiny_scene, state))


def test_equal_gaits_share_a_figure(tiny_scene, state):
    one, other = (walked(state, arms=2.0).state.objects["a"] for _ in range(2))
    assert figure_of(tiny_scene, one) is figure_of(tiny_scene, other)


def test_a_snapshot_keeps_the_gait(tiny_scene, state):
    changed = walked(state, width=2.0).state
    again = unpack_state(state, pack_state(changed))
    assert again.objects["a"].gait == changed.objects["a"].gait


def test_only_people_who_walk_have_a_gait(state):
    with pytest.raises(EditError, match="does not walk"):
        apply_operations(state, [SetGait(object_id="car_red", stride=1.1)])


@pytest.mark.parametrize("gait", [{"stride": 3.0}, {"lean": 2.0}, {"phase": 2}])
def test_impossible_gaits_are_refused(gait):
    with pytest.raises(ValueError, match=next(iter(gait))):
        SetGait(object_id="a", **gait)
