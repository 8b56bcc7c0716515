"""Calibration of materials and motion by least squares through the differentiable solver."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..geometry import Float
from . import stress
from .backends.reference import TorchParameters, TorchState, substep, torch_model, with_stress
from .colliders import Collider
from .errors import SolverError
from .fitting import COARSER, continued
from .solver import Solver

PARAMETERS = ("stiffness", "yield_stress", "viscosity", "friction", "speed")
"""Parameters that can be fitted: positive factors on the initial values of the solver."""
DAMPING = 1e-3
"""Damping of the first step, as a fraction of each parameter's own curvature (Marquardt 1963)."""
DAMPING_MIN = 1e-12
CALMER, BOLDER = 5.0, 0.2
"""Factors on the damping after a rejected and after an accepted step."""
MAX_STEP = 0.5
"""Maximum change of the logarithm of a factor in one step."""
PATIENCE = 3
"""Number of consecutive rejected steps after which slopes use a wider span."""
SPANS = (0.1, 0.03, 0.01)
"""These spans in order, in the logarithm of a factor."""
REACHED = 1e-9
"""Residuals below this are rounding errors [m]."""
FLAT = 1e-12
"""Minimum curvature of a parameter relative to the largest; others keep their values."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a calibration.

    Attributes:
        factors: by parameter, relative to the initial value of the solver.
        uncertainty: by parameter, relative uncertainty of the factor, from an observation error of
            ``residual[-1]`` and from ``discretisation``; infinite for undetermined parameters.
        discretisation: by parameter, the part due to the cell size: the change of the result on
            coarser cells, extrapolated to zero (Richardson 1911, first order).
        residual: RMS distance to the observations [m], at the start and after each accepted step;
            never increases.
        rejected: number of rejected steps, which would have increased the residual.
    """

    factors: dict[str, float]
    uncertainty: dict[str, float]
    discretisation: dict[str, float]
    residual: tuple[float, ...]
    rejected: int


def calibrate(
    solver: Solver,
    observed: Float,
    *,
    parameters: Sequence[str],
    dt: float,
    every: int,
    steps: int = 30,
) -> Calibration:
    """Fit factors so that a body's particles move as observed.

    A step that increases the residual is rejected and shortened (Levenberg 1944, Marquardt 1963).
    Contacts start a substep earlier or later as parameters change, so trajectories are piecewise
    smooth with jumps. If no step along the gradient helps, secants over several jumps are used.

    Args:
        solver: solver at its start, with initial values; its state is not changed.
        observed: [T, N, 3] positions after ``every``, 2 ``every``, ... substeps [m].
        parameters: names from PARAMETERS.
        dt: substep [s], stable for all tried values.
        every: substeps between observations.
        steps: maximum number of steps, including rejected ones.

    Raises:
        SolverError: for invalid names or shapes, or initial values that diverge.
    """
    names = tuple(dict.fromkeys(parameters))
    target = _checked(solver, observed, names)
    path = rollout(solver, names, dt=dt, every=every, observations=len(observed))
    logs = torch.zeros(len(names), dtype=torch.float64)
    off = (path(logs) - target).reshape(-1)
    history, rejected, refused, damping = [_size(off)], 0, 0, DAMPING
    if not math.isfinite(history[0]):
        raise SolverError(f"the initial values diverge with dt of {dt!r} s; take a shorter one")
    J = jacobian(path, logs)
    for _ in range(steps):
        if history[-1] < REACHED or refused >= PATIENCE * (len(SPANS) + 1):
            break
        tried = logs + _step(J, off, damping)
        found = (path(tried) - target).reshape(-1)
        if _size(found) < history[-1]:
            logs, off, refused = tried, found, 0
            history.append(_size(off))
            damping = max(damping * BOLDER, DAMPING_MIN)
            J = jacobian(path, logs)
            continue
        rejected, refused, damping = rejected + 1, refused + 1, damping * CALMER
        wider, last = divmod(refused, PATIENCE)
        if last == 0 and wider <= len(SPANS):
            J, damping = _secants(path, logs, SPANS[wider - 1]), DAMPING
    factors = dict(zip(names, logs.exp().tolist(), strict=True))
    open_ = _uncertainty(J, names, history[-1])
    cells = _discretisation(solver, names, logs, J, target, dt=dt, every=every)
    total = {name: math.hypot(open_[name], cells[name]) for name in names}
    return Calibration(factors, total, cells, tuple(history), rejected)


def _discretisation(
    solver: Solver,
    names: Sequence[str],
    logs: Tensor,
    J: Tensor,
    target: Tensor,
    *,
    dt: float,
    every: int,
) -> dict[str, float]:
    """Distance of the logarithms to those at cell size zero, from coarser cells."""
    scale = _scale(J)
    scaled = J / scale
    inverse = torch.linalg.pinv(scaled) / scale[:, None]
    moved: dict[float, Float] = {}
    for coarser in COARSER:
        options = replace(solver.options, dx=coarser * solver.dx)
        coarse = Solver(solver.bodies, solver.colliders, options)
        path = rollout(coarse, names, dt=dt, every=every, observations=len(target))
        step = -(inverse @ (path(logs) - target).reshape(-1))
        if bool(torch.isfinite(step).all()):
            moved[coarser] = step.clamp(-MAX_STEP, MAX_STEP).numpy()
    if not moved:
        return dict.fromkeys(names, math.inf)
    return dict(zip(names, continued(moved).tolist(), strict=True))


