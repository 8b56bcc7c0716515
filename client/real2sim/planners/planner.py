"""What a planner is, and how one is found by name."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from real2sim_proto.drive import Plan

    from ..observation import Observation

BUILT_IN = {"follow_route": "real2sim.planners.follow_route:FollowRoute"}


@runtime_checkable
class Planner(Protocol):
    """Drives: sees observations, answers with plans."""

    def reset(self, obs: Observation) -> None:
        """Forget the last episode; ``obs`` is the first of the new one."""

    def plan(self, obs: Observation) -> Plan | Mapping[str, Any]:
        """The answer to an observation: a trajectory, a control or a pose."""


def load_planner(name: str) -> Planner:
    """A planner by name: a built-in one, or ``module:Class``, made without arguments.

    Modules are looked for in the working folder too.

    Raises:
        ValueError: no such module or class, or it is not a planner.
    """
    module_name, colon, attribute = BUILT_IN.get(name, name).partition(":")
    if not colon:
        known = ", ".join(sorted(BUILT_IN))
        raise ValueError(f"planner {name!r} is unknown; give {known} or 'module:Class'")
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, folder)
    try:
        make = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"planner {name!r} cannot be loaded: {error}") from error
    planner = make()
    if not isinstance(planner, Planner):
        raise ValueError(f"planner {name!r} needs the methods reset(obs) and plan(obs)")
    return planner
