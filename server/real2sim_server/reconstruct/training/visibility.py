"""Visibility and viewing directions of Gaussians, and treatment of unseen ones."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...render import Instance, RasterOptions, rasterize
from ...scene import Camera, Scene, Sky
from ...scene.cloud import SH_C0
from ..initialise.vehicle_body import GRAZING, VehicleBody, body_colours
from .densify import DensifyOptions, SelectiveAdam, VisibilityLimits, prune, rotation_matrices
from .gaussians import Gaussians, concatenate
from .model import SceneModel

# Visibility.
#
# A Gaussian behind a surface gets gradients only through thin gaps in that surface, and Adam takes
# full steps along them: the Gaussian becomes a floater that a turned or moved object reveals.
# Floaters are barely visible and far behind the surface. The layers of a surface are also barely
# visible, but close together. Floaters are pruned. The priors of stage 0 for unobserved places
# (mirrored sides, body colours, ground under cars) replace them while the surfaces in front finish
# learning and close up.

NEAR = 0.2
"""Gaussians nearer to the camera are not counted [m]."""
FAINT_LOGIT = -3.0
"""Logit of an opacity that occludes almost nothing but is well above the blending cutoff."""
PRIOR_FRACTION = 0.01
"""Priors are inserted up to this visible fraction behind the trained scene. A higher value degrades
the logged views, a lower one leaves holes in sides that become visible when an object turns.
"""
SKY_FRACTION = 0.1
"""A texel of the sky counts as hidden up to this visible fraction."""
ON_GROUND = 0.05
"""Gaussians of stage 0 within this distance of the ground surface are ground [m]."""
SHOWN_FRACTION = 0.05
"""Trained Gaussians with a larger visible fraction are evidence of the ground's appearance."""
BARE_REACH = 2.5
"""Reach of this evidence around a ground Gaussian, in its standard deviations."""
HARDLY_SEEN = 25.0
"""Vehicles with fewer visible pixels per image on average are not learnt from images [px]."""
VISIBILITY_VIEWS = 64
"""Number of views that decide which Gaussians are hidden."""
EPS2D = RasterOptions().eps2d

Viewpoint = tuple[Camera, int]
"""A camera at the size of its training images, and the time of its image [us]."""


@dataclass(frozen=True, eq=False)
class GaussianVisibility:
    """Visibility of N Gaussians in a set of views, and their depth behind the visible surface.

    Attributes:
        fractions: [N] float32, the sum of a Gaussian's blending weights over all pixels, divided by
            its unoccluded sum over the whole image plane; 0 if it is never in front of a camera.
        depths: [N] float32, mean distance from the visible surface back to the Gaussian's centre,
            weighted by blending weight [m]; negative in front of it, 0 if no pixel shows it.
        pixels: [N] float32, sum of blending weights over all pixels, per view [px].
    """

    fractions: Tensor
    depths: Tensor
    pixels: Tensor

    def hidden(self, limits: VisibilityLimits) -> Tensor:
        """[N] bool."""
        occluded = (self.depths > limits.occluded_depth) & (
            self.fractions <= limits.occluded_fraction
        )
        return (self.fractions <= limits.fraction) | occluded


@torch.no_grad()
def visibility(model: SceneModel, viewpoints: Sequence[Viewpoint]) -> GaussianVisibility:
    """Visibility of each Gaussian of ``model`` in ``viewpoints``.

    Where training mirrors vehicles, both sides count: the part hidden on one side is learnt on the
    other. Every second view also shows them mirrored.
    """
    gaussians = model.gaussians
    starts = gaussians.starts
    visible, unoccluded, depth_sums = (
        torch.zeros(len(gaussians), device=model.device) for _ in range(3)
    )
    flips = [(), model.mirrored] if any(model.mirrored) else [()]
    sides = [gaussians.clouds(degree=0, mirrored=mirrored) for mirrored in flips]
    shown = [(view, side) for k, view in enumerate(viewpoints) for side in sides[: 2 - k % 2]]
    for (camera, t_us), clouds in shown:
        viewmat = model.viewmat(camera, t_us).detach()
        instances, drawn = model.instances(clouds, t_us)
        weights = blending_weights(instances, viewmat, camera, model)
        for index, instance, (weight, inverse) in zip(drawn, instances, weights, strict=True):
            rows = slice(starts[index], starts[index + 1])
            alone = unoccluded_weights(instance, viewmat, camera)
            surface = weight / inverse.clamp(min=1e-9)
            counted = torch.where(alone > 0, weight, 0)
            visible[rows] += counted
            unoccluded[rows] += alone
            depth_sums[rows] += counted * (_depths(instance, viewmat) - surface)
    return GaussianVisibility(
        visible / unoccluded.clamp(min=1e-9),
        depth_sums / visible.clamp(min=1e-9),
        visible / max(1, len(viewpoints)),
    )


