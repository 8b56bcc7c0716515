from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.base import Pose
from real2sim_proto.operations import SetPose, Translate
from real2sim_proto.plans import Control, PoseCommand
from real2sim_server.world.boxes import REAR_OVERHANG, ego_box

GO_ON = {"action": "control", "on_collision": "continue"}
COAST = Control(acceleration=0.0, steering=0.0)


def collisions(world, steps: int) -> list[tuple[int, str, float]]:
    found = []
    for _ in range(steps):
        events = world.step(COAST)
        found += [
            (world.steps, e.object_id, e.data["relative_speed"])
            for e in events
            if e.type == "collision"
        ]
    return found


def test_the_ego_box_rests_on_the_ground_around_the_rear_axle():
    T = np.eye(4)
    T[:3, 3] = [10, 0, 1]
    box = ego_box(T, (4.6, 1.85, 1.6))

    assert box[0, 3] - 2.3 == pytest.approx(10 - REAR_OVERHANG)
    assert box[2, 3] - 0.8 == pytest.approx(1)


def test_contact_is_reported_when_the_bumper_reaches_the_car(make_world, moving):
    # The front bumper is 3.65 m ahead of the rear axle. The car's rear end is at x = 18.
    world = make_world(car=moving(20, 0, z=0.8), spec=GO_ON)

    assert collisions(world, 20) == [(15, "car", pytest.approx(10.0))]
    assert world.metrics()["collisions"] == 1
    assert not world.over


def test_relative_speed_includes_both_motions(make_world, moving):
    world = make_world(car=moving(40, 0, z=0.8, speed=5.0, yaw=np.pi), spec=GO_ON)
    (_, object_id, relative_speed), *_ = collisions(world, 40)

    assert (object_id, relative_speed) == ("car", pytest.approx(15.0))


def test_contact_ends_the_episode_by_default(make_world, moving):
    world = make_world(car=moving(20, 0, z=0.8), spec={"action": "control"})
    while not world.over:
        world.step(COAST)

    assert world.steps == 15
    assert (world.terminated, world.truncated, world.reason) == (True, False, "collision")


def test_a_close_pass_is_not_a_contact(make_world, moving):
    # Half widths: 0.925 m of the ego, 1 m of the car.
    world = make_world(car=moving(20, 1.93, z=0.8), spec=GO_ON)

    assert collisions(world, 60) == []


def test_driving_under_a_bridge_is_not_a_contact(make_world, moving):
    world = make_world(bridge=moving(20, 0, z=6.0), spec=GO_ON)

    assert collisions(world, 60) == []


def test_an_initial_overlap_is_ignored_until_the_objects_separate(make_world, moving):
    beginning = make_world(car=moving(3, 1.5, z=0.8, speed=10.0), spec=GO_ON)
    assert collisions(beginning, 20) == []

    there_and_back = make_world(
        car=moving(3, 1.5, z=0.8), spec={"action": "pose", "on_collision": "continue"}
    )
    places = [0.0, 30.0, 0.0]
    events = [there_and_back.step(PoseCommand(x=x, y=0, yaw=0)) for x in places]
    assert [[e.type for e in step] for step in events] == [[], [], ["collision"]]


def test_a_second_contact_with_the_same_object_is_reported_again(make_world, moving):
    world = make_world(
        car=moving(30, 0, z=0.8), spec={"action": "pose", "on_collision": "continue"}
    )
    for x in [28.0, 28.0, 10.0, 28.0]:
        world.step(PoseCommand(x=x, y=0, yaw=0))

    assert world.metrics()["collisions"] == 2


def test_hitting_two_objects_at_once_reports_two_contacts(make_world, moving):
    world = make_world(
        a=moving(20, 1.2, z=0.8), b=moving(20, -1.2, z=0.8), c=moving(20, 9), spec=GO_ON
    )

    assert [(step, i) for step, i, _ in collisions(world, 15)] == [(15, "a"), (15, "b")]


def test_an_object_moved_into_the_ego_collides_at_the_next_step(make_world, moving):
    world = make_world(car=moving(50, 20, z=0.8), spec=GO_ON)
    world.apply([SetPose(object_id="car", pose=Pose(position=(2.0, 0.0, 0.8)))])

    assert [e.type for e in world.step(COAST)] == ["edited", "collision"]


def test_an_object_moved_off_the_route_is_not_hit(make_world, moving):
    world = make_world(car=moving(20, 0, z=0.8), spec=GO_ON)
    world.apply([Translate(object_id="car", y=4)])

    assert collisions(world, 60) == []
