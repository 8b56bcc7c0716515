"""cast() in plain torch, as a reference for tests: every ray and every Gaussian, in float64.

:func:`follow` is differentiable with torch.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry import Float, invert_transform
from ..backend import ALPHA_MAX, ALPHA_MIN
from ..types import Instance
from .types import ECHO_MIN, HALF_LIGHT, TRANSMITTANCE_MIN, CastRequest, Echo, Return

RAYS = 256
"""Number of rays traced at once."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples along rays, from near to far.

    Attributes:
        tau: [R, N] range [m].
        weight: [R, N] fraction of the ray's light absorbed there; 0 without a hit.
        before: [R, N] transmittance before the sample.
        order: [R, N] int64, index of the Gaussian of each sample.
    """

    tau: Tensor
    weight: Tensor
    before: Tensor
    order: Tensor


class ReferenceCaster:
    """Plain torch on the CPU."""

    name = "reference"

    def cast(self, request: CastRequest) -> Echo:
        """Trace all rays, instant by instant."""
        start = time.perf_counter()
        lidar = request.lidar
        directions = lidar.beams.directions.reshape(-1, 3)
        slots = lidar.beams.slots[1].ravel()
        results = _Results(request)
        for slot in np.unique(slots):
            means, factors, opacities = _placed(request, int(slot))
            members = np.flatnonzero(slots == slot)
            for first in range(0, len(members), RAYS):
                rays = members[first : first + RAYS]
                samples = follow(
                    torch.from_numpy(directions[rays]),
                    means,
                    factors,
                    opacities,
                    limits=(lidar.min_range, lidar.max_range),
                    divergence=lidar.divergence,
                )
                results.take(rays, samples)
        return results.echo((time.perf_counter() - start) * 1e3)


def follow(
    directions: Tensor,
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    *,
    limits: tuple[float, float],
    divergence: tuple[float, float],
) -> Samples:
    """Samples along rays from the origin.

    Args:
        directions: [R, 3] unit vectors.
        means: [N, 3] sensor frame [m].
        factors: [N, 3, 3]; the product with the transpose is the covariance.
        opacities: [N].
        limits: nearest and farthest sample [m].
        divergence: see Lidar [rad].
    """
    covariance = factors @ factors.mT + _footprint(means, divergence)
    inverse = torch.linalg.inv(covariance)
    along = torch.einsum("nij,rj->rni", inverse, directions)
    square = (along * directions[:, None]).sum(-1)
    tau = (along * means).sum(-1) / square
    off = tau[..., None] * directions[:, None] - means
    distance = (off * torch.einsum("nij,rnj->rni", inverse, off)).sum(-1)
    alpha = (opacities * torch.exp(-distance / 2)).clamp(max=ALPHA_MAX)
    met = (alpha >= ALPHA_MIN) & (tau >= limits[0]) & (tau <= limits[1])
    alpha = torch.where(met, alpha, 0.0)
    order = torch.argsort(means.norm(dim=-1), stable=True).expand(len(directions), -1)
    alpha, tau = alpha.gather(1, order), tau.gather(1, order)
    passed = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
    weight = torch.where(before > TRANSMITTANCE_MIN, alpha * before, 0.0)
    return Samples(tau, weight, before, order)


def _footprint(means: Tensor, divergence: tuple[float, float]) -> Tensor:
    """Covariance [N, 3, 3] of the beam at each Gaussian."""
    x, y, z = means.unbind(-1)
    flat, distance = torch.hypot(x, y).clamp(min=1e-6), means.norm(dim=-1)
    across = torch.stack([-y / flat, x / flat, torch.zeros_like(x)], -1)
    rise = z / distance
    upward = torch.stack([-rise * x / flat, -rise * y / flat, flat / distance], -1)
    total = torch.zeros(len(means), 3, 3, dtype=means.dtype)
    for axis, angle in ((across, divergence[0]), (upward, divergence[1])):
        spread = axis * (distance * np.tan(angle / 2) / 2)[:, None]
        total = total + spread[:, :, None] * spread[:, None, :]
    return total


def _placed(request: CastRequest, slot: int) -> tuple[Tensor, Tensor, Tensor]:
    """Centres, factors and opacities of all Gaussians in the sensor frame at an instant."""
    T_lidar_world = invert_transform(request.T_world_lidar[slot])
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for instance, poses in zip(request.instances, request.object_poses, strict=True):
        placed = instance.T_world_object if poses is None else poses[slot]
        T_world_object = np.eye(4) if placed is None else np.asarray(placed, dtype=np.float64)
        parts.append(_in_sensor(instance, T_lidar_world @ T_world_object))
    if not parts:
        empty = torch.zeros(0, 3, dtype=torch.float64)
        return empty, torch.zeros(0, 3, 3, dtype=torch.float64), empty[:, 0]
    means, factors, opacities = (torch.cat(column) for column in zip(*parts, strict=True))
    return means, factors, opacities


def _in_sensor(instance: Instance, transform: Float) -> tuple[Tensor, Tensor, Tensor]:
    cloud = instance.cloud
    linear = torch.from_numpy(transform[:3, :3] * np.asarray(instance.scale))
    means = cloud.means.double() @ linear.mT + torch.from_numpy(transform[:3, 3].copy())
    if instance.covars is not None:
        factors = torch.linalg.cholesky(instance.covars.double())
    else:
        factors = _rotations(cloud.quats.double()) * cloud.scales.double()[:, None, :]
    return means, linear @ factors, cloud.opacities.double()


def _rotations(quats: Tensor) -> Tensor:
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


class _Results:
    """Results of rays, filled incrementally."""

    def __init__(self, request: CastRequest) -> None:
        self.request = request
        count = request.lidar.beams.count
        self.values = np.zeros((5, count))
        self.member = np.full(count, -1, np.int64)
        self.returns = np.zeros((3, 3, count))
        self.attributes = _attribute_table(request)

    def take(self, rays: NDArray[np.int64], samples: Samples) -> None:
        """Add the results of ``rays``."""
        weight, tau, order = samples.weight, samples.tau, samples.order
        stopped = weight.sum(1)
        share = torch.where(stopped > 0, 1 / stopped, 0.0)
        own = self.attributes[order]
        falls = (samples.before > HALF_LIGHT) & (samples.before - weight <= HALF_LIGHT)
        met = falls.any(1)
        place = falls.double().argmax(1, keepdim=True) if falls.shape[1] else None
        if place is not None:
            self.values[0, rays] = torch.where(met, tau.gather(1, place)[:, 0], 0.0)
            owner = torch.where(met, order.gather(1, place)[:, 0], -1)
            self.member[rays] = owner
        self.values[1, rays] = (weight * tau).sum(1) * share
        self.values[2, rays] = stopped
        for k in range(2):
            self.values[3 + k, rays] = (weight * own[..., k]).sum(1) * share
        if self.request.lidar.returns > 1:
            for row, ray in enumerate(rays):
                self._take_returns(int(ray), row, samples, own)

    def _take_returns(self, ray: int, row: int, samples: Samples, own: Tensor) -> None:
        kept = torch.nonzero(samples.weight[row] > 0)[:, 0]
        power = (samples.weight[row] * samples.before[row])[kept].tolist()
        taus, shown = samples.tau[row][kept].tolist(), own[row, kept, 0].tolist()
        echoes = list(_echoes(zip(taus, power, shown, strict=True), self.request.lidar.pulse))
        if echoes:
            strongest = max(echoes, key=lambda echo: echo[1])
            for k, echo in enumerate((echoes[0], strongest, echoes[-1])):
                self.returns[k, :, ray] = echo

    def echo(self, milliseconds: float) -> Echo:
        """The Echo of all rays."""
        request, shape = self.request, self.request.lidar.shape
        counts = [len(instance.cloud) for instance in request.instances]
        ids = np.repeat([i.instance_id for i in request.instances], counts)
        met = self.member >= 0
        instance = np.zeros(len(met), np.uint16)
        instance[met] = ids[self.member[met]]
        values = self.values.astype(np.float32).reshape(5, *shape)
        several = self.returns.astype(np.float32).reshape(3, 3, *shape)
        names = {1: (), 2: ("first", "last"), 3: ("first", "strongest", "last")}
        all_names = names[3]
        median, expected, opacity, intensity, drop = values
        return Echo(
            range=median,
            expected=expected,
            opacity=opacity,
            intensity=intensity,
            drop=drop,
            instance=instance.reshape(shape),
            member=self.member.astype(np.int32).reshape(shape),
            returns={n: Return(*several[all_names.index(n)]) for n in names[request.lidar.returns]},
            timing_ms={"total": milliseconds},
        )


def _echoes(
    samples: Iterable[tuple[float, float, float]], pulse: float
) -> Iterable[tuple[float, float, float]]:
    """Range, power and reflectivity of each echo.

    An echo is a sufficiently strong run of samples, each within a pulse length of the previous one.
    """
    last = total = ranges = shown = 0.0
    for tau, power, reflectivity in (*samples, (np.inf, 0.0, 0.0)):
        if total > 0 and abs(tau - last) > pulse:
            if total >= ECHO_MIN:
                yield ranges / total, total, shown / total
            total = ranges = shown = 0.0
        if np.isfinite(tau):
            last, total = tau, total + power
            ranges, shown = ranges + power * tau, shown + power * reflectivity
    return


def _attribute_table(request: CastRequest) -> Tensor:
    parts = [
        torch.tensor([[0.5, 0.0]], dtype=torch.float64).repeat(len(instance.cloud), 1)
        if given is None
        else torch.from_numpy(given).double()
        for instance, given in zip(request.instances, request.attributes, strict=True)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, 2, dtype=torch.float64)
