"""Walking: feet that stand still, legs that reach them, steps that fit the speed."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.body import body_model, joint_transforms
from real2sim_server.body.gait import Foot, Gait, GaitStyle, plan_gait, stride_length
from real2sim_server.body.model import JOINTS, UP, about, joint_positions

MODEL = body_model()
T = np.arange(0.0, 6.0, 0.1)
STEP = 0.005
TIMES = np.arange(0.5, 5.5, STEP)


def _straight(speed):
    return speed * T, 0 * T, 0 * T


def _circle(speed, radius):
    turn = speed * T / radius
    return radius * np.sin(turn), radius - radius * np.cos(turn), turn


def _stop_and_go():
    return np.where(T < 2, 1.3 * T, np.where(T < 4, 2.6, 2.6 + 1.3 * (T - 4))), 0 * T, 0 * T


def _corner():
    turn = np.clip(T - 2, 0, 1) * np.pi / 2
    return np.where(T < 2, 1.2 * T, 2.4), np.where(T > 3, 1.2 * (T - 3), 0.0), turn


PATHS = {
    **{f"straight at {v} m/s": _straight(v) for v in (0.3, 0.8, 1.4, 1.9, 2.3, 3.0, 4.0)},
    "wide bend": _circle(1.4, 2.0),
    "tight bend": _circle(1.0, 0.7),
    "running in a bend": _circle(2.5, 4.0),
    "on the spot": (0 * T, 0 * T, 1.2 * T),
    "stop and go": _stop_and_go(),
    "corner": _corner(),
}


def _gait(build: str, path, style: GaitStyle | None = None) -> Gait:
    x, y, yaw = path
    return plan_gait(MODEL.shaped(build), T, np.stack([x, y, 0 * x], axis=1), yaw, style)


def _sole(gait: Gait, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heel and ball in the world [T, 3] at ``TIMES``, and when the foot is on the ground."""
    body, name = gait.body, "lr"[side]
    transforms = joint_transforms(body, gait.pose(TIMES))
    place, steps = gait.at(TIMES)
    foot = transforms[:, JOINTS.index(f"foot_{name}")]
    local = foot[:, :, :3] @ Foot(body, name).heel + foot[:, :, 3]
    ball = joint_positions(body, transforms)[:, JOINTS.index(f"ball_{name}")]
    turned = about(UP, place[:, 3])
    heel, ball = ((turned @ p[..., None])[..., 0] + place[:, :3] for p in (local, ball))
    walk = gait.feet[side]
    in_air = ((steps[:, None] > walk.lift) & (steps[:, None] < walk.land)).any(axis=1)
    return heel, ball, ~in_air


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("build", ["man", "small_girl"])
def test_feet_on_the_ground_do_not_slide(build, path):
    gait = _gait(build, PATHS[path])
    stood = 0
    for side in range(2):
        heel, ball, stands = _sole(gait, side)
        speeds = [np.linalg.norm(np.diff(p, axis=0), axis=1) / STEP for p in (heel, ball)]
        both = stands[1:] & stands[:-1]
        assert np.minimum(*speeds)[both].max() < 0.05
        stood += both.sum()
    assert stood > 0.3 * len(TIMES)


@pytest.mark.parametrize("path", PATHS)
def test_feet_do_not_go_below_the_ground(path):
    gait = _gait("woman", PATHS[path])
    for side in range(2):
        heel, ball, _ = _sole(gait, side)
        assert heel[:, 2].min() > -0.002
        assert ball[:, 2].min() > gait.body.joint("ball_l")[2] - 0.002


@pytest.mark.parametrize("speed", [0.8, 1.4, 2.0, 3.0])
def test_strides_are_as_long_as_the_speed_asks(speed):
    gait = _gait("man", _straight(speed))
    spots = gait.feet[0].spots
    inner = np.diff(spots[:, 0])[2:-2]
    wanted = stride_length(speed, gait.body.leg_length)
    np.testing.assert_allclose(inner, wanted, rtol=0.08)