def blending_weights(
    instances: list[Instance], viewmat: Tensor, camera: Camera, model: SceneModel
) -> list[tuple[Tensor, Tensor]]:
    """Per instance: sums [N] over pixels of each Gaussian's blending weight, and of weight by
    depth.

    Units are [px] and [px/m]. A pixel's depth is the depth of its visible surface. An image is
    linear in the constant colours, so the sums are the gradients of two channels' sums with respect
    to these colours.
    """
    colours, coloured = [], []
    for item in instances:
        colour = torch.zeros(len(item.cloud), 1, 3, device=model.device, requires_grad=True)
        colours.append(colour)
        coloured.append(replace(item, cloud=replace(item.cloud, sh=colour)))
    with torch.enable_grad():
        output = rasterize(
            coloured,
            viewmat[None],
            camera.K[None],
            camera.width,
            camera.height,
            options=RasterOptions(depth=True, instance=False),
            backend=model.backend,
        )
        assert output.depth is not None
        depth = output.depth.detach()
        inverse = torch.where(depth > NEAR, 1 / depth, 0)
        torch.autograd.backward(output.rgb[..., 0].sum() + (output.rgb[..., 1] * inverse).sum())
    sums = [torch.zeros_like(c[:, 0]) if c.grad is None else c.grad[:, 0] / SH_C0 for c in colours]
    return [(s[:, 0], s[:, 1]) for s in sums]


def unoccluded_weights(instance: Instance, viewmat: Tensor, camera: Camera) -> Tensor:
    """Integral of each Gaussian's opacity over the image plane, [N] [px].

    0 for Gaussians with their centre outside the image.
    """
    to_camera = camera_from_object(instance, viewmat)
    rotation, cloud = to_camera[:3, :3], instance.cloud
    x, y, z = (cloud.means @ rotation.T + to_camera[:3, 3]).unbind(-1)
    ahead = z > NEAR
    z = z.clamp(min=NEAR)
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u, v = fx * x / z + cx, fy * y / z + cy
    inside = ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    axes = (rotation @ rotation_matrices(cloud.quats)) * cloud.scales[:, None]
    across = (fx / z)[:, None] * (axes[:, 0] - (x / z)[:, None] * axes[:, 2])
    down = (fy / z)[:, None] * (axes[:, 1] - (y / z)[:, None] * axes[:, 2])
    a, c = across.square().sum(-1) + EPS2D, down.square().sum(-1) + EPS2D
    b = (across * down).sum(-1)
    area = 2 * math.pi * (a * c - b * b).clamp(min=0).sqrt()
    return torch.where(inside, area * cloud.opacities, 0)


@torch.no_grad()
def hidden_sky(model: SceneModel, viewpoints: Iterable[Viewpoint]) -> Tensor:
    """Texels of the sky that are almost invisible in every view, [6, R, R] bool."""
    visible, unoccluded = (torch.zeros_like(model.sky) for _ in range(2))
    clouds = model.gaussians.clouds(degree=0)
    for camera, t_us in viewpoints:
        viewmat = model.viewmat(camera, t_us).detach()
        instances, _ = model.instances(clouds, t_us)
        for drawn, total in ((instances, visible), ([], unoccluded)):
            faces = torch.zeros_like(model.sky).requires_grad_()
            with torch.enable_grad():
                image = rasterize(
                    drawn,
                    viewmat[None],
                    camera.K[None],
                    camera.width,
                    camera.height,
                    sky=Sky(faces),
                    options=RasterOptions(depth=False, instance=False),
                    backend=model.backend,
                ).rgb
                torch.autograd.backward(image.sum())
            assert faces.grad is not None
            total.add_(faces.grad)
    return visible.sum(-1) <= SKY_FRACTION * unoccluded.sum(-1)


