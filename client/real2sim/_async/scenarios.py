"""Scenarios: a scene and the edits made to it.

A handle sends its revision with every edit. If someone else has edited the scenario since, the
worker refuses the edit with :class:`~real2sim.errors.StaleRevisionError`, which lists the missed
edits. Call ``refresh()`` and decide again.
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from real2sim_proto.jobs import CalibrateRequest, Observations, SimulateRequest
from real2sim_proto.operations import Operation, PhysicsValues
from real2sim_proto.scenarios import (
    CornerCaseInfo,
    History,
    OperationResult,
    ScenarioDocument,
    ScenarioInfo,
    StoryboardResult,
)
from real2sim_proto.scenes import ObjectInfo

from .. import _requests
from .._calls import Call, ViewRequest, checked, instant_us
from .._handles import Objects, ScenarioRef, ScenarioState, SceneRef, scenario_id_of, scene_name
from .._object_edits import (
    UPRIGHT,
    ObjectEdits,
    Quaternion,
    ScenarioEdits,
    Vector,
    insertion,
)
from ..clouds import LidarCloud
from ..images import Image, write_atomically
from .concurrency import run_blocking
from .jobs import AsyncJob
from .transport import AsyncCollection, AsyncTransport


class AsyncScenarios(AsyncCollection[ScenarioInfo]):
    """``client.scenarios``.

    Examples:
        >>> client = real2sim.connect_async()
        >>> scenario = await client.scenarios.create(scene="street", name="an example")
    """

    async def create(self, scene: SceneRef, name: str = "") -> AsyncScenario:
        """Create a new scenario of a scene, without edits.

        Raises:
            NotFoundError: no such scene.

        Examples:
            >>> scenario = await client.scenarios.create(scene="street", name="car in my lane")
            >>> scenario.revision, list(scenario.objects)
            (0, ['car_red', 'car_blue', 'post'])
        """
        info = await self._transport.send(_requests.create_scenario(scene_name(scene), name))
        # The reply to a creation omits trajectories; a handle always has them.
        return await AsyncScenario(self._transport, info).refresh()

    async def import_document(
        self, document: ScenarioDocument | Mapping[str, Any]
    ) -> AsyncScenario:
        """Create a scenario from the output of :meth:`AsyncScenario.export` of any worker.

        Examples:
            >>> document = await scenario.export()
            >>> copy = await client.scenarios.import_document(document)
            >>> copy.info.name, copy.scenario_id != scenario.scenario_id
            ('an example', True)
        """
        valid = ScenarioDocument.model_validate(document)
        info = await self._transport.send(_requests.import_scenario(valid))
        return await AsyncScenario(self._transport, info).refresh()

    async def get(self, scenario_id: str) -> AsyncScenario:
        """A handle of an existing scenario.

        Raises:
            NotFoundError: no such scenario.

        Examples:
            >>> (await client.scenarios.get(scenario.scenario_id)).info.name
            'an example'
        """
        info = await self._transport.send(_requests.get_scenario(scenario_id))
        return AsyncScenario(self._transport, info)

    async def list(self) -> Sequence[ScenarioInfo]:
        """All scenarios of the worker.

        Examples:
            >>> found = await client.scenarios.list()
            >>> scenario.scenario_id in [info.scenario_id for info in found]
            True
        """
        found = await self._transport.send(_requests.list_scenarios())
        return found.scenarios

    async def rename(self, scenario: ScenarioRef, name: str) -> ScenarioInfo:
        """Rename a scenario; its id and its history do not change.

        Examples:
            >>> (await client.scenarios.rename(scenario, "in the rain")).name
            'in the rain'
        """
        call = _requests.rename_scenario(scenario_id_of(scenario), name)
        return await self._transport.send(call)

    async def gallery(self) -> Sequence[CornerCaseInfo]:
        """Predefined corner cases, for :meth:`AsyncScenario.apply_corner_case`.

        Examples:
            >>> cases = {case.name: case for case in await client.scenarios.gallery()}
            >>> cases["cut_in"].title, cases["cut_in"].parameters["gap"]
            ('Cut-in: a car moves in from the left, close ahead', 12.0)
        """
        return (await self._transport.send(_requests.gallery())).cases

    async def gallery_picture(self, name: str) -> bytes:
        """A top view of a corner case, as an SVG document.

        It shows the paths of the road users, and where they meet an ego that drives straight ahead
        (blue).

        Raises:
            NotFoundError: the gallery has no such case.

        Examples:
            >>> picture = await client.scenarios.gallery_picture("cut_in")
            >>> picture[:4]
            b'<svg'
        """
        return await self._transport.send(_requests.gallery_picture(name))

    async def delete(self, scenario: ScenarioRef) -> None:
        """Delete a scenario and its history.

        Examples:
            >>> await client.scenarios.delete(scenario)
        """
        await self._transport.send(_requests.delete_scenario(scenario_id_of(scenario)))


class AsyncScenario(ScenarioState, ScenarioEdits[Awaitable[OperationResult]]):
    """A scenario in its last fetched state.

    Examples:
        >>> client = real2sim.connect_async()
        >>> scenario = await client.scenarios.create(scene="street")
    """

    def __init__(self, transport: AsyncTransport, info: ScenarioInfo) -> None:
        super().__init__(info)
        self._transport = transport

    @property
    def objects(self) -> Objects[AsyncSceneObject]:
        """Handles of the objects, by id.

        Examples:
            >>> list(scenario.objects)
            ['car_red', 'car_blue', 'post']
            >>> result = await scenario.objects["car_red"].translate(y=3.2)
        """
        return Objects({o.object_id: AsyncSceneObject(self, o) for o in self.info.objects})

    async def apply(
        self, operations: Sequence[Operation | Mapping[str, Any]], *, dry_run: bool = False
    ) -> OperationResult:
        """Apply operations, all or none.

        Args:
            operations: models of ``real2sim_proto.operations``, or their fields.
            dry_run: check them and change nothing.

        Raises:
            ValueError: an invalid operation.
            StaleRevisionError: someone else edited first.
            InvalidOperationError: an unknown object, or an invalid result.

        Examples:
            >>> result = await scenario.apply(
            ...     [
            ...         {"op": "delete", "object_id": "post"},
            ...         {"op": "duplicate", "object_id": "car_red", "new_id": "second", "x": 8.0},
            ...     ]
            ... )
            >>> result.revision, result.created
            (1, ['second'])
        """
        call = _requests.apply_operations(self.scenario_id, operations, self._etag, dry_run)
        return await self._applied(await self._transport.send(call))

    async def insert(
        self,
        asset: str,
        *,
        position: Vector,
        quaternion: Quaternion = UPRIGHT,
        size: Vector | None = None,
        object_id: str | None = None,
        snap: bool = True,
    ) -> AsyncSceneObject:
        """Add an object from the asset library, and return its handle.

        Args:
            asset: id in the library.
            position, quaternion: pose of its box, for the whole time range.
            size: box size to fit [m]; default: the asset's own.
            object_id: default: the asset's id with a number.
            snap: place it on the ground, regardless of z.

        Raises:
            InvalidOperationError: no such asset.

        Examples:
            >>> asset = await client.assets.cut(scene="street", object_id="car_red")
            >>> parked = await scenario.insert("car_red", position=(20.0, 3.0, 0.0))
            >>> parked.object_id, parked.info.category
            ('car_red_1', 'car')
            >>> await client.scenarios.delete(scenario)
            >>> await client.assets.delete("car_red")
        """
        operation = insertion(
            asset,
            position=position,
            quaternion=quaternion,
            size=size,
            object_id=object_id,
            snap=snap,
        )
        result = await self.apply([operation])
        return self.objects[result.created[0]]

    async def apply_corner_case(self, name: str, **parameters: float) -> OperationResult:
        """Apply a corner case of the gallery to sessions of the scenario.

        Args:
            name: name in the gallery, see :meth:`AsyncScenarios.gallery`.
            parameters: values that replace the defaults [m], [m/s], [s].

        Raises:
            InvalidRequestError: no such case or parameter.

        Examples:
            >>> result = await scenario.apply_corner_case("cut_in", gap=6.0)
            >>> scenario.storyboard.parameters["gap"]
            6.0
        """
        call = _requests.apply_corner_case(self.scenario_id, name, parameters, self._etag)
        return await self._applied(await self._transport.send(call))

    async def read_xosc(
        self,
        path: str | os.PathLike[str],
        *,
        leave_out: Sequence[str] = (),
        ego: str | None = None,
        strict: bool = False,
    ) -> StoryboardResult:
        """Use an OpenSCENARIO file as the storyboard of the scenario's sessions.

        Its roads are aligned with the recorded drive, so the ego starts where it was recorded.

        Args:
            path: a file of version 1.0 to 1.3, without catalogs.
            leave_out: names of unsupported elements to ignore.
            ego: entity that is the ego; default: ``Ego``.
            strict: refuse elements that have no effect, instead of listing them in ``notes``.

        Raises:
            InvalidRequestError: not a valid scenario, or an unsupported element, with its name and
                line.

        Examples:
            >>> result = await scenario.apply_corner_case("ccrb")
            >>> path = await scenario.write_xosc(folder / "ccrb.xosc")
            >>> result = await scenario.read_xosc(path)
            >>> result.notes, len(scenario.storyboard.entities)
            ([], 2)
        """
        content = await run_blocking(Path(path).read_bytes)
        call = _requests.read_xosc(
            self.scenario_id, content, leave_out, ego, self._etag, strict=strict
        )
        result = await self._transport.send(call)
        await self._applied(result)
        return result

    async def write_xosc(self, path: str | os.PathLike[str]) -> Path:
        """Write the scenario's storyboard as an OpenSCENARIO 1.3 file.

        Raises:
            InvalidRequestError: the scenario has no storyboard, or OpenSCENARIO cannot express it.

        Examples:
            >>> result = await scenario.apply_corner_case("cut_in")
            >>> path = await scenario.write_xosc(folder / "cut_in.xosc")
            >>> path.read_bytes()[:5]
            b'<?xml'
        """
        content = await self._transport.send(_requests.write_xosc(self.scenario_id))
        await run_blocking(write_atomically, Path(path), content)
        return Path(path)

    async def simulate(
        self,
        *,
        start_us: int | None = None,
        end_us: int | None = None,
        frame_us: int = 50_000,
        objects: Sequence[str] | None = None,
        preset: str | None = None,
        physics: Mapping[str, Mapping[str, Any] | PhysicsValues] | None = None,
        gravity: tuple[float, float, float] | None = None,
        max_particles: int | None = None,
        experiment: str | None = None,
        speed: float | None = None,
        backend: str = "auto",
        background: bool | None = None,
    ) -> AsyncJob:
        """Start a physics rollout of the scenario's current revision.

        Args:
            start_us, end_us: default: the scenario's span.
            frame_us: time between stored frames.
            objects: objects that the physics moves; default: those with their own velocity or
                physics. ``ego`` is the recording vehicle.
            preset: how objects become bodies: ``vehicle`` (default) or ``paper`` (default of the
                paper's experiments).
            physics: values as in ``set_physics``, by object or ``"*"`` for all; for this rollout.
            gravity: [m/s^2]; default: 9.81 downwards.
            max_particles: maximum for all bodies together.
            experiment: ``wall``, ``pair``, ``drop`` of the paper, ``frontal``, ``t_bone``, ``pole``
                or ``roof``.
            speed: speed of an experiment [m/s].
            backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.
            background: whether objects collide with walls, poles and trees of the scene; default:
                true. The job's ``figures.background`` reports it.

        Raises:
            ValueError: an invalid field.

        Examples:
            >>> post = scenario.objects["post"]
            >>> result = await post.translate(z=0.3)
            >>> result = await post.set_physics(material="rigid", mass=30.0)
            >>> job = await scenario.simulate(end_us=200_000, objects=["post"])
            >>> job = await job.wait(timeout=240.0)
            >>> job.info.kind, "post" in job.result["objects"]
            ('simulate', True)
        """
        body = checked(
            SimulateRequest,
            start_us=start_us,
            end_us=end_us,
            frame_us=frame_us,
            objects=None if objects is None else list(objects),
            preset=preset,
            physics=dict(physics or {}),
            gravity=gravity,
            max_particles=max_particles,
            experiment=experiment,
            speed=speed,
            backend=backend,
            background=background,
        )
        info = await self._transport.send(_requests.simulate(self.scenario_id, body))
        return AsyncJob(self._transport, info)

    async def calibrate(
        self,
        object_id: str,
        *,
        parameters: Sequence[str],
        observations: Mapping[str, Any] | Observations,
        simulate: Mapping[str, Any] | SimulateRequest | None = None,
        steps: int = 12,
    ) -> AsyncJob:
        """Start fitting physics parameters of an object to observations of it.

        Args:
            object_id: the object.
            parameters: any of ``stiffness``, ``yield_stress``, ``viscosity``, ``friction`` and
                ``speed``: factors on the initial values.
            observations: ``boxes``, ``points``, ``images``, or ``recorded`` for its own track.
            simulate: the simulation with its initial values, as in :meth:`simulate`.
            steps: maximum number of search steps.

        Raises:
            ValueError: an invalid field.

        Examples:
            >>> places = [{"t_us": t, "position": (20.0, 0.0, 0.8)} for t in (100_000, 200_000)]
            >>> job = await scenario.calibrate(
            ...     "car_red", parameters=["speed"], observations={"boxes": places}
            ... )
            >>> job.info.kind
            'calibrate'
            >>> job = await job.cancel()
        """
        body = checked(
            CalibrateRequest,
            object_id=object_id,
            parameters=list(parameters),
            observations=observations,
            simulate=simulate or {},
            steps=steps,
        )
        info = await self._transport.send(_requests.calibrate(self.scenario_id, body))
        return AsyncJob(self._transport, info)

    async def fork(self, *, name: str | None = None, revision: int | None = None) -> AsyncScenario:
        """Create a scenario with the same history, up to a revision.

        Examples:
            >>> result = await scenario.remove("post")
            >>> before = await scenario.fork(name="with the post", revision=0)
            >>> "post" in before.objects, "post" in scenario.objects
            (True, False)
        """
        call = _requests.fork_scenario(self.scenario_id, name, revision)
        return await AsyncScenario(self._transport, await self._transport.send(call)).refresh()

    async def export(self) -> ScenarioDocument:
        """Export the whole scenario as one document; ``model_dump_json()`` converts it to a file.

        Examples:
            >>> result = await scenario.remove("post")
            >>> document = await scenario.export()
            >>> [operation.op for operation in document.entries[0].operations]
            ['delete']
        """
        return await self._transport.send(_requests.export_scenario(self.scenario_id))

    async def points(
        self,
        path: str | os.PathLike[str],
        *,
        t: float | None = None,
        t_us: int | None = None,
        part: str = "all",
    ) -> Path:
        """Write the centres of the Gaussians as a ply with colour, normal, class and instance.

        Args:
            path: path of the ply file.
            t, t_us: time in seconds or in microseconds; default: the start.
            part: ``all``, ``background`` or ``objects``.

        Examples:
            >>> path = await scenario.points(folder / "objects.ply", part="objects")
            >>> path.read_bytes()[:3]
            b'ply'
        """
        call = _requests.scenario_points(self.scenario_id, instant_us(t, t_us), part)
        content = await self._transport.send(call)
        await run_blocking(write_atomically, Path(path), content)
        return Path(path)

    async def splats(
        self,
        object_id: str,
        *,
        t: float | None = None,
        t_us: int | None = None,
        up_axis: str = "y",
    ) -> bytes:
        """The current Gaussians of an object as an spz file (version 3), in the frame of its box,
        sorted by decreasing coverage.

        Args:
            object_id: object of the scenario.
            t, t_us: time that sets the pose of a walking person, in seconds or in microseconds;
                default: the start.
            up_axis: axis that points up in the file: ``y`` as in all spz files, ``z`` for the axes
                of the box, or ``-y``.

        Raises:
            NotFoundError: no such object.

        Examples:
            >>> import gzip
            >>> gzip.decompress(await scenario.splats("post"))[:4]
            b'NGSP'
        """
        instant = instant_us(t, t_us)
        call = _requests.object_splats(self.scenario_id, object_id, instant, up_axis)
        return await self._transport.send(call)

    async def undo(self, count: int = 1) -> OperationResult:
        """Undo the newest edit, or the newest ``count`` edits.

        Raises:
            ConflictError: there is nothing to undo.

        Examples:
            >>> result = await scenario.remove("post")
            >>> result = await scenario.undo()
            >>> "post" in scenario.objects, scenario.info.can_redo
            (True, True)
        """
        return await self._repeated(_requests.undo, count)

    async def redo(self, count: int = 1) -> OperationResult:
        """Redo the edit that was undone last, or the last ``count`` edits.

        Raises:
            ConflictError: there is nothing to redo.

        Examples:
            >>> result = await scenario.remove("post")
            >>> result = await scenario.undo()
            >>> result = await scenario.redo()
            >>> "post" in scenario.objects
            False
        """
        return await self._repeated(_requests.redo, count)

    async def history(self, *, after: int | None = None) -> History:
        """Edits, undos and redos after a revision, oldest first; default: all.

        Examples:
            >>> result = await scenario.remove("post")
            >>> result = await scenario.undo()
            >>> [(entry.revision, entry.kind) for entry in (await scenario.history()).entries]
            [(1, 'edit'), (2, 'undo')]
        """
        return await self._transport.send(_requests.history(self.scenario_id, after))

    async def refresh(self) -> AsyncScenario:
        """Fetch the current state of the scenario; returns itself.

        Examples:
            >>> theirs = await client.scenarios.get(scenario.scenario_id)
            >>> result = await theirs.remove("post")
            >>> list((await scenario.refresh()).objects)
            ['car_red', 'car_blue']
        """
        self._update(await self._transport.send(_requests.get_scenario(self.scenario_id)))
        return self

    async def preview(
        self,
        camera: str,
        *,
        t: float | None = None,
        t_us: int | None = None,
        width: int | None = None,
        modality: str = "rgb",
        codec: str = "auto",
    ) -> Image:
        """A preview image of a recorded camera; arguments as in :meth:`AsyncScenes.render`.

        Examples:
            >>> image = await scenario.preview(camera="front", codec="jpeg")
            >>> image.save(folder / "after.jpg").name
            'after.jpg'
        """
        codec = self._transport.target.image_codec(codec, modality)
        view = ViewRequest(camera, instant_us(t, t_us), width, modality, codec)
        return await self._transport.send(_requests.preview(self.scenario_id, view))

    async def sweep(
        self, lidar: str, *, t: float | None = None, t_us: int | None = None
    ) -> LidarCloud:
        """Simulate one sweep of a LiDAR on the recording vehicle.

        Args:
            lidar: name in the worker's catalogue.
            t, t_us: time of the last ray, in seconds or in microseconds; default: start of the
                scenario.

        Raises:
            InvalidRequestError: no such LiDAR, or a time outside the recording.

        Examples:
            >>> cloud = await scenario.sweep(lidar="vlp-16")
            >>> cloud.modality, cloud.t_us
            ('lidar', 0)
        """
        call = _requests.sweep(self.scenario_id, lidar, instant_us(t, t_us))
        return await self._transport.send(call)

    def _edit(self, operation: Operation) -> Awaitable[OperationResult]:
        return self.apply([operation])

    async def _repeated(
        self, request: Callable[[str, str], Call[OperationResult]], count: int
    ) -> OperationResult:
        if count < 1:
            raise ValueError(f"count is {count!r}; give a number of edits, 1 or more")
        for _ in range(count):
            call = request(self.scenario_id, self._etag)
            result = await self._applied(await self._transport.send(call))
        return result

    async def _applied(self, result: OperationResult) -> OperationResult:
        self._record(result)
        if not result.dry_run:
            await self.refresh()
        return result


class AsyncSceneObject(ObjectEdits[Awaitable[OperationResult]]):
    """An object of a scenario; each method is one edit. Metres, radians, wxyz.

    Examples:
        >>> client = real2sim.connect_async()
        >>> scenario = await client.scenarios.create(scene="street")
        >>> car = scenario.objects["car_red"]
    """

    def __init__(self, scenario: AsyncScenario, info: ObjectInfo) -> None:
        super().__init__(scenario, info)
        self._scenario: AsyncScenario = scenario

    async def duplicate(
        self,
        *,
        new_id: str | None = None,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        frame: str = "world",
        snap: bool = False,
    ) -> AsyncSceneObject:
        """Add a copy, shifted [m], and return its handle; ``snap`` places it on the ground.

        Examples:
            >>> copy = await car.duplicate(x=9.0)
            >>> copy.object_id
            'car_red_copy1'
        """
        result = await self._scenario.apply([self._duplicate(new_id, (x, y, z), frame, snap)])
        return self._scenario.objects[result.created[0]]

    def _edit(self, operation: Operation) -> Awaitable[OperationResult]:
        return self._scenario.apply([operation])