def test_men_walk_about_two_steps_a_second():
    """1.4 m/s goes with a cadence of 105 to 120 steps a minute (Perry and Burnfield, 2010)."""
    gait = _gait("man", _straight(1.4))
    _, steps = gait.at([1.0, 5.0])
    assert 105 < (steps[1] - steps[0]) / 4 * 60 < 120


def test_walkers_have_a_foot_on_the_ground_and_runners_fly():
    for speed, flies in ((1.4, False), (3.5, True)):
        gait = _gait("man", _straight(speed))
        on_ground = [_sole(gait, side)[2] for side in range(2)]
        assert (~on_ground[0] & ~on_ground[1]).any() == flies


def test_knees_bend_backwards_only_and_elbows_forwards():
    gait = _gait("woman", _straight(1.4))
    joints = joint_positions(gait.body, joint_transforms(gait.body, gait.pose(TIMES)))
    for side in "lr":
        hip, knee, ankle = (
            joints[:, JOINTS.index(f"{n}_{side}")] for n in ("thigh", "calf", "foot")
        )
        assert (np.cross(knee - hip, ankle - knee)[:, 1] > 0).all()
        shoulder, elbow, hand = (
            joints[:, JOINTS.index(f"{n}_{side}")] for n in ("upper_arm", "forearm", "hand")
        )
        assert (np.cross(elbow - shoulder, hand - elbow)[:, 1] < 0.01).all()


def test_arms_swing_against_the_legs():
    gait = _gait("man", _straight(1.4))
    joints = joint_positions(gait.body, joint_transforms(gait.body, gait.pose(TIMES)))
    hand, foot = joints[:, JOINTS.index("hand_l"), 0], joints[:, JOINTS.index("foot_l"), 0]
    assert np.corrcoef(hand, foot)[0, 1] < -0.7


def test_the_pelvis_bobs_some_centimetres():
    """Four to five at normal speed (Perry and Burnfield, 2010)."""
    pelvis = _gait("man", _straight(1.4)).pose(TIMES).pelvis
    assert 0.02 < np.ptp(pelvis[:, 2]) < 0.06


def test_who_stands_has_both_feet_side_by_side():
    gait = _gait("man", (0 * T, 0 * T, 0 * T))
    joints = joint_positions(gait.body, joint_transforms(gait.body, gait.pose(TIMES)))
    left, right = (joints[:, JOINTS.index(f"foot_{s}")] for s in "lr")
    np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-6)
    assert np.ptp(left, axis=0).max() < 1e-9


def test_half_a_cycle_later_the_other_side_does_the_same():
    """With the other foot first, everything is mirrored."""
    one = _gait("man", _straight(1.4))
    other = _gait("man", _straight(1.4), GaitStyle(phase=1.0))
    first, second = (
        joint_positions(g.body, joint_transforms(g.body, g.pose([3.0])))[0] for g in (one, other)
    )
    left, right = ([i for i, n in enumerate(JOINTS) if n.endswith(s)] for s in ("_l", "_r"))
    np.testing.assert_allclose(first[left] * [1, -1, 1], second[right], atol=2e-3)


def test_a_gait_is_the_same_asked_at_once_or_one_by_one():
    gait = _gait("boy", PATHS["corner"])
    together = gait.pose(TIMES[::100]).rotations
    alone = np.concatenate([gait.pose([t]).rotations for t in TIMES[::100]])
    np.testing.assert_array_equal(together, alone)


def test_paths_that_are_none_are_refused():
    with pytest.raises(ValueError, match="rise"):
        plan_gait(MODEL.shaped("man"), [0, 0], np.zeros((2, 3)), [0, 0])
    with pytest.raises(ValueError, match="positions"):
        plan_gait(MODEL.shaped("man"), [0, 1], np.zeros((3, 3)), [0, 0])