def _checked(solver: Solver, observed: Float, names: Sequence[str]) -> Tensor:
    shape = (len(observed), len(solver.model.masses), 3)
    if np.shape(observed) != shape or not len(observed):
        raise SolverError(f"observed must be {shape}, at least once, not {np.shape(observed)}")
    if not np.isfinite(observed).all():
        raise SolverError("observed positions must be finite; leave out unseen ones")
    unknown = sorted(set(names) - set(PARAMETERS))
    if unknown or not names:
        raise SolverError(f"cannot fit {unknown}; allowed are {list(PARAMETERS)}")
    return torch.as_tensor(observed, dtype=torch.float64)


def _size(off: Tensor) -> float:
    """RMS; NaN compares as no improvement."""
    return float(off.square().mean().sqrt())


def _step(J: Tensor, off: Tensor, damping: float) -> Tensor:
    """One damped step of the logarithms, with scaled parameters."""
    scale = _scale(J)
    scaled = J / scale
    normal = scaled.T @ scaled + damping * torch.eye(len(scale), dtype=J.dtype)
    step = torch.linalg.solve(normal, -(scaled.T @ off)) / scale
    longest = float(step.abs().max())
    bounded: Tensor = step * min(1.0, MAX_STEP / max(longest, 1e-30))
    return bounded


def _scale(J: Tensor) -> Tensor:
    """Lengths of the columns; infinite for parameters that hardly change anything."""
    lengths = J.norm(dim=0)
    known = lengths > math.sqrt(FLAT) * lengths.max()
    return torch.where(known, lengths, torch.full_like(lengths, math.inf))


def _uncertainty(J: Tensor, names: Sequence[str], residual: float) -> dict[str, float]:
    scale = _scale(J)
    scaled = J / scale
    covariance = torch.linalg.pinv(scaled.T @ scaled, hermitian=True)
    spread = residual * covariance.diagonal().clamp(min=0).sqrt() / scale
    spread = torch.where(scale.isinf(), torch.full_like(spread, math.inf), spread)
    return dict(zip(names, spread.tolist(), strict=True))


def jacobian(path: Callable[[Tensor], Tensor], logs: Tensor) -> Tensor:
    """[M, K] of a path by forward-mode dual numbers, all parameters in one run."""

    def along(direction: Tensor) -> Tensor:
        tangent: Tensor = torch.func.jvp(path, (logs,), (direction,))[1]
        return tangent.reshape(-1)

    with warnings.catch_warnings():
        # Torch's forward rules use a function that it has deprecated, and some operations lack a
        # batched rule.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", UserWarning)
        return torch.func.vmap(along)(torch.eye(len(logs), dtype=logs.dtype)).T


def _secants(path: Callable[[Tensor], Tensor], logs: Tensor, span: float) -> Tensor:
    """[M, K] by central differences over ``span``."""
    steps = span / 2 * torch.eye(len(logs), dtype=logs.dtype)
    columns = [(path(logs + step) - path(logs - step)).reshape(-1) / span for step in steps]
    return torch.stack(columns, dim=1)


def rollout(
    solver: Solver, parameters: Sequence[str], *, dt: float, every: int, observations: int
) -> Callable[[Tensor], Tensor]:
    """Positions [T, N, 3] as a function of logarithms of factors [K]; differentiable."""
    state, params = torch_model(solver.model)
    colliders: tuple[Collider, ...] = solver.colliders

    def path(logs: Tensor) -> Tensor:
        one = torch.ones((), dtype=torch.float64)
        factor = dict.fromkeys(PARAMETERS, one)
        factor.update(zip(parameters, logs.exp().unbind(), strict=True))
        now, changed = _scaled(state, params, factor)
        seen = []
        for count in range(every * observations):
            moved = [c.after(count * dt) for c in colliders]
            now, _ = substep(now, changed, moved, dt)
            if (count + 1) % every == 0:
                seen.append(now.x)
        return torch.stack(seen)

    return path


def _scaled(
    state: TorchState, params: TorchParameters, factor: dict[str, Tensor]
) -> tuple[TorchState, TorchParameters]:
    columns = [torch.ones((), dtype=torch.float64)] * stress.MATERIAL_ROW
    columns[stress.MU] = columns[stress.LAMBDA] = factor["stiffness"]
    columns[stress.A], columns[stress.VISCOSITY] = (
        factor["yield_stress"],
        factor["viscosity"],
    )
    changed = replace(
        params,
        rows=params.rows * torch.stack(columns),
        friction=params.friction * factor["friction"],
    )
    thrown = replace(state, v=state.v * factor["speed"], L=state.L * factor["speed"])
    return with_stress(thrown, changed), changed
