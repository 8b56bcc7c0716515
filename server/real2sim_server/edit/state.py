"""State of a scenario at one revision: objects without their Gaussians, and its snapshots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from real2sim_proto import CodecError, ErrorCode, decode, encode
from real2sim_proto.episode import AgentDriver
from real2sim_proto.operations import AddCollider, EraseRegion, SetGait, SetPhysics, SetVelocity
from real2sim_proto.storyboard import Storyboard

from ..scene import Coverage, Figure, GaussianCloud, Ground, Scene, Trajectory
from .tracks import PackedTracks


class ObjectSource(Protocol):
    """Required properties of a scene object, without its Gaussians."""

    @property
    def object_id(self) -> str: ...  # noqa: D102
    @property
    def category(self) -> str: ...  # noqa: D102
    @property
    def size(self) -> tuple[float, float, float]: ...  # noqa: D102
    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102


class AssetSource(Protocol):
    """The properties of an asset that objects need."""

    @property
    def asset_id(self) -> str: ...  # noqa: D102
    @property
    def category(self) -> str: ...  # noqa: D102
    @property
    def size(self) -> tuple[float, float, float]: ...  # noqa: D102
    @property
    def gaussians(self) -> int: ...  # noqa: D102
    @property
    def figure(self) -> Figure | None: ...  # noqa: D102

    def cloud_in(self, scene: Scene) -> GaussianCloud:
        """The asset's Gaussians, adapted to the light of ``scene``."""
        ...


AssetLookup = Callable[[str], "AssetSource | None"]
"""The asset with an id; assets are immutable, so logs can be replayed."""


class SceneSource(Protocol):
    """Required properties of a scene; a Scene, or a summary of a scene that is not in memory."""

    @property
    def objects(self) -> Mapping[str, ObjectSource] | Iterable[ObjectSource]: ...  # noqa: D102
    @property
    def ego(self) -> Trajectory: ...  # noqa: D102
    @property
    def ground(self) -> Ground: ...  # noqa: D102
    @property
    def coverage(self) -> Coverage | None: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class ObjectState:
    """One object of a scenario.

    Attributes:
        object_id: unique in the scenario, also among deleted objects.
        source_id: scene object with its Gaussians; empty if it shows an asset.
        category: category in the scene.
        size: (length, width, height) in the scene, before ``scale`` [m].
        scale: factors along the object's x, y, z, about its origin.
        trajectory: ``T_world_object``; origin at the box centre; exists only in its range.
        instance_id: value of its pixels in instance images; fixed while the object exists.
        deleted: whether it is a tombstone: invisible, without collisions, id still reserved.
        asset: asset shown instead of a scene object.
        physics: physical properties; None for all defaults.
        velocity: initial velocity in the physics; None for the trajectory's.
        gait: walking style; None if no edit has set it.
        edited: whether an edit set its trajectory or its appearance.
        driver: driver model in sessions; None if sessions decide.
    """

    object_id: str
    source_id: str
    category: str
    size: tuple[float, float, float]
    scale: tuple[float, float, float]
    trajectory: Trajectory
    instance_id: int
    deleted: bool = False
    asset: AssetSource | None = None
    physics: SetPhysics | None = None
    velocity: SetVelocity | None = None
    gait: SetGait | None = None
    edited: bool = False
    driver: AgentDriver | None = None

    @property
    def scaled_size(self) -> tuple[float, float, float]:
        """Current (length, width, height) of the box [m]."""
        (length, width, height), (x, y, z) = self.size, self.scale
        return (length * x, width * y, height * z)

    @cached_property
    def radius(self) -> float:
        """Half the diagonal of the box [m]."""
        diagonal: float = sum(side * side for side in self.scaled_size) ** 0.5
        return diagonal / 2

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """[2, 3] lowest and highest point that the box can reach along its trajectory [m]."""
        positions = self.trajectory.positions
        low, high = positions.min(axis=0) - self.radius, positions.max(axis=0) + self.radius
        return np.stack([low, high])

    @cached_property
    def standing(self) -> bool:
        """Whether all its poses are the same."""
        p, q = self.trajectory.positions, self.trajectory.quaternions
        return bool((p == p[0]).all() and (q == q[0]).all())