def _depths(instance: Instance, viewmat: Tensor) -> Tensor:
    """[N] of the centres along the optical axis [m]."""
    to_camera = camera_from_object(instance, viewmat)
    return instance.cloud.means @ to_camera[2, :3] + to_camera[2, 3]


def camera_from_object(instance: Instance, viewmat: Tensor) -> Tensor:
    """``T_camera_object`` [4, 4] float32."""
    device = instance.cloud.device
    pose = torch.eye(4, dtype=torch.float64, device=device)
    if instance.T_world_object is not None:
        pose = torch.as_tensor(instance.T_world_object, dtype=torch.float64, device=device).detach()
    return (viewmat.to(device).double() @ pose).float()


def prune_hidden(
    gaussians: Gaussians,
    optimizer: SelectiveAdam,
    seen: GaussianVisibility,
    *,
    background_limits: VisibilityLimits,
    object_limits: VisibilityLimits,
    besides: Tensor | None = None,
) -> Gaussians:
    """Remove Gaussians that are almost invisible, or barely visible and deep behind the surface.

    Args:
        besides: [N] bool, additional Gaussians to remove.
    """
    hidden = torch.where(
        gaussians.owners > 0, seen.hidden(object_limits), seen.hidden(background_limits)
    )
    return prune(gaussians, optimizer, hidden if besides is None else hidden | besides)


@torch.no_grad()
def behind_objects(model: SceneModel, seen: GaussianVisibility, limits: VisibilityLimits) -> Tensor:
    """[N] bool: hidden Gaussians of the background no higher above the ground than the objects."""
    count, ground = model.gaussians.counts[0], model.scene.stored_ground
    found = torch.zeros(len(model.gaussians), dtype=torch.bool, device=model.device)
    if ground is None or not len(model.half_sizes):
        return found
    places = model.gaussians.means[:count].cpu().numpy().astype(np.float64)
    height = places[:, 2] - ground.height_at(places[:, :2])
    low = ground.covers(places[:, :2]) & (height < 2 * float(model.half_sizes[:, 2].max()))
    found[:count] = torch.from_numpy(low).to(found.device) & seen.hidden(limits)[:count]
    return found


def hardly_seen(model: SceneModel, seen: GaussianVisibility, offered: OfferedPriors) -> Tensor:
    """[1 + objects] bool: objects with an available body that images barely show.

    A few pixels are too little evidence to learn a vehicle.
    """
    owners = torch.arange(len(model.gaussians.counts), device=seen.pixels.device)
    shown = torch.zeros(len(owners), device=seen.pixels.device)
    shown.index_add_(0, model.gaussians.owners.to(shown.device), seen.pixels)
    found = shown < HARDLY_SEEN
    found[0] = False
    counts = [
        len(offered.scene.background),
        *(len(o.cloud) for o in offered.scene.objects.values()),
    ]
    if offered.alternatives is None:
        return torch.zeros_like(found)
    is_body = [bool((part >= 0).any()) for part in offered.alternatives.split(counts)]
    return found & torch.tensor(is_body, device=found.device)


@dataclass(frozen=True, eq=False)
class OfferedPriors:
    """Priors for regions that no image shows.

    Attributes:
        scene: scene of stage 0, or with other clouds for its objects.
        alternatives: [N] int64 per Gaussian of ``scene``: of the Gaussians with the same number,
            only the first that fits is inserted. A negative number marks a Gaussian without
            alternatives. None: no Gaussian has alternatives.
        whole: [1 + objects] bool, objects that get all their priors, visible or not; None: none.
    """

    scene: Scene
    alternatives: Tensor | None = None
    whole: Tensor | None = None


