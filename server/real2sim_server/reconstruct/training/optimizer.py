"""Adam that only touches what was seen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from . import kernels

EPSILON = 1e-15


class SelectiveAdam:
    """Adam (Kingma and Ba 2015) over named tensors whose first axis are rows.

    Rows that were not seen keep value and moments, so that a Gaussian does not drift while it is
    out of view; the bias of young moments is corrected by the number of steps of all.

    Args:
        parameters: by name, float32, updated in place.
    """

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        self.steps = 0
        self.first = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.second = {name: torch.zeros_like(p) for name, p in parameters.items()}

    @torch.no_grad()
    def step(
        self,
        parameters: Mapping[str, Tensor],
        rates: Mapping[str, float | Tensor],
        seen: Mapping[str, Tensor],
    ) -> None:
        """One step along the gradients held by ``parameters``.

        Args:
            parameters: those without a gradient are left alone.
            rates: learning rate by name, one number or one for each column of a row.
            seen: [rows] bool by name; all rows where a name is missing.
        """
        self.steps += 1
        for name, parameter in parameters.items():
            if parameter.grad is not None and parameter.numel():
                self._update(name, parameter, parameter.grad, rates[name], seen.get(name))

    def _update(
        self,
        name: str,
        parameter: Tensor,
        gradient: Tensor,
        rate: float | Tensor,
        seen: Tensor | None,
    ) -> None:
        rows = parameter.shape[0]
        views = [
            t.detach().reshape(rows, -1)
            for t in (parameter, gradient, self.first[name], self.second[name])
        ]
        columns = torch.as_tensor(rate, dtype=torch.float32, device=parameter.device)
        columns = columns.expand(views[0].shape[1]) / (1 - 0.9**self.steps)
        correction = (1 - 0.999**self.steps) ** -0.5
        if seen is None:
            seen = torch.ones(rows, dtype=torch.bool, device=parameter.device)
        if parameter.device.type != "cpu":
            _update_plain(views, seen, columns, correction)
            return
        values, by_values, first, second = (view.numpy() for view in views)
        kernels.adam_rows(
            values,
            by_values,
            first,
            second,
            seen.numpy(),
            columns.contiguous().numpy(),
            np.float32(correction),
            np.float32(EPSILON),
        )

    def gather(self, name: str, source: Tensor, fresh: Tensor) -> None:
        """Follow a change of rows: new row i was row ``source[i]``; ``fresh`` rows start anew.

        Args:
            source: [M] int64.
            fresh: [M] bool.
        """
        for moments in (self.first, self.second):
            taken = moments[name][source].contiguous()
            taken[fresh] = 0
            moments[name] = taken

    def reset_moments(self, name: str, rows: Tensor | None = None) -> None:
        """Set moments to zero, of ``rows`` (mask or indices) or of all."""
        for moments in (self.first, self.second):
            moments[name][slice(None) if rows is None else rows] = 0

    def state(self) -> dict[str, Tensor]:
        """Moments by ``first.<name>`` and ``second.<name>``; the tensors themselves."""
        return {f"first.{k}": v for k, v in self.first.items()} | {
            f"second.{k}": v for k, v in self.second.items()
        }

    def restore(self, state: Mapping[str, Tensor], steps: int) -> None:
        """Take over what :meth:`state` gave after ``steps`` steps; what it lacks begins."""
        self.steps = steps
        self.first = {k: state.get(f"first.{k}", held) for k, held in self.first.items()}
        self.second = {k: state.get(f"second.{k}", held) for k, held in self.second.items()}


def _update_plain(views: list[Tensor], seen: Tensor, columns: Tensor, correction: float) -> None:
    values, gradient, first, second = views
    # Chosen by where, not by index: an index of unknown length would be waited for.
    rows = seen[:, None]
    m = torch.where(rows, 0.9 * first + 0.1 * gradient, first)
    v = torch.where(rows, 0.999 * second + 0.001 * gradient * gradient, second)
    first.copy_(m)
    second.copy_(v)
    values.sub_(torch.where(rows, columns * m / (v.sqrt() * correction + EPSILON), 0.0))