@dataclass(frozen=True, eq=False)
class ScenarioState:
    """All objects of a scenario at one revision. Immutable; edits create states that share parts.

    Attributes:
        objects: objects by id in a stable order: scene objects, then copies by creation.
        next_instance_id: instance id of the next new object.
        time_range: first and last time of the scene's clock [us].
        clock: first and last time of the scenario, within ``time_range`` [us].
        regions: boxes erased from the background, by id, including deleted ones.
        colliders: colliders by id, including deleted ones.
        tombstones: ids of deleted regions and colliders.
        storyboard: default storyboard of episodes, or None.
        recorded: objects of the scene, by id.
        ground: ground of the scene.
        coverage: what images saw of the scene; None if unknown.
        assets: the asset library, or None.
        extent: [2, 2] lowest and highest x, y that the ego or an object reaches in the scene [m].
    """

    objects: Mapping[str, ObjectState]
    next_instance_id: int
    time_range: tuple[int, int]
    recorded: Mapping[str, ObjectState] = field(repr=False)
    extent: NDArray[np.float64] = field(repr=False)
    clock: tuple[int, int]
    ground: Ground = field(repr=False)
    coverage: Coverage | None = field(default=None, repr=False)
    assets: AssetLookup | None = field(default=None, repr=False)
    regions: Mapping[str, EraseRegion] = field(default_factory=dict)
    colliders: Mapping[str, AddCollider] = field(default_factory=dict)
    tombstones: frozenset[str] = frozenset()
    storyboard: Storyboard | None = field(default=None, repr=False)

    @classmethod
    def of(cls, scene: SceneSource, *, assets: AssetLookup | None = None) -> ScenarioState:
        """The state of a scene before any edit."""
        given = scene.objects
        sources = list(given.values() if isinstance(given, Mapping) else given)
        objects = {
            o.object_id: ObjectState(
                object_id=o.object_id,
                source_id=o.object_id,
                category=o.category,
                size=o.size,
                scale=(1.0, 1.0, 1.0),
                trajectory=o.trajectory,
                instance_id=1 + i,
            )
            for i, o in enumerate(sources)
        }
        reached = np.concatenate([t.positions[:, :2] for t in _trajectories(scene, sources)])
        frozen = MappingProxyType(objects)
        return cls(
            objects=frozen,
            next_instance_id=1 + len(objects),
            time_range=(scene.ego.start_us, scene.ego.end_us),
            recorded=frozen,
            extent=np.stack([reached.min(axis=0), reached.max(axis=0)]),
            clock=(scene.ego.start_us, scene.ego.end_us),
            ground=scene.ground,
            coverage=scene.coverage,
            assets=assets,
        )

    def with_object(self, changed: ObjectState) -> ScenarioState:
        """The state with ``changed``, which replaces the object with its id or is appended."""
        objects = dict(self.objects)
        objects[changed.object_id] = changed
        return replace(
            self,
            objects=MappingProxyType(objects),
            next_instance_id=max(self.next_instance_id, changed.instance_id + 1),
        )

    def has_id(self, wanted: str) -> bool:
        """Whether an object, region or collider has this id, including deleted ones."""
        return wanted in self.objects or wanted in self.regions or wanted in self.colliders

    @property
    def erased(self) -> tuple[EraseRegion, ...]:
        """Regions in effect, in order."""
        return tuple(r for i, r in self.regions.items() if i not in self.tombstones)

    @property
    def standing_colliders(self) -> tuple[AddCollider, ...]:
        """Colliders in effect, in order."""
        return tuple(c for i, c in self.colliders.items() if i not in self.tombstones)

    @property
    def visible(self) -> tuple[ObjectState, ...]:
        """Objects that are not deleted, in order."""
        return self.tracks.objects

    @cached_property
    def tracks(self) -> PackedTracks[ObjectState]:
        """Packed trajectories of the visible objects, for lookups at one instant; cached."""
        return PackedTracks(tuple(o for o in self.objects.values() if not o.deleted))

    def forget_tracks(self) -> None:
        """Free the packed tracks, about 100 bytes per pose; they are packed again on demand."""
        self.__dict__.pop("tracks", None)


def _trajectories(scene: SceneSource, sources: list[ObjectSource]) -> list[Trajectory]:
    return [scene.ego, *(o.trajectory for o in sources)]


# --- Errors --------------------------------------------------------------------------------------


class EditError(ValueError):
    """An impossible edit, undo or redo; the state does not change.

    Attributes:
        code: UNKNOWN_OBJECT, INVALID_OPERATION, STALE_REVISION, NOTHING_TO_UNDO or
            NOTHING_TO_REDO.
        hint: suggested next step, or None.
        index: index of the rejected operation in its batch, or None.
    """

    def __init__(
        self, code: ErrorCode, message: str, *, hint: str | None = None, index: int | None = None
    ) -> None:
        super().__init__(message)
        self.code = code
        self.hint = hint
        self.index = index


# --- Snapshots -----------------------------------------------------------------------------------