def occluded_priors(
    model: SceneModel,
    first: SceneModel,
    viewpoints: list[Viewpoint],
    *,
    limit: float,
    wanted: Tensor | None = None,
    alternatives: Tensor | None = None,
    bare: Tensor | None = None,
) -> Gaussians:
    """Gaussians of stage 0 that ``model`` occludes. They are rendered but not trained.

    A background prior must also have been hidden in stage 0: if it was visible, training pruned it
    for a reason. Bare ground is exempt. Objects can be moved, so they get every prior that their
    trained Gaussians occlude.

    Args:
        model: trained.
        first: model of stage 0, with the same objects.
        viewpoints: training views.
        limit: a background Gaussian counts as hidden in stage 0 up to this visible fraction.
        wanted: [N] bool, Gaussians of ``first`` to insert even where they are visible.
        alternatives: numbers of the Gaussians of ``first``, see :class:`OfferedPriors`.
        bare: [N] bool, Gaussians of ``first`` that count as hidden in stage 0.
    """
    hidden = visibility(first, viewpoints).fractions <= limit
    if bare is not None:
        hidden |= bare
    offered = (hidden | (first.gaussians.owners > 0)).nonzero()[:, 0]
    priors, trained = first.gaussians.select(offered), model.gaussians
    # Almost transparent, so that priors behind the same gap do not occlude each other.
    faint = replace(priors, logits=torch.full_like(priors.logits, FAINT_LOGIT))
    model.gaussians, is_prior = concatenate(trained, faint)
    behind = visibility(model, viewpoints).fractions[is_prior] <= PRIOR_FRACTION
    model.gaussians = trained
    if wanted is not None:
        behind |= wanted[offered]
    taken = behind.nonzero()[:, 0]
    if alternatives is not None:
        taken = taken[_first_of_each(alternatives.to(offered)[offered[taken]])]
    return priors.select(taken)


@torch.no_grad()
def bare_ground(model: SceneModel, first: SceneModel, seen: GaussianVisibility) -> Tensor:
    """[N] bool, ground Gaussians of ``first`` near which images show no Gaussian of ``model``.

    Args:
        seen: visibility of ``model``.
    """
    from scipy.spatial import cKDTree

    ground, count = model.scene.stored_ground, first.gaussians.counts[0]
    bare = torch.zeros(len(first.gaussians), dtype=torch.bool, device=model.device)
    if ground is None:
        return bare
    places = first.gaussians.means[:count].cpu().numpy().astype(np.float64)
    on_ground = np.abs(places[:, 2] - ground.height_at(places[:, :2])) < ON_GROUND
    on_ground &= ground.covers(places[:, :2])
    mine = slice(0, model.gaussians.counts[0])
    shown = model.gaussians.means[mine][seen.fractions[mine] > SHOWN_FRACTION]
    if len(shown) and on_ground.any():
        distance, _ = cKDTree(shown.cpu().numpy()).query(places[on_ground])
        reach = first.gaussians.log_scales[:count].amax(1).exp().cpu().numpy()[on_ground]
        on_ground[on_ground] = distance > BARE_REACH * reach
    bare[:count] = torch.from_numpy(on_ground).to(bare.device)
    return bare


def _first_of_each(numbers: Tensor) -> Tensor:
    """[N] bool: numbers that are negative or the first of their value."""
    _, first = np.unique(numbers.cpu().numpy(), return_index=True)
    is_first = torch.zeros(len(numbers), dtype=torch.bool, device=numbers.device)
    is_first[torch.from_numpy(first).to(numbers.device)] = True
    return is_first | (numbers < 0)


