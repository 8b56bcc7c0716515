"""Train a small policy in 64 worlds at once with the cross-entropy method.

Runs without a worker; needs ``pip install 'real2sim[server,gym]'``. The policy is linear in the
speed and the bearings of two points of the route, so it trains in a minute on two cores.
"""

import gymnasium
import numpy as np
from numpy.typing import NDArray

WORLDS, ELITE, ROUNDS, STEPS = 64, 8, 6, 60


def features(obs: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """[N, 4]: speed, bearings of a near and a far point of the route, and 1."""
    points = obs["route"][:, 3], obs["route"][:, 10]  # [N, 2], vehicle frame [m]
    angles = [point[:, 1] / np.maximum(point[:, 0], 1.0) for point in points]
    speed = obs["state"][:, 0] / 10.0
    return np.stack([speed, *angles, np.ones_like(speed)], axis=1)


def evaluate(env: gymnasium.vector.VectorEnv, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The return of an episode with each of N policies; weights are [N, 4, 2]."""
    obs, _ = env.reset(seed=0)
    returns, alive = np.zeros(env.num_envs), np.ones(env.num_envs, bool)
    for _ in range(STEPS):
        action = np.tanh(np.einsum("nf,nfa->na", features(obs), weights)).astype(np.float32)
        obs, reward, terminated, truncated, _ = env.step(action)
        returns += np.where(alive, reward, 0.0)
        alive &= ~(terminated | truncated)
    return returns


def main() -> None:
    """Train, and print the mean and best return of each round."""
    name = "real2sim_server.learning:real2sim/DriveBatch-v0"
    env = gymnasium.make_vec(name, num_envs=WORLDS, options={"horizon": STEPS})
    rng = np.random.default_rng(0)
    mean, spread = np.zeros((4, 2)), np.ones((4, 2))
    for turn in range(ROUNDS):
        weights = mean + spread * rng.standard_normal((WORLDS, 4, 2))
        returns = evaluate(env, weights)
        best = weights[np.argsort(returns)[-ELITE:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.05
        print(f"round {turn}: mean {returns.mean():.1f}, best {returns.max():.1f}")
    env.close()


if __name__ == "__main__":
    main()