# Exact serialisation of states; long logs are then replayed only from a snapshot on.

MAX_BYTES = 256 * 1024 * 1024
_DRIVER: TypeAdapter[AgentDriver] = TypeAdapter(AgentDriver)


def pack_state(state: ScenarioState) -> bytes:
    """Differences from the recording, as msgpack; the recording itself is not included."""
    changed = [o for o in state.objects.values() if state.recorded.get(o.object_id) is not o]
    story = {} if (board := state.storyboard) is None else {"story": board.model_dump(mode="json")}
    return encode(
        {
            "objects": [_packed_object(o) for o in changed],
            "next_instance_id": state.next_instance_id,
            "clock": list(state.clock),
            "regions": [r.model_dump(mode="json") for r in state.regions.values()],
            "colliders": [c.model_dump(mode="json") for c in state.colliders.values()],
            "gone": sorted(state.tombstones),
        }
        | story
    )


def unpack_state(initial: ScenarioState, packed: bytes) -> ScenarioState:
    """The state packed by :func:`pack_state`.

    Args:
        initial: state of the same scene before any edit.
        packed: the bytes.

    Raises:
        EditError: UNKNOWN_ASSET if an object shows an asset missing in the library;
            INVALID_OPERATION if the bytes are not a state of this scene.
    """
    try:
        document = decode(packed, max_bytes=MAX_BYTES)
        found = [_unpacked_object(o, initial.assets) for o in document["objects"]]
        first, last = document["clock"]
        regions = [EraseRegion.model_validate(r) for r in document["regions"]]
        colliders = [AddCollider.model_validate(c) for c in document["colliders"]]
        story = document.get("story")
        board = None if story is None else Storyboard.model_validate(story)
        tombstones, next_instance_id = frozenset(document["gone"]), document["next_instance_id"]
    except (CodecError, KeyError, TypeError, ValueError) as error:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"these bytes hold no state: {error}",
            hint="replay the whole log instead",
        ) from error
    return replace(
        initial,
        objects=MappingProxyType(dict(initial.objects) | {o.object_id: o for o in found}),
        next_instance_id=next_instance_id,
        clock=(first, last),
        regions=MappingProxyType({str(r.region_id): r for r in regions}),
        colliders=MappingProxyType({str(c.collider_id): c for c in colliders}),
        tombstones=tombstones,
        storyboard=board,
    )


def _packed_object(subject: ObjectState) -> dict[str, Any]:
    driver = {"driver": subject.driver.model_dump(mode="json")} if subject.driver else {}
    gait = {"gait": subject.gait.model_dump(mode="json")} if subject.gait else {}
    return (
        driver
        | gait
        | {
            "object_id": subject.object_id,
            "source_id": subject.source_id,
            "category": subject.category,
            "size": list(subject.size),
            "scale": list(subject.scale),
            "times_us": subject.trajectory.times_us,
            "positions": subject.trajectory.positions,
            "quaternions": subject.trajectory.quaternions,
            "instance_id": subject.instance_id,
            "deleted": subject.deleted,
            "asset_id": subject.asset.asset_id if subject.asset else None,
            "physics": subject.physics.model_dump(mode="json") if subject.physics else None,
            "velocity": subject.velocity.model_dump(mode="json") if subject.velocity else None,
            "placed": subject.edited,
        }
    )


def _unpacked_object(packed: dict[str, Any], assets: AssetLookup | None) -> ObjectState:
    asset_id = packed["asset_id"]
    asset = assets(asset_id) if assets and asset_id is not None else None
    if asset is None and asset_id is not None:
        raise EditError(
            ErrorCode.UNKNOWN_ASSET,
            f"there is no asset {asset_id!r} in the library",
            hint="put it back",
        )
    physics, velocity = packed["physics"], packed["velocity"]
    length, width, height = packed["size"]
    x, y, z = packed["scale"]
    return ObjectState(
        object_id=packed["object_id"],
        source_id=packed["source_id"],
        category=packed["category"],
        size=(length, width, height),
        scale=(x, y, z),
        trajectory=Trajectory(packed["times_us"], packed["positions"], packed["quaternions"]),
        instance_id=packed["instance_id"],
        deleted=packed["deleted"],
        asset=asset,
        physics=SetPhysics.model_validate(physics) if physics else None,
        velocity=SetVelocity.model_validate(velocity) if velocity else None,
        gait=SetGait.model_validate(packed["gait"]) if "gait" in packed else None,
        edited=packed["placed"],
        driver=_DRIVER.validate_python(packed["driver"]) if "driver" in packed else None,
    )
