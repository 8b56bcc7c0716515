"""Images of a log that lie in files, straightened when they are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...images import check_image_file, read_image
from ..lens import Lens


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """One file per camera and frame, and the lens of every camera."""

    files: Mapping[str, Sequence[Path]]
    lenses: Mapping[str, Lens]

    def read(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """The pinhole image, RGB uint8 [H, W, 3]."""
        return self.lenses[camera].undistort(read_image(self.files[camera][frame]))

    def check(self, camera: str, frame: int) -> None:
        """Raise LogError when the file is cut off or of another size than its lens."""
        lens = self.lenses[camera]
        check_image_file(self.files[camera][frame], (lens.width, lens.height))
