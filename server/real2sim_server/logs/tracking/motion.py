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

FIRST_SPEED = 12.0
"""Standard deviation of the speed of a thing that is seen for the first time [m/s]."""

MEASURE = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])


@dataclass(frozen=True, eq=False)
class State:
    """Mean [4] (x, y, vx, vy) and covariance [4, 4]."""

    mean: Float
    covariance: Float

    @classmethod
    def first(cls, place: Float, deviation: float) -> State:
        """Of a thing at ``place`` [2] with unknown velocity."""
        variances = [deviation**2] * 2 + [FIRST_SPEED**2] * 2
        return cls(np.array([*place, 0.0, 0.0]), np.diag(variances))

    def predict(self, seconds: float) -> State:
        """After a time."""
        move = _move(seconds)
        noise = _noise(seconds)
        return State(move @ self.mean, move @ self.covariance @ move.T + noise)

    def distance(self, place: Float, deviation: float) -> float:
        """Mahalanobis distance of a measured place [2]."""
        residual = place - self.mean[:2]
        spread = self.covariance[:2, :2] + deviation**2 * np.eye(2)
        return float(np.sqrt(residual @ np.linalg.solve(spread, residual)))

    def update(self, place: Float, deviation: float) -> State:
        """With a measured place [2] of a standard deviation [m]."""
        spread = MEASURE @ self.covariance @ MEASURE.T + deviation**2 * np.eye(2)
        gain = np.linalg.solve(spread, MEASURE @ self.covariance).T
        keep = np.eye(4) - gain @ MEASURE
        mean = self.mean + gain @ (place - MEASURE @ self.mean)
        covariance = keep @ self.covariance @ keep.T + deviation**2 * gain @ gain.T
        return State(mean, covariance)


def smooth(times: Float, places: Sequence[Float | None], deviation: float) -> Float:
    """States [T, 4] at ``times`` [T] [s] from measured places, None where there is none.

    Forward Kalman filter and backward pass; the first place must be known.
    """
    assert places[0] is not None
    state = State.first(places[0], deviation).update(places[0], deviation)
    filtered, predicted = [state], [state]
    for i in range(1, len(times)):
        ahead = state.predict(times[i] - times[i - 1])
        place = places[i]
        state = ahead if place is None else ahead.update(place, deviation)
        predicted.append(ahead)
        filtered.append(state)
    means = [filtered[-1].mean]
    for i in range(len(times) - 2, -1, -1):
        move = _move(times[i + 1] - times[i])
        gain = np.linalg.solve(predicted[i + 1].covariance, move @ filtered[i].covariance).T
        means.append(filtered[i].mean + gain @ (means[-1] - predicted[i + 1].mean))
    return np.array(means[::-1])


def _move(seconds: float) -> Float:
    move = np.eye(4)
    move[0, 2] = move[1, 3] = seconds
    return move


def _noise(seconds: float) -> Float:
    t = seconds
    block = np.array([[t**4 / 4, t**3 / 2], [t**3 / 2, t**2]]) * ACCELERATION**2
    noise = np.zeros((4, 4))
    noise[np.ix_([0, 2], [0, 2])] = noise[np.ix_([1, 3], [1, 3])] = block
    return noise
