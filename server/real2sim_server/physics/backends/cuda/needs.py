"""What the CUDA backend needs, and what to do about what is not here."""

from __future__ import annotations

from ....render.backends.cuda.needs import Need
from ....render.backends.nvrtc.needs import unmet_need as unmet_serving_need


def unmet_need() -> Need | None:
    """The first that is not met: the same as for kernels that draw, torch's CUDA and NVRTC."""
    return unmet_serving_need()
