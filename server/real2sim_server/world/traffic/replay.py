"""Objects that repeat what was recorded, and objects that go straight on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from real2sim_proto.episode import ConstantVelocityDriver, ReplayDriver

from ...edit import ObjectState
from ...geometry.rotation import quaternion_yaw
from .driver import AgentPose, Surroundings


@dataclass(frozen=True, eq=False)
class Replay:
    """Moves along its trajectory in time and is in the world while that lasts; observes nothing."""

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(cls, subject: ObjectState, _spec: ReplayDriver, surroundings: Surroundings) -> Replay:
        """From where the trajectory is now, which it must cover."""
        return cls(subject, recorded_pose(subject, surroundings.t_us))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        t_us, trajectory = surroundings.t_us + surroundings.dt_us, self.subject.trajectory
        if not trajectory.start_us <= t_us <= trajectory.end_us:
            return replace(self, present=False)
        return replace(self, pose=recorded_pose(self.subject, t_us), present=True)


@dataclass(frozen=True, eq=False)
class ConstantVelocity:
    """Goes on as it moved when it began, at its height and with its heading; observes nothing."""

    subject: ObjectState
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, _spec: ConstantVelocityDriver, surroundings: Surroundings
    ) -> ConstantVelocity:
        """From how the object moves now."""
        pose = recorded_pose(subject, surroundings.t_us)
        vx, vy, _ = pose.velocity
        return cls(subject, pose._replace(velocity=(vx, vy, 0.0)))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        (x, y, z), (vx, vy, _) = self.pose.position, self.pose.velocity
        moved = (x + vx * surroundings.dt, y + vy * surroundings.dt, z)
        return replace(self, pose=self.pose._replace(position=moved))


def recorded_pose(subject: ObjectState, t_us: int) -> AgentPose:
    """Where the object's trajectory is at ``t_us``, with its velocity there.

    Raises:
        TimeOutOfRangeError: outside the trajectory.
    """
    position, quaternion = subject.trajectory.pose(t_us)
    x, y, z = position.tolist()
    w, qx, qy, qz = quaternion.tolist()
    vx, vy, vz = subject.trajectory.velocity(t_us).tolist()
    yaw = float(quaternion_yaw(quaternion))
    return AgentPose((x, y, z), (w, qx, qy, qz), yaw, (vx, vy, vz))
