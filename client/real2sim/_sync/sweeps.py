# Made from _async/sweeps.py by scripts/unasync.py; edit that file, then run the script.
"""Sweeps and searches: many variants of a case, driven on the worker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from real2sim_proto.operations import Operation
from real2sim_proto.storyboard import Storyboard
from real2sim_proto.sweeps import StopRule, SweepRequest

from .. import _requests
from .._call import checked
from .._references import SceneRef
from .._references import scene_name as name_of
from .jobs import Job
from .transport import Transport


class Sweeps:
    """``client.sweeps``.

    Examples:
        >>> client = real2sim.connect()
        >>> case = {"scene": "street", "reset": {"horizon": 5}}
        >>> case["reset"]["agents"] = {"drivers": {"car_red": {"kind": "hard_brake"}}}
        >>> gap = {"path": "agents.drivers.car_red.delay", "low": 0.0, "high": 0.4}
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._transport.target})"

    def start(
        self,
        scene: SceneRef,
        *,
        parameters: Mapping[str, Any] | None = None,
        corner_case: str | None = None,
        openscenario: str | Path | None = None,
        storyboard: Storyboard | Mapping[str, Any] | None = None,
        ego: str | None = None,
        leave_out: Sequence[str] = (),
        reset: Mapping[str, Any] | None = None,
        operations: Sequence[Operation | Mapping[str, Any]] = (),
        method: str | Mapping[str, Any] = "sobol",
        seeds: Sequence[int] = (0,),
        planners: Sequence[str] = ("idm",),
        stop: StopRule | Mapping[str, Any] | None = None,
        metrics: Sequence[str] = (),
        worst: int = 3,
        rank_by: str = "criticality",
    ) -> Job:
        """Start driving points of a parameter space, without images unless planners need some.

        The job leaves ``episodes.parquet``, a row an episode, and of the ``worst`` in its result
        ``EPISODE.r2e`` (a recording) and, of a scenario, ``EPISODE.xosc``.

        Args:
            scene: its name.
            parameters: by name, as of ``real2sim sweep``: ``{"low": 2, "high": 20}`` and others,
                with a ``path`` into ``reset``, or without one where the scenario has the parameter.
            corner_case, openscenario, storyboard: what happens, at most one: a case of the gallery,
                the text of an OpenSCENARIO file or its path, a storyboard in the scene's frame.
            ego: entity of the file that is the ego; default: ``Ego``.
            leave_out: elements of the file to leave out.
            reset: options of the episodes.
            operations: edits of the scene.
            method: ``sobol``, ``halton``, ``latin_hypercube``, ``random``, ``grid``, or one with
                its fields: ``{"kind": "grid", "levels": 5}``.
            seeds: each point is driven with each.
            planners: ``follow_route``, ``pid``, ``idm``, ``depth_sampling``.
            stop: when enough is known, such as ``{"at_fault": 10}``.
            metrics: scores that get columns.
            worst: so many episodes leave recordings, by ``rank_by`` from the highest on.
            rank_by: a column.

        Raises:
            ValueError: a field that is not allowed.

        Examples:
            >>> method = {"kind": "grid", "levels": 2}
            >>> job = client.sweeps.start(**case, parameters={"gap": gap}, method=method)
            >>> job = job.wait(timeout=300.0)
            >>> job.result["episodes"]
            2
            >>> path = job.download("episodes.parquet", folder / "episodes.parquet")
        """
        given = {
            "parameters": dict(parameters or {}),
            "method": method,
            "seeds": list(seeds),
            "planners": list(planners),
            "stop": stop,
            "metrics": list(metrics),
            "worst": worst,
            "rank_by": rank_by,
            "operations": list(operations),
            "reset": dict(reset or {}),
            **_scenario(corner_case, openscenario, storyboard, ego, leave_out),
        }
        return self._started(scene, given)

    def search(
        self,
        scene: SceneRef,
        *,
        planner: str,
        parameters: Mapping[str, Any] | None = None,
        corner_case: str | None = None,
        openscenario: str | Path | None = None,
        storyboard: Storyboard | Mapping[str, Any] | None = None,
        ego: str | None = None,
        leave_out: Sequence[str] = (),
        reset: Mapping[str, Any] | None = None,
        operations: Sequence[Operation | Mapping[str, Any]] = (),
        episodes: int = 300,
        seed: int = 0,
        shrink: int = 3,
        probability: int = 0,
        films: int = 0,
    ) -> Job:
        """Start looking for collisions that are a planner's fault and could have been avoided.

        The job leaves ``failures.json``, each failure as ``failure_01.xosc`` and ``.r2e``, and
        ``failures.tar`` with a page, cases and films.

        Args:
            scene, parameters, corner_case, openscenario: as of :meth:`start`.
            storyboard, ego, leave_out, reset, operations: likewise.
            planner: ``follow_route``, ``pid``, ``idm`` or ``depth_sampling``.
            episodes: that are driven at most, 20 or more.
            seed: the same one finds the same failures.
            shrink: failures whose boundary to going well is sought.
            probability: episodes for how often the planner is at fault; 0: none.
            films: failures that are filmed.

        Raises:
            ValueError: a field that is not allowed.

        Examples:
            >>> asked = {"planner": "idm", "parameters": {"gap": gap}, "episodes": 20}
            >>> job = client.sweeps.search(**case, **asked)
            >>> job.info.kind, (job.cancel()).info.state.value
            ('sweep', 'cancelled')
        """
        method = {"kind": "search", "episodes": episodes, "seed": seed, "shrink": shrink}
        given = {
            "parameters": dict(parameters or {}),
            "method": method | {"probability": probability, "films": films},
            "planners": [planner],
            "operations": list(operations),
            "reset": dict(reset or {}),
            **_scenario(corner_case, openscenario, storyboard, ego, leave_out),
        }
        return self._started(scene, given)

    def _started(self, scene: SceneRef, given: Mapping[str, Any]) -> Job:
        fields = {name: value for name, value in given.items() if value is not None}
        call = _requests.create_sweep(checked(SweepRequest, scene=name_of(scene), **fields))
        return Job(self._transport, self._transport.send(call))


def _scenario(
    corner_case: str | None,
    openscenario: str | Path | None,
    storyboard: Storyboard | Mapping[str, Any] | None,
    ego: str | None,
    leave_out: Sequence[str],
) -> dict[str, Any]:
    text = openscenario.read_text("utf-8") if isinstance(openscenario, Path) else openscenario
    given = {"corner_case": corner_case, "openscenario": text, "storyboard": storyboard}
    return {**given, "ego": ego, "leave_out": list(leave_out)}
