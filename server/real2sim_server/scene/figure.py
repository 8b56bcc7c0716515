"""People among the objects of a scene: Gaussians that follow the joints of a body.

A person's cluster is stored in the rest pose of the body model. The trajectory determines the pose
at each time: footsteps are placed along the path by the distance covered
(:mod:`real2sim_server.body.gait`), so another path or speed gives other steps. Poses are tabulated
on demand, one segment at a time, and interpolated. A person without a trajectory walks straight
ahead, as given by a :class:`Stride`.

Linear blend skinning moves the means. The blended quaternion of the joints, the rotation nearest to
the blended transforms, rotates a Gaussian; its scales do not change.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from .._numba import kernel
from ..body import JOINTS, Body, body_model, joint_transforms, keypoints, skin
from ..body.gait import LEAD, STANDING, Gait, GaitStyle, plan_gait, stride_length
from ..body.model import joint_positions
from ..geometry import Float, matrix_to_quaternion, quaternion_to_matrix, quaternion_yaw
from .cloud import GaussianCloud
from .errors import SceneError
from .trajectory import Trajectory

# Kernel: skinning of Gaussians.


@kernel(nogil=True)
def pose_gaussians(  # noqa: PLR0917
    means: Any, quats: Any, joints: Any, weights: Any, turns: Any, shifts: Any
) -> Any:
    """Means [N, 3] and quaternions [N, 4] float32 of Gaussians on a posed body.

    Args:
        means, quats: [N, 3] and [N, 4] float32, of the rest pose.
        joints, weights: [N, 4], joints that move a Gaussian, and their weights.
        turns, shifts: [J, 4] ``wxyz`` and [J, 3]; a joint maps x to turn x + shift.
    """
    rows = np.empty((len(turns), 16))
    for j in range(len(turns)):
        w, x, y, z = turns[j, 0], turns[j, 1], turns[j, 2], turns[j, 3]
        rows[j, 0] = 1 - 2 * (y * y + z * z)
        rows[j, 1], rows[j, 2] = 2 * (x * y - w * z), 2 * (x * z + w * y)
        rows[j, 3], rows[j, 4] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
        rows[j, 5], rows[j, 6] = 2 * (y * z - w * x), 2 * (x * z - w * y)
        rows[j, 7], rows[j, 8] = 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        for axis in range(3):
            rows[j, 9 + axis] = shifts[j, axis]
        rows[j, 12], rows[j, 13], rows[j, 14], rows[j, 15] = w, x, y, z
    posed = np.empty((len(means), 3), np.float32)
    turned = np.empty((len(means), 4), np.float32)
    blend = np.empty(16)
    for i in range(len(means)):
        first, share = joints[i, 0], weights[i, 0]
        for c in range(16):
            blend[c] = share * rows[first, c]
        for k in range(1, 4):
            j, share = joints[i, k], weights[i, k]
            if share == 0:
                continue
            for c in range(12):
                blend[c] += share * rows[j, c]
            # q and -q are the same rotation: align signs with the first joint before blending.
            same = 0.0
            for c in range(12, 16):
                same += rows[j, c] * rows[first, c]
            if same < 0:
                share = -share
            for c in range(12, 16):
                blend[c] += share * rows[j, c]
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        for axis in range(3):
            at = 3 * axis
            posed[i, axis] = blend[at] * x + blend[at + 1] * y + blend[at + 2] * z + blend[9 + axis]
        a, b, c_, d = blend[12], blend[13], blend[14], blend[15]
        length = np.sqrt(a * a + b * b + c_ * c_ + d * d)
        a, b, c_, d = a / length, b / length, c_ / length, d / length
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        turned[i, 0] = a * w - b * x - c_ * y - d * z
        turned[i, 1] = a * x + b * w + c_ * z - d * y
        turned[i, 2] = a * y - b * z + c_ * w + d * x
        turned[i, 3] = a * z + b * y - c_ * x + d * w
    return posed, turned


ROW_US = 20_000
"""Spacing of tabulated poses [us]; joints move linearly in between."""
PIECE = 100
"""Number of poses tabulated at once."""
KEPT_PIECES, KEPT_CLOUDS = 16, 4
MAX_DURATION_US = 3_600_000_000
"""Maximum duration of trajectories with moving limbs [us]."""
PACE, FASTEST = 0.05, 8.0
"""Spacing and maximum of the tabulated paces [m/s]."""
STRIDE_ROWS = 48
"""Number of tabulated poses in a stride of two steps."""
KEPT_PACES, KEPT_STYLES = 64, 16
SETTLING = 0.3
"""Time in which the pace follows the speed [s]."""


class Stride(NamedTuple):
    """Walking state of a person without a trajectory.

    Attributes:
        steps: number of steps so far; each whole number is one swing of a foot.
        pace: speed that determines the step length [m/s].
    """

    steps: float
    pace: float


@dataclass(frozen=True, eq=False)
class Figure:
    """Binding of an object's Gaussians to a walking body.

    Attributes:
        shape: [<= 12] coefficients of the body model's shapes.
        height: height of the body [m].
        middle: height of the object's origin above the body's, which is on the ground [m].
        joints: [N, 4] uint8, joints that move a Gaussian.
        weights: [N, 4] float32 of these joints; each row sums to one.
        style: walking style.

    Raises:
        SceneError: arrays do not match each other or the body model, a shape or height is outside
            the model's range, or values are not finite.
    """

    shape: tuple[float, ...]
    height: float
    middle: float
    joints: Tensor
    weights: Tensor
    style: GaitStyle = field(default_factory=GaitStyle)
    _walks: WeakKeyDictionary[Trajectory, _Walk] = field(
        default_factory=WeakKeyDictionary, init=False, repr=False
    )
    _paces: OrderedDict[int, tuple[Float, Float]] = field(
        default_factory=OrderedDict, init=False, repr=False
    )
    _styled: OrderedDict[GaitStyle, Figure] = field(
        default_factory=OrderedDict, init=False, repr=False
    )
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def __post_init__(self) -> None:
        joints, weights = self.joints, self.weights
        if joints.ndim != 2 or joints.shape[1] != 4 or joints.shape != weights.shape:
            raise SceneError(
                "joints and weights of a figure must be [N, 4], not "
                f"{list(joints.shape)} and {list(weights.shape)}"
            )
        if joints.dtype != torch.uint8 or weights.dtype != torch.float32:
            raise SceneError(
                f"joints of a figure must be uint8 and weights float32, not {joints.dtype} and "
                f"{weights.dtype}"
            )
        values = (self.middle, *vars(self.style).values())
        if not np.isfinite(values).all():
            raise SceneError(f"middle and style of a figure must be finite, not {values}")
        object.__setattr__(self, "shape", tuple(float(v) for v in self.shape))
        try:
            body = body_model().shaped(np.array(self.shape), height=self.height)
        except ValueError as error:
            raise SceneError(f"figure: {error}") from error
        object.__setattr__(self, "_body", body)

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def body(self) -> Body:
        """The body in its rest pose."""
        body: Body = self.__dict__["_body"]
        return body

    def styled(self, **style: float) -> Figure:
        """The same person in another walking style; this object if the style is equal.

        Args:
            style: fields of :class:`..body.gait.GaitStyle`; other fields do not change.
        """
        wanted = replace(self.style, **style)
        with self._lock:
            found = self._styled.get(wanted)
            if found is None:
                found = self._styled[wanted] = replace(self, style=wanted)
                while len(self._styled) > KEPT_STYLES:
                    self._styled.popitem(last=False)
        return found

    @property
    def nbytes(self) -> int:
        """Memory of joints and weights [bytes]."""
        return self.joints.nbytes + self.weights.nbytes

    def check_values(self, what: str) -> None:
        """Check every value of a figure from an untrusted source.

        Args:
            what: name of the object for the message.

        Raises:
            SceneError: joints missing in the body, or weights that do not sum to one.
        """
        if len(self) and int(self.joints.max()) >= len(JOINTS):
            raise SceneError(f"{what}: a figure names joint {int(self.joints.max())} of 22")
        sums = self.weights.sum(dim=1)
        if not bool(((sums - 1).abs() < 1e-3).all()) or bool((self.weights < 0).any()):
            raise SceneError(f"{what}: weights of a figure must be positive and sum to one")

    def check_cloud(self, cloud: GaussianCloud, what: str) -> None:
        """Raise SceneError unless ``cloud`` has the same number of Gaussians, and colours without
        view dependence."""
        if len(cloud) != len(self):
            raise SceneError(f"{what}: a figure of {len(self)} rows for {len(cloud)} Gaussians")
        if cloud.sh_degree:
            raise SceneError(
                f"{what}: Gaussians of a figure have spherical harmonics of degree 0, "
                f"not {cloud.sh_degree}"
            )

    def posed(self, cloud: GaussianCloud, trajectory: Trajectory, t_us: int) -> GaussianCloud:
        """``cloud`` in its pose at ``t_us`` along ``trajectory``.

        Args:
            cloud: cloud in the rest pose, frame of the object.
            trajectory: trajectory of the object; its origin is ``middle`` above the ground.
            t_us: time [us]; outside the trajectory, the pose at its nearer end is used.

        Returns:
            The same object as before, if the query repeats the last one of this person.
        """
        with self._lock:
            return self._walk(trajectory).cloud(cloud, t_us)

    def striding(self, cloud: GaussianCloud, stride: Stride) -> GaussianCloud:
        """``cloud`` walking straight ahead, for callers that move the object themselves.

        Args:
            cloud: cloud in the rest pose, frame of the object.
            stride: walking state.
        """
        return self._binding.posed(cloud, *self._stride_joints(stride))

    def stride_at(self, trajectory: Trajectory, t_us: int) -> Stride:
        """Walking state at ``t_us`` along ``trajectory``, to continue from."""
        with self._lock:
            walk = self._walk(trajectory)
        seconds = float(np.clip(t_us - walk.start_us, 0, walk.span_us)) * 1e-6
        steps = float(np.interp(seconds, walk.gait.times, walk.gait.steps))
        return Stride(steps, float(np.interp(seconds, walk.gait.times, walk.gait.speeds)))

    def strode(self, stride: Stride, *, speed: float, seconds: float) -> Stride:
        """Walking state after ``seconds`` at ``speed`` [m/s]; feet on the ground do not slide."""
        settled = math.exp(-seconds / SETTLING)
        pace = speed + (stride.pace - speed) * settled
        return Stride(stride.steps + seconds * speed / self._step_length(pace), pace)

    def keypoints(
        self, trajectory: Trajectory, t_us: int, *, stride: Stride | None = None
    ) -> Float:
        """COCO's 17 keypoints [17, 3], frame of the object [m].

        Args:
            trajectory: trajectory of the object.
            t_us: instant on the trajectory [us].
            stride: walking state, in place of the trajectory.
        """
        if stride is not None:
            turns, places = self._stride_joints(stride)
        else:
            with self._lock:
                turns, places = self._walk(trajectory).joints(t_us)
        turned = quaternion_to_matrix(turns)
        shift = places - (turned @ self.body.joints[:, :, None])[..., 0]
        transforms = np.concatenate([turned, shift[..., None]], axis=-1)
        found = keypoints(self.body, skin(self.body, transforms), transforms)
        points: Float = found - np.array([0.0, 0.0, self.middle])
        return points

    def _walk(self, trajectory: Trajectory) -> _Walk:
        """The walk along a trajectory, cached for its lifetime. The caller must hold the lock."""
        walk = self._walks.get(trajectory)
        if walk is None:
            walk = self._walks[trajectory] = _Walk(self, trajectory)
        return walk

    @cached_property
    def _binding(self) -> _Binding:
        return _Binding(self.body, self.middle, self.joints.numpy(), self.weights.numpy())

    def _step_length(self, pace: float) -> float:
        leg = self.body.leg_length
        return 0.5 * self.style.stride * float(stride_length(max(pace, STANDING), leg))

    def _stride_joints(self, stride: Stride) -> tuple[Float, Float]:
        """Rotations [J, 4] against the rest pose and places [J, 3] of the joints, body frame."""
        level = round(min(max(stride.pace, 0.0), FASTEST) / PACE)
        with self._lock:
            found = self._paces.get(level)
            if found is None:
                found = self._paces[level] = self._tabulated(level * PACE)
                while len(self._paces) > KEPT_PACES:
                    self._paces.popitem(last=False)
        turns, places = found
        gone = stride.steps % 2.0 * (STRIDE_ROWS / 2)
        row = int(gone) % STRIDE_ROWS
        return _between((turns[row], places[row]), (turns[row + 1], places[row + 1]), gone - row)

    def _tabulated(self, pace: float) -> tuple[Float, Float]:
        """Joints of a stride straight ahead at constant pace; the last pose repeats the first."""
        rate = pace / self._step_length(pace)
        times = np.zeros(STRIDE_ROWS + 1)
        seconds = 1.0
        if pace > STANDING:
            # Whole strides from the start of the lead-in to the end of the lead-out.
            strides = math.ceil((2 * LEAD + 0.5) * rate / 2) + 4
            seconds = 2 * strides / rate - 2 * LEAD
            first = 2 * (strides // 2)
            times = np.linspace(first, first + 2, STRIDE_ROWS + 1) / rate - LEAD
        ends = np.array([0.0, seconds])
        path = np.column_stack([pace * ends, 0 * ends, 0 * ends])
        gait = plan_gait(self.body, ends, path, 0 * ends, self.style)
        return _joints_at(self.body, gait, times)


def _joints_at(body: Body, gait: Gait, times: ArrayLike) -> tuple[Float, Float]:
    """Rotations [T, J, 4] and positions [T, J, 3] of joints at ``times`` [T] [s]."""
    transforms = joint_transforms(body, gait.pose(times))
    return matrix_to_quaternion(transforms[..., :3]), joint_positions(body, transforms)


def _between(
    one: tuple[Float, Float], other: tuple[Float, Float], part: float
) -> tuple[Float, Float]:
    """Interpolate the joints between two poses."""
    (q0, p0), (q1, p1) = one, other
    sign = np.where((q0 * q1).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    turns = (1 - part) * q0 + part * sign * q1
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return turns, (1 - part) * p0 + part * p1


@dataclass(frozen=True, eq=False)
class _Binding:
    """Gaussians bound to the joints of a body."""

    body: Body
    middle: float
    joint_rows: NDArray[np.uint8]
    weights: NDArray[np.float32]

    def posed(self, cloud: GaussianCloud, turns: Float, places: Float) -> GaussianCloud:
        """``cloud`` with joints rotated [J, 4] from the rest pose, at positions [J, 3]."""
        # Rest and current positions in the frame of the object.
        down = np.array([0.0, 0.0, self.middle])
        rest = self.body.joints - down
        shifts = places - down - (quaternion_to_matrix(turns) @ rest[:, :, None])[..., 0]
        means, quats = pose_gaussians(
            cloud.means.cpu().numpy(),
            cloud.quats.cpu().numpy(),
            self.joint_rows,
            self.weights,
            turns,
            shifts,
        )
        device = cloud.device
        return replace(
            cloud,
            means=torch.from_numpy(means).to(device),
            quats=torch.from_numpy(quats).to(device),
        )


class _Walk:
    """A figure's walk along one trajectory: tabulated poses, and the last result."""

    def __init__(self, figure: Figure, trajectory: Trajectory) -> None:
        # No reference to the trajectory: the walk is cached for the trajectory's lifetime.
        self.binding = figure._binding
        self.start_us = trajectory.start_us
        self.span_us = trajectory.end_us - trajectory.start_us
        self.gait = _gait(figure, trajectory)
        self.pieces: OrderedDict[int, tuple[Float, Float]] = OrderedDict()
        self.shown: OrderedDict[tuple[int, int], tuple[GaussianCloud, GaussianCloud]] = (
            OrderedDict()
        )

    def cloud(self, cloud: GaussianCloud, t_us: int) -> GaussianCloud:
        """``cloud`` at ``t_us``; repeated queries return the cached one."""
        key = (id(cloud), t_us)
        found = self.shown.get(key)
        if found is None or found[0] is not cloud:
            found = self.shown[key] = (cloud, self.binding.posed(cloud, *self.joints(t_us)))
            while len(self.shown) > KEPT_CLOUDS:
                self.shown.popitem(last=False)
        return found[1]

    def joints(self, t_us: int) -> tuple[Float, Float]:
        """Rotations [J, 4] against the rest pose and places [J, 3] of the joints, body frame."""
        gone = float(np.clip(t_us - self.start_us, 0, self.span_us)) / ROW_US
        row = int(gone)
        return _between(self._row(row), self._row(row + 1), gone - row)

    def _row(self, row: int) -> tuple[Float, Float]:
        piece, at = divmod(row, PIECE)
        found = self.pieces.get(piece)
        if found is None:
            times = (piece * PIECE + np.arange(PIECE)) * (ROW_US * 1e-6)
            found = self.pieces[piece] = _joints_at(self.binding.body, self.gait, times)
            while len(self.pieces) > KEPT_PIECES:
                self.pieces.popitem(last=False)
        return found[0][at], found[1][at]


def _gait(figure: Figure, trajectory: Trajectory) -> Gait:
    times, count = (trajectory.times_us - trajectory.start_us) * 1e-6, len(trajectory.times_us)
    if trajectory.end_us - trajectory.start_us > MAX_DURATION_US:
        count = 1
    return plan_gait(
        figure.body,
        times[:count],
        trajectory.positions[:count] - [0.0, 0.0, figure.middle],
        quaternion_yaw(trajectory.quaternions[:count]),
        figure.style,
    )