class OcclusionPruning:
    """Prunes hidden Gaussians in two rounds and inserts the priors of stage 0 in the second.

    Args:
        options: schedule of the rounds and limits for hidden Gaussians.
        iterations: iterations of the whole training.
        sample: returns the given number of random training views.
        unseen: returns the Gaussians of a model on sides that no view shows, see
            :func:`unseen_sides`; None: no such sides.
        close: changes a model before its priors are selected and returns the changed objects, see
            :func:`.closed_vehicles.close_followed`; None: no change.
        offer: returns the available priors for these objects, see
            :func:`.closed_vehicles.offer_bodies`; None: the priors of stage 0.
    """

    def __init__(
        self,
        options: DensifyOptions,
        iterations: int,
        sample: Callable[[int], list[Viewpoint]],
        *,
        unseen: Callable[[SceneModel, list[Viewpoint]], Tensor] | None = None,
        close: Callable[[SceneModel, SelectiveAdam, list[Viewpoint]], list[bool]] | None = None,
        offer: Callable[[SceneModel, list[bool]], OfferedPriors] | None = None,
    ) -> None:
        self._options, self._sample = options, sample
        self._unseen, self._close, self._offer = unseen, close, offer
        self._hidden_round = round(options.hidden_round * iterations)
        self._prior_round = round(options.prior_round * iterations)

    def step(self, model: SceneModel, optimizer: SelectiveAdam, iteration: int) -> bool:
        """Change ``model`` after step ``iteration`` if a round is due; returns whether it was."""
        hidden_round = iteration + 1 == self._hidden_round
        prior_round = iteration + 1 == self._prior_round
        if hidden_round:
            viewpoints = self._sample(VISIBILITY_VIEWS)
            if self._close is not None:
                # Early enough to relearn the projected Gaussians, so that the next round moves
                # little.
                self._close(model, optimizer, viewpoints)
            model.gaussians = prune_hidden(
                model.gaussians,
                optimizer,
                visibility(model, viewpoints),
                background_limits=self._options.background_limits,
                object_limits=self._options.object_limits,
            )
        if prior_round:
            viewpoints = self._sample(VISIBILITY_VIEWS)
            if self._unseen is not None:
                sides = self._unseen(model, viewpoints)
                model.gaussians = prune(model.gaussians, optimizer, sides)
            offered = OfferedPriors(model.scene)
            if self._close is not None and self._offer is not None:
                offered = self._offer(model, self._close(model, optimizer, viewpoints))
                model.stop_mirroring()
            seen = visibility(model, viewpoints)
            # Priors first: they also belong behind the Gaussians that are pruned next.
            scarce = hardly_seen(model, seen, offered)
            offered = replace(offered, whole=scarce)
            self._insert_priors(model, optimizer, viewpoints, offered, seen)
            besides = behind_objects(model, seen, self._options.last_background_limits)
            model.gaussians = prune_hidden(
                model.gaussians,
                optimizer,
                seen,
                background_limits=self._options.background_limits,
                object_limits=self._options.last_object_limits,
                besides=besides | scarce[model.gaussians.owners],
            )
        return hidden_round or prior_round

    def _insert_priors(
        self,
        model: SceneModel,
        optimizer: SelectiveAdam,
        viewpoints: list[Viewpoint],
        offered: OfferedPriors,
        seen: GaussianVisibility,
    ) -> None:
        """The offered priors for hidden places, with their opacity, and the sky of stage 0."""
        opaque = replace(model.options, initial_opacity=0.99, refine_poses=False)
        times = np.array([model.scene.start_us, model.scene.end_us])
        first = SceneModel(offered.scene, opaque, times, backend=model.backend)
        hidden = hidden_sky(model, viewpoints)
        model.sky.data[hidden] = first.sky.data[hidden]
        optimizer.reset_moments("sky")
        limit = self._options.background_limits.fraction
        wanted = None if offered.whole is None else offered.whole[first.gaussians.owners]
        if self._unseen is not None:
            unseen = self._unseen(first, viewpoints)
            wanted = unseen if wanted is None else wanted | unseen
        model.priors = occluded_priors(
            model,
            first,
            viewpoints,
            limit=limit,
            wanted=wanted,
            alternatives=offered.alternatives,
            bare=bare_ground(model, first, seen),
        )


# Viewing directions.
#
# A direction-dependent colour is unconstrained away from the one direction that saw it, and so are
# sides seen only edge-on: neither changes a training image, and both show when an edit turns a
# car.

SH_C1 = 0.4886025119029199
"""Factor of the basis functions of degree 1: -C1 y, C1 z, -C1 x."""
LOBE_PRIOR = 0.03
"""Variance of viewing directions at which a lobe keeps half of its learnt value."""


