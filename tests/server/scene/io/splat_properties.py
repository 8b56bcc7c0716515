"""Small clouds for property tests, and distances between clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import strategies as st

from real2sim_server.geometry import quaternion_to_matrix
from real2sim_server.scene import GaussianCloud


@dataclass(frozen=True)
class Recipe:
    """Parameters of a random cloud, which Hypothesis can print and shrink."""

    count: int
    degree: int
    spread: float
    log_scale: float
    sh_reach: float
    axis_aligned: bool
    seed: int

    def cloud(self) -> GaussianCloud:
        random = np.random.default_rng(self.seed)
        quats = random.normal(size=(self.count, 4))
        if self.axis_aligned:
            signs = random.choice([-1, 1], (self.count, 1))
            quats = np.eye(4)[random.integers(0, 4, self.count)] * signs
        shape = (self.count, (self.degree + 1) ** 2, 3)
        parts = {
            "means": random.uniform(-1, 1, (self.count, 3)) * self.spread,
            "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
            "scales": np.exp(self.log_scale + random.uniform(-1, 1, (self.count, 3))),
            "opacities": random.choice([0.0, 0.3, 1.0, random.uniform()], self.count),
            "sh": random.uniform(-1, 1, shape) * self.sh_reach,
        }
        return GaussianCloud(**{k: torch.tensor(v, dtype=torch.float32) for k, v in parts.items()})


def recipes(
    *, sh_reach: float = 1.0, spreads: tuple[float, ...] = (0.0, 1e-3, 1.0, 100.0)
) -> st.SearchStrategy[Recipe]:
    """Recipes of up to 600 Gaussians of any degree, with counts around the chunk size."""
    return st.builds(
        Recipe,
        count=st.sampled_from([0, 1, 2, 255, 256, 257, 600]),
        degree=st.integers(0, 3),
        spread=st.sampled_from(spreads),
        log_scale=st.sampled_from([-8.9, -3.0, 0.0]),
        sh_reach=st.just(sh_reach),
        axis_aligned=st.booleans(),
        seed=st.integers(0, 2**32 - 1),
    )


def rotation_angles(a: GaussianCloud, b: GaussianCloud) -> np.ndarray:
    """Angles [N] [rad] between the rotations of two clouds."""
    left = quaternion_to_matrix(a.quats.double().numpy())
    right = quaternion_to_matrix(b.quats.double().numpy())
    # The chord is 2 sqrt(2) sin(angle / 2), accurate for small angles.
    chord = np.linalg.norm(left - right, axis=(1, 2)) / np.sqrt(8)
    return 2 * np.arcsin(np.clip(chord, 0, 1))


def covariances(cloud: GaussianCloud) -> np.ndarray:
    """Covariance matrices [N, 3, 3] of a cloud."""
    axes = quaternion_to_matrix(cloud.quats.double().numpy())
    return np.einsum("nij,nj,nkj->nik", axes, cloud.scales.double().numpy() ** 2, axes)


def largest_turn(step: float) -> float:
    """Largest rotation error [rad] when the three small parts of a quaternion round to ``step``.

    Each small part has an error of step / 2. The fourth follows from unit length, and its error is
    sqrt(1 - w^2) / w times their norm, largest for w = 1/2. An angle is twice the distance between
    unit quaternions.
    """
    return 2 * np.sqrt(3 + 9) * step / 2 * 1.01
