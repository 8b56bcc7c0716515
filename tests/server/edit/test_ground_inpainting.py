"""Ground under removed parked objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.operations import Delete, Rotate, Translate
from real2sim_server.edit import ScenarioState, apply_operations, vacated_parking
from real2sim_server.edit.appearance import inpaint_ground
from real2sim_server.scene import UNSEEN, GaussianCloud
from real2sim_server.scene.cloud import SH_C0

PARKED = "post"


def poses_of(state: ScenarioState, t_us: int) -> dict[str, np.ndarray]:
    placed = state.tracks.at(t_us)
    return {o.object_id: T for o, T in zip(placed.objects, placed.transforms, strict=True)}


def at(scene, state: ScenarioState, *operations) -> tuple[str, ...]:
    after = apply_operations(state, operations).state
    return vacated_parking(after, poses_of(after, scene.start_us))


@pytest.fixture
def state(tiny_scene) -> ScenarioState:
    return ScenarioState.of(tiny_scene)


@pytest.mark.parametrize(
    "operation",
    [
        Delete(object_id=PARKED),
        Translate(object_id=PARKED, y=2.0),
        Rotate(object_id=PARKED, angle=0.5),
    ],
)
def test_removing_a_parked_object_uncovers_its_place(tiny_scene, state, operation):
    assert at(tiny_scene, state, operation) == (PARKED,)


def test_small_moves_and_moves_of_driving_objects_uncover_nothing(tiny_scene, state):
    driving = next(o.object_id for o in state.visible if not o.standing)
    nudged = Translate(object_id=PARKED, y=0.1)
    assert at(tiny_scene, state, nudged, Delete(object_id=driving)) == ()
    assert vacated_parking(state, poses_of(state, tiny_scene.start_us)) == ()


def test_an_impact_that_pushes_a_parked_object_away_uncovers_its_place(tiny_scene, state):
    poses = poses_of(state, tiny_scene.start_us)
    pushed = poses[PARKED].copy()
    pushed[0, 3] += 1.0
    assert vacated_parking(state, poses | {PARKED: pushed}) == (PARKED,)


def test_objects_not_recorded_at_a_time_uncover_nothing(state):
    assert vacated_parking(state, {}) == ()


def test_uncovered_ground_takes_the_surrounding_colour(tiny_scene):
    parked = tiny_scene.object(PARKED)
    centre = parked.trajectory.transform(tiny_scene.start_us)[:3, 3]
    half = torch.tensor(parked.size) / 2
    cells = torch.linspace(-3, 3, 41)
    plane = torch.cartesian_prod(cells, cells)
    inside = (plane.abs() <= half[:2]).all(dim=1)
    ground = torch.cat([plane, -half[2] * torch.ones(len(plane), 1)], dim=1)
    above = torch.tensor([[0.0, 0.0, 0.0]])
    means = torch.cat([ground, above]) + torch.from_numpy(centre).float()
    colours = torch.full((len(means), 3), 0.4)
    colours[:-1][inside] = torch.tensor([0.1, 0.1, 0.9])
    smeared = GaussianCloud(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
        scales=torch.full((len(means), 3), 0.05),
        opacities=torch.ones(len(means)),
        sh=((colours - 0.5) / SH_C0)[:, None],
    )
    clean = inpaint_ground(tiny_scene, smeared, (PARKED,))
    seen = clean.sh[:-1, 0] * SH_C0 + 0.5
    assert torch.allclose(seen, torch.full_like(seen, 0.4), atol=1e-5)
    assert float(clean.opacities[-1]) == 0.0
    assert torch.equal(clean.opacities[:-1], smeared.opacities[:-1])


def test_inpainted_ground_counts_as_never_seen(tiny_scene):
    known = replace(
        tiny_scene.background, uncertainties=torch.full((len(tiny_scene.background),), 0.02)
    )
    pose = tiny_scene.object(PARKED).trajectory.transform(tiny_scene.start_us)
    beneath = torch.tensor(pose[:3, 3] - [0, 0, tiny_scene.object(PARKED).size[2] / 2]).float()
    known = replace(known, means=known.means.clone())
    known.means[5] = beneath
    clean = inpaint_ground(tiny_scene, known, (PARKED,))
    assert float(clean.uncertainties[5]) == UNSEEN
    assert float(clean.uncertainties.min()) == pytest.approx(0.02)


@pytest.mark.parametrize("behind", [0.25, 2.0])
def test_a_line_beside_the_kerb_goes_on_below_and_behind_a_removed_object(tiny_scene, behind):
    parked = tiny_scene.object(PARKED)
    centre = parked.trajectory.transform(tiny_scene.start_us)[:3, 3]
    half = np.array(parked.size) / 2
    across = np.linspace(-4, 4, 135)
    plane = np.stack(np.meshgrid(across, across, indexing="ij"), axis=-1).reshape(-1, 2)
    # A pavement beyond y = 0, and a white line at the middle of its edge.
    stripes = np.where(np.abs(plane[:, 1]) < 0.09, 0.8, np.where(plane[:, 1] > 0, 0.6, 0.4))
    hidden = (plane >= -half[:2] - 0.25).all(axis=1)
    hidden &= (plane <= half[:2] + np.array([0.25, behind])).all(axis=1)
    shown = np.where(hidden, 0.05, stripes)
    # Some below the object are too deep: they would show through the ground.
    deep = np.where((np.abs(plane) < half[:2]).all(axis=1) & (plane[:, 0] > 0), 0.3, 0)
    means = np.column_stack([plane, -half[2] - deep]) + centre
    count = len(means)
    ground = GaussianCloud(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.full((count, 3), 0.05),
        opacities=torch.ones(count),
        sh=torch.from_numpy((shown - 0.5) / SH_C0).float()[:, None, None].repeat(1, 1, 3),
        uncertainties=torch.from_numpy(np.where(hidden, UNSEEN, 0.02)).float(),
    )

    clean = inpaint_ground(tiny_scene, ground, (PARKED,))

    found = (clean.sh[:, 0, 0] * SH_C0 + 0.5).numpy()
    assert np.abs(found - stripes)[hidden].mean() < 0.03
