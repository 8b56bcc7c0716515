"""Motion with nearly constant velocity: Kalman filter and smoother in the plane.

Source: Rauch, Tung, Striebel 1965 for the smoother; white acceleration noise as in Bar-Shalom et
al., "Estimation with Applications to Tracking and Navigation", 2001, chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import Float

ACCELERATION = 2.5
"""Standard deviation of accelerations [m/s^2]."""

INITIAL_SPEED = 12.0
"""Standard deviation of the speed of a new track [m/s]."""

OBSERVATION = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])


@dataclass(frozen=True, eq=False)
class KalmanState:
    """Mean [4] (x, y, vx, vy) and covariance [4, 4]."""

    mean: Float
    covariance: Float

    @classmethod
    def first(cls, position: Float, deviation: float) -> KalmanState:
        """At a measured ``position`` [2] with unknown velocity."""
        variances = [deviation**2] * 2 + [INITIAL_SPEED**2] * 2
        return cls(np.array([*position, 0.0, 0.0]), np.diag(variances))

    def predict(self, seconds: float) -> KalmanState:
        """After a time."""
        transition = _transition(seconds)
        noise = _process_noise(seconds)
        return KalmanState(
            transition @ self.mean, transition @ self.covariance @ transition.T + noise
        )

    def distance(self, position: Float, deviation: float) -> float:
        """Mahalanobis distance of a measured position [2]."""
        residual = position - self.mean[:2]
        innovation_covariance = self.covariance[:2, :2] + deviation**2 * np.eye(2)
        return float(np.sqrt(residual @ np.linalg.solve(innovation_covariance, residual)))

    def update(self, position: Float, deviation: float) -> KalmanState:
        """With a measured position [2] of a standard deviation [m]."""
        innovation_covariance = (
            OBSERVATION @ self.covariance @ OBSERVATION.T + deviation** 2 * np.eye(2)
        )
        gain = np.linalg.solve(innovation_covariance, OBSERVATION @ self.covariance).T
        keep = np.eye(4) - gain @ OBSERVATION
        mean = self.mean + gain @ (position - OBSERVATION @ self.mean)
        covariance = keep @ self.covariance @ keep.T + deviation**2 * gain @ gain.T
        return KalmanState(mean, covariance)


def smooth(times: Float, positions: Sequence[Float | None], deviation: float) -> Float:
    """States [T, 4] at ``times`` [T] [s] from measured positions, None where there is none.

    Forward Kalman filter and backward pass; the first position must be known.
    """
    assert positions[0] is not None
    state = KalmanState.first(positions[0], deviation).update(positions[0], deviation)
    filtered, predicted = [state], [state]
    for i in range(1, len(times)):
        predicted_state = state.predict(times[i] - times[i - 1])
        position = positions[i]
        state = predicted_state if position is None else predicted_state.update(position, deviation)
        predicted.append(predicted_state)
        filtered.append(state)
    means = [filtered[-1].mean]
    for i in range(len(times) - 2, -1, -1):
        transition = _transition(times[i + 1] - times[i])
        gain = np.linalg.solve(predicted[i + 1].covariance, transition @ filtered[i].covariance).T
        means.append(filtered[i].mean + gain @ (means[-1] - predicted[i + 1].mean))
    return np.array(means[::-1])


def _transition(seconds: float) -> Float:
    transition = np.eye(4)
    transition[0, 2] = transition[1, 3] = seconds
    return transition


def _process_noise(seconds: float) -> Float:
    t = seconds
    block = np.array([[t**4 / 4, t**3 / 2], [t**3 / 2, t**2]]) * ACCELERATION**2
    noise = np.zeros((4, 4))
    noise[np.ix_([0, 2], [0, 2])] = noise[np.ix_([1, 3], [1, 3])] = block
    return noise