@dataclass(frozen=True, eq=False)
class ViewingDirections:
    """Moments of the unit directions from N Gaussians to the cameras, in their owners' frames.

    Attributes:
        views: [N] float32, number of images that contain a Gaussian's centre.
        means: [N, 3] float32; 0 without such images.
        seconds: [N, 3, 3] float32, means of outer products.
        facing: [N] float32, largest cosine between a normal and the direction to a camera; -1
            without normals.
    """

    views: Tensor
    means: Tensor
    seconds: Tensor
    facing: Tensor


@torch.no_grad()
def viewing_directions(
    model: SceneModel,
    viewpoints: Iterable[Viewpoint],
    *,
    normals: Tensor | None = None,
    objects_only: bool = False,
) -> ViewingDirections:
    """Moments over all images that contain a Gaussian's centre, occluded or not.

    Args:
        normals: [N, 3] of the surfaces under the Gaussians, in their owners' frames.
        objects_only: leaves the background out.
    """
    gaussians, starts = model.gaussians, model.gaussians.starts
    count = len(gaussians)
    views, sums, products = (
        torch.zeros(count, *shape, device=model.device) for shape in ((), (3,), (3, 3))
    )
    facing = torch.full((count,), -1.0, device=model.device)
    flips = [False, True] if any(model.mirrored) else [False]
    for (camera, t_us), flipped in itertools.product(viewpoints, flips):
        viewmat = model.viewmat(camera, t_us).detach()
        mirrored = model.mirrored if flipped else ()
        clouds = gaussians.clouds(degree=0, mirrored=mirrored)
        instances, drawn = model.instances(clouds, t_us)
        for index, item in zip(drawn, instances, strict=True):
            reflected = index > 0 and flipped and mirrored[index - 1]
            if (flipped and not reflected) or (index == 0 and objects_only):
                continue
            rows = slice(starts[index], starts[index + 1])
            pose = camera_from_object(item, viewmat)
            local = item.cloud.means @ pose[:3, :3].T + pose[:3, 3]
            x, y, z = local.unbind(-1)
            safe = z.clamp(min=NEAR)
            u = float(camera.K[0, 0]) * x / safe + float(camera.K[0, 2])
            v = float(camera.K[1, 1]) * y / safe + float(camera.K[1, 2])
            seen = (z > NEAR) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            direction = torch.nn.functional.normalize(local, dim=-1) @ pose[:3, :3]
            if reflected:
                direction = direction * direction.new_tensor([1.0, -1, 1])
            if normals is not None:
                cosine = torch.where(seen, -(direction * normals[rows]).sum(-1), -1.0)
                facing[rows] = torch.maximum(facing[rows], cosine)
            direction = direction * seen[:, None]
            views[rows] += seen
            sums[rows] += direction
            products[rows] += direction[:, :, None] * direction[:, None]
    weight = views.clamp(min=1)
    return ViewingDirections(
        views, sums / weight[:, None], products / weight[:, None, None], facing
    )


@torch.no_grad()
def unseen_sides(
    model: SceneModel, viewpoints: Iterable[Viewpoint], bodies: Sequence[VehicleBody | None]
) -> Tensor:
    """[N] bool: on a side of a vehicle's body that images show only at grazing angles or not at
    all.

    Gaussians there were learnt from the outline of other sides and become visible when the vehicle
    turns.

    Args:
        bodies: bodies of the objects; None where unknown.
    """
    normals, known = _body_normals(model, bodies)
    facing = viewing_directions(model, viewpoints, normals=normals, objects_only=True).facing
    return known & (facing < GRAZING)


def _body_normals(model: SceneModel, bodies: Sequence[VehicleBody | None]) -> tuple[Tensor, Tensor]:
    """Outward normals [N, 3] of the bodies at their points nearest to the Gaussians, and [N] bool:
    whether there is a body.
    """
    gaussians, starts = model.gaussians, model.gaussians.starts
    normals = torch.zeros_like(gaussians.means)
    known = torch.zeros(len(gaussians), dtype=torch.bool, device=model.device)
    for index, body in enumerate(bodies):
        rows = slice(starts[index + 1], starts[index + 2])
        if body is not None and rows.stop > rows.start:
            means = gaussians.means[rows].detach().cpu().numpy().astype(np.float64)
            found = torch.from_numpy(body.normals[body.nearest(means)])
            normals[rows] = found.to(normals)
            known[rows] = True
    return normals, known


