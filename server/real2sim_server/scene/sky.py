"""What is seen where no Gaussian is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .errors import SceneError


@dataclass(frozen=True, eq=False)
class Sky:
    """A cube map of the sky in world directions.

    Attributes:
        faces: [6, R, R, 3] float32 RGB in [0, 1], order +x -x +y -y +z -z. On each face the pixel
            (row, column) centre at u, v = (column + 0.5, row + 0.5) / R * 2 - 1 looks along the
            direction of :func:`face_directions`.
        uncertainties: [6, R, R] float32 in [0, 1] of the texels, as those of a cloud's Gaussians;
            None where they are not known.
    """

    faces: Tensor
    uncertainties: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.faces.shape)
        if (
            len(shape) != 4
            or shape[0] != 6
            or shape[1] != shape[2]
            or shape[3] != 3
            or shape[1] < 1
        ):
            raise SceneError(f"sky faces must be [6, R, R, 3], not {list(shape)}")
        if self.faces.dtype != torch.float32:
            raise SceneError(f"sky faces must be float32, not {self.faces.dtype}")
        given = self.uncertainties
        if given is not None and (given.shape != shape[:3] or given.dtype != torch.float32):
            raise SceneError(
                f"uncertainties of a sky must be {list(shape[:3])} float32, "
                f"not {list(given.shape)} {given.dtype}"
            )

    @property
    def resolution(self) -> int:
        """Edge length R of a face [px]."""
        return int(self.faces.shape[1])

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return sum(t.numel() * t.element_size() for t in self.tensors().values())

    def tensors(self) -> dict[str, Tensor]:
        """Its tensors by name, without what is not known."""
        known = {} if self.uncertainties is None else {"uncertainties": self.uncertainties}
        return {"faces": self.faces, **known}

    def check_values(self) -> None:
        """Look at every value. Raises SceneError for those not finite or out of range."""
        if not bool(torch.isfinite(self.faces).all()):
            raise SceneError("sky: faces hold values that are not finite")
        given = self.uncertainties
        if given is not None and not bool(((given >= 0) & (given <= 1)).all()):
            raise SceneError("sky: uncertainties hold values outside [0, 1]")

    @classmethod
    def uniform(cls, rgb: tuple[float, float, float], *, resolution: int = 1) -> Sky:
        """One colour everywhere."""
        return cls(
            torch.tensor(rgb, dtype=torch.float32).expand(6, resolution, resolution, 3).contiguous()
        )

    def to(self, device: torch.device | str) -> Sky:
        """The sky on another device."""
        if torch.device(device) == self.faces.device:
            return self
        return Sky(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def sample(self, directions: Tensor) -> Tensor:
        """Bilinear colour [..., 3] along world ``directions`` [..., 3] (any length, not zero)."""
        face, u, v = face_coordinates(directions)
        r = self.resolution
        column = ((u + 1) / 2 * r - 0.5).clamp(0, r - 1)
        row = ((v + 1) / 2 * r - 0.5).clamp(0, r - 1)
        c0, r0 = column.floor().long(), row.floor().long()
        c1, r1 = (c0 + 1).clamp(max=r - 1), (r0 + 1).clamp(max=r - 1)
        fc, fr = (column - c0)[..., None], (row - r0)[..., None]
        top = self.faces[face, r0, c0] * (1 - fc) + self.faces[face, r0, c1] * fc
        bottom = self.faces[face, r1, c0] * (1 - fc) + self.faces[face, r1, c1] * fc
        return top * (1 - fr) + bottom * fr


def face_coordinates(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Face index [...] and coordinates u (column), v (row) [...] in [-1, 1] of ``directions``.

    ±x faces: u = ∓y, v = -z; ±y faces: u = ±x, v = -z; +z face: u = -y, v = +x;
    -z face: u = -y, v = -x, each over the largest absolute component. Side faces stand upright
    seen from inside.
    """
    x, y, z = directions.unbind(-1)
    ax, ay, az = x.abs(), y.abs(), z.abs()
    on_x = (ax >= ay) & (ax >= az)
    on_y = ~on_x & (ay >= az)
    face = torch.where(
        on_x,
        torch.where(x > 0, 0, 1),
        torch.where(on_y, torch.where(y > 0, 2, 3), torch.where(z > 0, 4, 5)),
    )
    major = torch.where(on_x, ax, torch.where(on_y, ay, az))
    u = torch.where(
        on_x, torch.where(x > 0, -y, y), torch.where(on_y, torch.where(y > 0, x, -x), -y)
    )
    v = torch.where(on_x | on_y, -z, torch.where(z > 0, x, -x))
    return face, u / major, v / major


def face_directions(resolution: int) -> NDArray[np.float32]:
    """Unit world directions [6, R, R, 3] float32 of all pixel centres.

    Inverse of :func:`face_coordinates`.
    """
    centre = (np.arange(resolution) + 0.5) / resolution * 2 - 1
    v, u = np.meshgrid(centre, centre, indexing="ij")
    one = np.ones_like(u)
    faces = np.stack(
        [
            np.stack([one, -u, -v], -1),
            np.stack([-one, u, -v], -1),
            np.stack([u, one, -v], -1),
            np.stack([-u, -one, -v], -1),
            np.stack([v, -u, one], -1),
            np.stack([-v, -u, -one], -1),
        ]
    )
    directions = faces / np.linalg.norm(faces, axis=-1, keepdims=True)
    return np.asarray(directions, dtype=np.float32)
