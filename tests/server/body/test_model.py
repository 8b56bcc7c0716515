"""The body model and its skinning."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

import real2sim_server.body
from real2sim_server.body import body_model, joint_transforms, keypoints, rest_pose, skin
from real2sim_server.body.model import (
    JOINTS,
    KEYPOINTS,
    Pose,
    joint_positions,
    skin_reference,
    vertex_normals,
)

MODEL = body_model()
MODEL_FILE = Path(real2sim_server.body.__file__).with_name("asset.npz")
BUILDS = sorted(MODEL.builds)


def _random_pose(body, seed: int, count: int = 3) -> Pose:
    rng = np.random.default_rng(seed)
    rotations = np.concatenate(
        [np.ones((count, len(JOINTS), 1)), 0.3 * rng.standard_normal((count, len(JOINTS), 3))], -1
    )
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    return Pose(rotations, body.joints[0] + rng.standard_normal((count, 3)))


def test_the_joints_are_named_parents_first():
    with np.load(MODEL_FILE) as data:
        assert tuple(data["joint_names"]) == JOINTS
    assert (MODEL.parents < np.arange(len(JOINTS))).all()


def test_weights_are_shares():
    np.testing.assert_allclose(MODEL.weights.sum(axis=1), 1.0)
    assert (MODEL.weights >= 0).all()


def test_every_build_is_the_same_left_and_right():
    mirrored_joint = [
        JOINTS.index(n[:-1] + {"l": "r", "r": "l"}[n[-1]] if n[-2] == "_" and n[-1] in "lr" else n)
        for n in JOINTS
    ]
    for build in BUILDS:
        body = MODEL.shaped(build)
        np.testing.assert_allclose(
            body.vertices[MODEL.mirror] * [1, -1, 1], body.vertices, atol=2e-4
        )
        np.testing.assert_allclose(body.joints[mirrored_joint] * [1, -1, 1], body.joints, atol=2e-4)


@pytest.mark.parametrize(
    ("build", "low", "high"),
    [("man", 1.68, 1.82), ("woman", 1.56, 1.70), ("girl", 1.2, 1.4), ("small_boy", 1.0, 1.2)],
)
def test_builds_are_as_tall_as_people(build, low, high):
    """Adults about the worldwide means of 1.71 and 1.59 m (NCD-RisC, eLife 2016)."""
    body = MODEL.shaped(build)
    assert low < body.height < high
    assert abs(body.vertices[:, 2].min()) < 0.02
    assert 0.42 < body.leg_length / body.height < 0.56


def test_a_height_scales_the_body_as_a_whole():
    body, tall = MODEL.shaped("man"), MODEL.shaped("man", height=1.9)
    assert tall.vertices[:, 2].max() == pytest.approx(1.9)
    np.testing.assert_allclose(tall.joints / body.joints[0, 2], body.joints / body.joints[0, 2]
                               * (1.9 / body.height))  # fmt: skip


def test_the_rest_pose_is_the_body():
    body = MODEL.shaped("woman")
    transforms = joint_transforms(body, rest_pose(body))
    np.testing.assert_allclose(skin(body, transforms), body.vertices, atol=1e-12)
    np.testing.assert_allclose(joint_positions(body, transforms), body.joints, atol=1e-12)


def test_bones_keep_their_lengths():
    body = MODEL.shaped("heavy_man")
    joints = joint_positions(body, joint_transforms(body, _random_pose(body, 1)))
    bones = [(j, p) for j, p in enumerate(MODEL.parents) if p >= 0]
    for joint, parent in bones:
        length = np.linalg.norm(joints[:, joint] - joints[:, parent], axis=-1)
        assert length == pytest.approx(np.linalg.norm(body.joints[joint] - body.joints[parent]))


def test_a_turned_pelvis_turns_the_whole_body():
    body = MODEL.shaped("man")
    pose = rest_pose(body)
    pose.rotations[0] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    moved = skin(body, joint_transforms(body, pose))
    about = body.joints[0]
    turned = (body.vertices - about) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]) + about
    np.testing.assert_allclose(moved, turned, atol=1e-12)


def test_the_kernel_does_what_its_plain_twin_does():
    body = MODEL.shaped("boy")
    transforms = joint_transforms(body, _random_pose(body, 2))
    np.testing.assert_allclose(skin(body, transforms), skin_reference(body, transforms), atol=1e-12)


def test_keypoints_are_where_coco_has_them():
    body = MODEL.shaped("woman")
    transforms = joint_transforms(body, rest_pose(body))
    points = dict(zip(KEYPOINTS, keypoints(body, skin(body, transforms), transforms), strict=True))
    assert points["nose"][0] > points["left_eye"][0] > points["left_ear"][0]
    assert points["left_eye"][1] == pytest.approx(-points["right_eye"][1], abs=0.003)
    for left in ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
        assert points[f"left_{left}"][1] > 0.02 > -0.02 > points[f"right_{left}"][1]
    heights = [points[f"left_{n}"][2] for n in ("ankle", "knee", "hip", "shoulder", "ear", "eye")]
    assert heights == sorted(heights)


def test_joints_lie_inside_the_body():
    for build in BUILDS:
        body = MODEL.shaped(build)
        low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
        assert (body.joints > low).all()
        assert (body.joints < high).all()


def test_triangles_look_outwards():
    body = MODEL.shaped("man")
    triangles = MODEL.triangles[MODEL.triangles_of(())]
    normals = vertex_normals(body.vertices, triangles)
    torso = MODEL.parts == MODEL.part_names.index("torso")
    spine = body.joint("spine_2")
    away = body.vertices[torso] - spine
    away[:, 2] = 0
    assert ((away * normals[torso]).sum(axis=1) > 0).mean() > 0.9


def test_what_cannot_be_shaped_is_refused():
    with pytest.raises(ValueError, match="unknown build 'giant'"):
        MODEL.shaped("giant")
    with pytest.raises(ValueError, match="height"):
        MODEL.shaped("man", height=3.0)
    with pytest.raises(ValueError, match="coefficients"):
        MODEL.shaped([np.nan])
    with pytest.raises(ValueError, match="unknown groups"):
        MODEL.triangles_of(["wings"])


def test_skinning_gives_the_same_bits_again():
    body = MODEL.shaped("man")
    transforms = joint_transforms(body, _random_pose(body, 4))
    digests = {hashlib.sha256(skin(body, transforms).tobytes()).hexdigest() for _ in range(2)}
    assert len(digests) == 1
