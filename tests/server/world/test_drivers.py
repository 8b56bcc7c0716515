"""The contract of drivers of other road users, for all built-in drivers and a custom one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Self, get_args

import numpy as np
import pytest

from real2sim_proto.base import Model
from real2sim_proto.episode import AgentDriver as AgentDriverUnion
from real2sim_proto.episode import AgentsSpec, ResetSpec
from real2sim_server.edit import ObjectState
from real2sim_server.scene import Lane, LaneGraph
from real2sim_server.world.driving import GRAVITY
from real2sim_server.world.traffic import DRIVERS, AgentDriver, AgentPose, Surroundings
from real2sim_server.world.traffic.driver import recorded_pose


class CoastDriver(Model):
    """Coasts from the recorded speed."""

    kind: Literal["coast"] = "coast"
    resistance: float = 0.015


@dataclass(frozen=True, eq=False)
class Coast:
    """Drives straight and decelerates by rolling resistance to a stop."""

    subject: ObjectState
    spec: CoastDriver
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(cls, subject: ObjectState, spec: CoastDriver, surroundings: Surroundings) -> Coast:
        return cls(subject, spec, recorded_pose(subject, surroundings.t_us))

    def advance(self, surroundings: Surroundings) -> Self:
        (x, y, z), (vx, vy, _) = self.pose.position, self.pose.velocity
        speed, dt = math.hypot(vx, vy), surroundings.dt
        kept = max(speed - self.spec.resistance * GRAVITY * dt, 0.0) / max(speed, 1e-9)
        velocity = (vx * kept, vy * kept, 0.0)
        position = (x + velocity[0] * dt, y + velocity[1] * dt, z)
        return replace(self, pose=self.pose._replace(position=position, velocity=velocity))


SPECS = {spec.model_fields["kind"].default: spec for spec in (*DRIVERS, CoastDriver)}


@pytest.fixture(params=SPECS)
def world(request, monkeypatch, make_world, moving):
    """A world in which the parametrized driver controls one car."""
    monkeypatch.setitem(DRIVERS, CoastDriver, Coast.begin)
    agents = AgentsSpec.model_construct(drivers={"car": SPECS[request.param]()})
    spec = ResetSpec().model_copy(update={"agents": agents})
    made = make_world(car=moving(40, 0, z=0.8, speed=8.0))
    line = np.array([[-50.0, 0.3, 0.0], [300.0, 0.3, 0.0]])
    lanes = LaneGraph.of([Lane("own", "driving", line, np.full(2, 3.5))])
    return type(made)(replace(made.scene, lanes=lanes), made.state, spec)


def driver_of(world) -> AgentDriver:
    return world.traffic.drivers["car"]


def test_a_driver_starts_with_its_object(world):
    driver = driver_of(world)

    assert driver.subject.object_id == "car"
    assert driver.present
    assert np.allclose(world.agents.positions[0], driver.pose.position)


def test_poses_are_finite_with_unit_quaternions(world):
    for _ in range(5):
        world.step()
        pose = driver_of(world).pose
        numbers = (*pose.position, *pose.quaternion, pose.yaw, *pose.velocity)
        assert all(math.isfinite(v) for v in numbers)
        assert math.hypot(*pose.quaternion) == pytest.approx(1.0)


def test_a_step_returns_a_new_driver(world):
    before = driver_of(world)
    pose = before.pose
    world.step()

    assert driver_of(world) is not before
    assert before.pose == pose


def test_equal_surroundings_give_equal_poses(world):
    fork = world.fork()
    for _ in range(5):
        world.step()
        fork.step()

    assert driver_of(world).pose == driver_of(fork).pose


def test_displacement_is_limited_by_velocity(world):
    for _ in range(5):
        before = driver_of(world).pose
        world.step()
        after = driver_of(world).pose
        covered = math.dist(before.position[:2], after.position[:2])
        fastest = max(math.hypot(*before.velocity[:2]), math.hypot(*after.velocity[:2]))
        assert covered <= (fastest + 0.5) * 0.1 + 1e-6


def test_protocol_drivers_match_the_registry():
    union, _ = get_args(AgentDriverUnion)

    assert set(get_args(union)) == set(DRIVERS)
