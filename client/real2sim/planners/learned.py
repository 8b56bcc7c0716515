"""A small network that drives with one camera, trained on recorded drives.

``real2sim train-policy`` writes the weights file. Requires torch and safetensors.
"""

from __future__ import annotations

import importlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.plans import TrajectoryPlan

from .planner import Needs

if TYPE_CHECKING:
    from ..observation import Observation

FORMAT = "real2sim-policy-1"
COMMANDS = ("left", "straight", "right")
SPEED_UNIT = 10.0
"""Scale of the network's speed input [m/s]."""
REACH = 20.0
"""Scale of the network's output positions [m]."""


@dataclass(frozen=True)
class PolicyShape:
    """Inputs and outputs of the network.

    Attributes:
        camera: name of its camera.
        width, height: size to which images are resized [px].
        poses: number of poses of a plan.
        spacing: time between them [s].
    """

    camera: str
    width: int = 96
    height: int = 64
    poses: int = 6
    spacing: float = 0.5

    def metadata(self) -> dict[str, str]:
        """Metadata for the header of a weights file."""
        return {"format": FORMAT, "shape": json.dumps(asdict(self))}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str] | None) -> PolicyShape:
        """The shape in the header of a file.

        Raises:
            ValueError: a different kind of file.
        """
        found = (metadata or {}).get("format")
        if found != FORMAT:
            raise ValueError(f"format {found!r} is not {FORMAT!r}")
        return cls(**json.loads((metadata or {})["shape"]))


class LearnedPolicy:
    """A planner whose inputs are one camera, its speed, and the route command.

    Examples:
        >>> from safetensors.torch import save_file
        >>> shape = PolicyShape(camera="front")
        >>> path = folder / "untrained.safetensors"
        >>> save_file(network(shape).state_dict(), path, shape.metadata())
        >>> planner = LearnedPolicy(path)
        >>> planner.needs.cameras
        ('front',)
    """

    def __init__(self, path: str | Path) -> None:
        """Load the weights in a file that ``real2sim train-policy`` wrote.

        Raises:
            ImportError: torch or safetensors is not installed.
            ValueError: the file has other content.
            OSError: it cannot be read.
        """
        torch, safetensors = _torch(), _module("safetensors")
        try:
            with safetensors.safe_open(str(path), framework="pt") as file:
                self.shape = PolicyShape.from_metadata(file.metadata())
                weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no policy of this version: {error}") from error
        self._network = network(self.shape)
        self._network.load_state_dict(weights)
        self._network.eval()
        self._torch = torch

    @property
    def needs(self) -> Needs:
        """The camera of the policy."""
        return Needs(modalities=("rgb",), cameras=(self.shape.camera,), width=2 * self.shape.width)

    def reset(self, obs: Observation) -> None:
        """Nothing is remembered between plans."""

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """Poses over the next seconds in the vehicle frame of ``obs``."""
        torch, shape = self._torch, self.shape
        image = shrink(obs.image(shape.camera), shape.width, shape.height)
        state = state_of(obs.ego.speed, obs.command)
        with torch.inference_mode():
            answer = self._network(torch.from_numpy(image)[None], torch.from_numpy(state)[None])
        poses = answer[0].numpy().astype(np.float64) * [REACH, REACH, 1.0]
        delays = [round((k + 1) * shape.spacing * 1e6) for k in range(shape.poses)]
        return TrajectoryPlan(
            times_us=[obs.t_us + delay for delay in delays],
            poses=[tuple(pose) for pose in poses.tolist()],
        )


def shrink(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.float32]:
    """RGB uint8 [H, W, 3] as float32 [3, height, width] in [-1, 1], averaged over areas."""
    pixels = image.astype(np.float32) / 127.5 - 1.0
    for axis, size in ((0, height), (1, width)):
        edges = np.linspace(0, pixels.shape[axis], size + 1)
        sums = np.cumsum(pixels, axis=axis, dtype=np.float64)
        sums = np.concatenate([np.zeros_like(sums.take([0], axis)), sums], axis=axis)
        below = np.floor(edges).astype(int)
        fraction = (edges - below).reshape([-1 if a == axis else 1 for a in range(3)])
        above = np.minimum(below + 1, pixels.shape[axis])
        at = sums.take(below, axis) * (1 - fraction) + sums.take(above, axis) * fraction
        pixels = np.diff(at, axis=axis) / (edges[1] - edges[0])
    return np.ascontiguousarray(pixels.transpose(2, 0, 1), dtype=np.float32)


def state_of(speed: float, command: str) -> NDArray[np.float32]:
    """[4] float32: normalised speed, then left, straight or right, one-hot."""
    return np.array([speed / SPEED_UNIT, *(float(command == c) for c in COMMANDS)], np.float32)


def network(shape: PolicyShape) -> Any:
    """A ``torch.nn.Module`` (images [N, 3, H, W], states [N, 4]) -> poses [N, K, 3] in units.

    Four convolutions of stride 2, and two layers for the state: about 0.3 million weights.
    """
    torch = _torch()
    nn = torch.nn

    class Policy(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            # The attribute names are the layer names in files of weights.
            widths = (3, 16, 24, 32, 48)
            layers: list[Any] = []
            for before, after in itertools.pairwise(widths):
                layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU()]
            self.eye = nn.Sequential(*layers, nn.Flatten())
            cells = -(-shape.width // 16) * -(-shape.height // 16)
            self.see = nn.Sequential(nn.Linear(widths[-1] * cells, 128), nn.ReLU())
            self.drive = nn.Sequential(
                nn.Linear(128 + 4, 64), nn.ReLU(), nn.Linear(64, 3 * shape.poses)
            )

        def forward(self, images: Any, states: Any) -> Any:
            seen = self.see(self.eye(images))
            return self.drive(torch.cat([seen, states], dim=1)).reshape(-1, shape.poses, 3)

    return Policy()


def _torch() -> Any:
    return _module("torch")


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            "a learned policy needs torch and safetensors: pip install torch safetensors "
            "(or 'real2sim[server]')"
        ) from error