@torch.no_grad()
def paint_unseen_sides(
    model: SceneModel, viewpoints: Sequence[Viewpoint], bodies: Sequence[VehicleBody | None]
) -> None:
    """Give sides of vehicles that images show only edge-on the colours of their bodies.

    The colour of each of these Gaussians changes linearly from its learnt value, in the mean
    direction of the images, to the colour of the body at its position, against the normal. The
    colour visible in the images stays.
    """
    normals, known = _body_normals(model, bodies)
    seen = viewing_directions(model, viewpoints, normals=normals, objects_only=True)
    sh = model.gaussians.sh
    rows = (known & (seen.facing < GRAZING)).nonzero()[:, 0]
    if sh.shape[1] < 4 or not len(rows):
        return
    signs = sh.new_tensor([-1.0, -1.0, 1.0])[:, None]
    slopes = sh[rows, 1:4].roll(1, dims=1) * signs * SH_C1
    mean = seen.means[rows]
    shown = 0.5 + SH_C0 * sh[rows, 0] + (slopes * mean[:, :, None]).sum(1)
    wanted = _body_colours(model, bodies, rows)
    way = -normals[rows] - mean
    way /= way.square().sum(-1, keepdim=True).clamp(min=0.5)
    slopes = way[:, :, None] * (wanted - shown)[:, None]
    constant = shown - (slopes * mean[:, :, None]).sum(1)
    sh[rows, 0] = (constant - 0.5) / SH_C0
    sh[rows, 1:4] = (slopes * signs / SH_C1).roll(-1, dims=1)
    sh[rows, 4:] = 0


def _body_colours(model: SceneModel, bodies: Sequence[VehicleBody | None], rows: Tensor) -> Tensor:
    """Colours [M, 3] of the bodies at the positions of the object Gaussians ``rows`` [M]."""
    starts = model.gaussians.starts
    colours = torch.zeros(len(rows), 3, device=model.device)
    for index, (item, body) in enumerate(zip(model.scene.objects.values(), bodies, strict=True)):
        mine = (rows >= starts[index + 1]) & (rows < starts[index + 2])
        if body is None or not bool(mine.any()):
            continue
        near = body.nearest(model.gaussians.means[rows[mine]].detach().cpu().numpy())
        painted = body_colours(body, item, model.scene)[near]
        colours[mine] = torch.from_numpy(painted).to(colours)
    return colours


@torch.no_grad()
def plain_lobes(model: SceneModel, seen: ViewingDirections, *, prior: float = LOBE_PRIOR) -> None:
    """Move direction-dependent colours of objects into constant ones where views were few.

    A ridge regression of the linear lobes on the observed colours. The variation across the
    training directions shrinks; the colour in the mean direction stays, up to rounding.
    """
    objects = slice(model.gaussians.counts[0], None)
    sh, means = model.gaussians.sh[objects], seen.means[objects]
    if sh.shape[1] < 4:
        return
    covariance = seen.seconds[objects] - means[:, :, None] * means[:, None]
    eye = torch.eye(3, device=sh.device)
    kept = torch.linalg.solve(covariance + prior * eye, covariance)
    # The order of the lobes is y, z, x.
    signs = sh.new_tensor([-1.0, -1.0, 1.0])[:, None]
    slopes = sh[:, 1:4].roll(1, dims=1) * signs * SH_C1
    less = kept @ slopes
    colour = ((slopes - less) * means[:, :, None]).sum(1)
    sh[:, 0] += colour / SH_C0
    sh[:, 1:4] = (less * signs / SH_C1).roll(-1, dims=1)
    # Lobes of higher degree shrink as much as the mean of the three.
    factor = kept.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    sh[:, 4:] *= factor
