"""Drive with a PyTorch policy that sees the front camera and answers with controls.

Needs a worker, ``real2sim serve --demo``, and torch.
"""

import torch

import real2sim
from real2sim import Control, Observation
from real2sim.planners import Needs, run_episode


class CameraPolicy:
    """An untrained network; load your own weights in ``reset``."""

    needs = Needs(modalities=("rgb",), cameras=("front",), width=96, action="control")

    def reset(self, obs: Observation) -> None:
        """Called once, with the first observation of an episode."""
        torch.manual_seed(0)
        self.net = torch.nn.Sequential(
            torch.nn.Conv2d(3, 8, 5, 4), torch.nn.Flatten(), torch.nn.LazyLinear(1)
        )

    @torch.inference_mode()
    def plan(self, obs: Observation) -> Control:
        """Steer from the image and keep a speed of 8 m/s."""
        image = torch.from_numpy(obs.image("front") / 255.0).float().permute(2, 0, 1)[None]
        steering = 0.05 * float(self.net(image).tanh())  # [rad], positive to the left
        return Control(acceleration=8.0 - obs.ego.speed, steering=steering)


def main() -> None:
    """Drive 50 steps."""
    with real2sim.connect() as sim, sim.session(scene="demo_street") as session:
        summary = run_episode(session, CameraPolicy(), steps=50, seed=0)
    print(summary.reason, f"{summary.distance:.1f} m", summary.metrics)


if __name__ == "__main__":
    main()
