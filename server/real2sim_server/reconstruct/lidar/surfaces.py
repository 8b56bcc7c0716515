"""The set of Gaussians that LiDARs see: flat, learned from sweeps, with a reflectivity each.

Images leave haze before and behind surfaces, which a beam measures. So surfaces are laid on what
the sweeps measured, filled up where they measured nothing, and learned from the rays themselves.
Reflectivity is fitted to the recorded intensities last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...logs import DrivingLog, log_of_frames
from ...scene import Scene
from ..initialise.stage0 import initialise_scene
from ..options import InitialiseOptions, ReconstructError
from ..stages import OnProgress, Stages
from .learn import SeenSweep, SurfaceTable, learn_surfaces
from .losses import fit_losses
from .measured import MeasuredPoints
from .rays import RecordedRays, fit_rings, recorded_rays
from .reflectivity import fit_reflectivity, light_of

MAX_SWEEPS = 40
"""That are learned from; every sweep gives points."""
STEPS = 60
"""By default; each takes a part of the rays of one sweep."""
WITHOUT_LOOKS = InitialiseOptions(
    max_background=120_000,
    max_object=8_000,
    voxel=0.1,
    object_voxel=0.05,
    ground_spacing=0.12,
    feature_images=0,
    stereo_images=0,
    max_colour_frames=8,
    samples=2,
    sky_resolution=32,
    lanes="none",
)
"""Shapes alone, for where no beam measured anything: beams see no colours."""
GONE = 0.02
"""Gaussians of less opacity are left out in the end."""


@dataclass(frozen=True)
class SurfacesReport:
    """What was made.

    Attributes:
        gaussians: of background and objects.
        sweeps: learned from.
        held_out: frames that were left aside.
        known: share of the Gaussians that a recorded beam met.
        incidence: share of reflected light that does not mind incidence.
        cost: of the last rays, 0 where all light stops where the sweep measured, 1 where none.
        intensity_residual: root mean square, of what the intensities leave unexplained.
        timing_s: seconds by stage.
    """

    gaussians: int
    sweeps: int
    held_out: tuple[int, ...]
    known: float
    incidence: float
    cost: float
    intensity_residual: float
    timing_s: dict[str, float]


def fit_lidar_surfaces(
    scene: Scene,
    log: DrivingLog,
    *,
    surfaces: Scene | None = None,
    options: InitialiseOptions | None = None,
    steps: int = STEPS,
    on_progress: OnProgress | None = None,
) -> tuple[Scene, SurfacesReport]:
    """The scene with a set for LiDARs made of ``log``, frames that it holds out left aside.

    Args:
        scene: made of ``log``.
        log: with LiDAR sweeps.
        surfaces: fills up what no beam measured: what ``initialise_scene`` makes of the same
            frames. Training leaves it as ``initial.r2s`` in its folder. Made anew by default.
        options: of the surfaces, see ``initialise_scene``; by default shapes alone.
        steps: of learning; each takes about a second of one core.
        on_progress: called with the stage, steps done and steps in all.

    Raises:
        ReconstructError: the log has no sweeps or other objects, or ``surfaces`` may be of frames
            held out.
        LogError: a file of the log cannot be read.
    """
    timing_s: dict[str, float] = {}
    stages = Stages(on_progress, timing_s)
    held_out = held_out_of(scene)
    frames = [frame for frame in range(log.frame_count) if frame not in held_out]
    log = log_of_frames(log, frames)
    if surfaces is None:
        surfaces = initialise_scene(
            log, options=options or WITHOUT_LOOKS, on_progress=on_progress, timing_s=timing_s
        )
    elif not held_out <= held_out_of(surfaces):
        raise ReconstructError(
            f"the scene holds out {len(held_out)} frames, and the surfaces given do not say that "
            "they were made without them; leave the surfaces out to have them made anew"
        )
    _check_objects(scene, surfaces)
    points, sweeps = MeasuredPoints(log), []
    chosen = set(np.linspace(0, log.frame_count - 1, MAX_SWEEPS).astype(int).tolist())
    with stages("sweeps") as report_step:
        for frame in range(log.frame_count):
            rays = recorded_rays(log, frame)
            if rays is not None:
                met = points.add(frame, rays) >= 0
                if frame in chosen:
                    sweeps.append(_seen(frame, rays, met))
            report_step(frame + 1, log.frame_count)
    if not sweeps:
        raise ReconstructError(f"log {log.name!r} has no LiDAR sweeps to make surfaces of")
    with stages("layout"):
        table = SurfaceTable.of(points.clouds(surfaces), tuple(surfaces.objects))
    with stages("learn") as report_step:
        cost = learn_surfaces(table, scene, log, sweeps, steps=steps, on_step=report_step)
    table = table.select(table.opacities > GONE)
    with stages("light") as report_step:
        lit = light_of(table, scene, log, sweeps, on_sweep=report_step)
    with stages("reflectivity"):
        fitted = fit_reflectivity(table, lit)
    with stages("losses") as report_step:
        fit_losses(table, scene, log, sweeps, lit=lit, on_sweep=report_step)
    made = table.placed(scene, fitted.incidence)
    assert made.lidar is not None
    report = SurfacesReport(
        gaussians=len(table),
        sweeps=len(sweeps),
        held_out=tuple(sorted(held_out)),
        known=fitted.known,
        incidence=fitted.incidence,
        cost=cost,
        intensity_residual=fitted.residual,
        timing_s=timing_s,
    )
    return replace(made, lidar=replace(made.lidar, response=fitted.response)), report


def held_out_of(scene: Scene) -> set[int]:
    """Frames of its log that a scene was made without."""
    made = scene.provenance.get("reconstruction")
    listed = made.get("held_out_frames") if isinstance(made, dict) else None
    return set(listed) if isinstance(listed, list) else set()


def _check_objects(scene: Scene, surfaces: Scene) -> None:
    """Objects are met by their number, so both must have the same."""
    of_scene, of_log = tuple(scene.objects), tuple(surfaces.objects)
    if of_scene != of_log:
        differ = sorted(set(of_scene) ^ set(of_log))[:5]
        raise ReconstructError(
            f"the scene has {len(of_scene)} objects and its log {len(of_log)}, of which "
            f"{differ or 'the order'} differ; fit surfaces before objects are added or taken out"
        )


def _seen(frame: int, rays: RecordedRays, met: NDArray[np.bool_]) -> SeenSweep:
    """A sweep with those of its rays that met anything but the recording vehicle itself."""
    rings = fit_rings(rays)
    if rings is None:
        none = np.full(int(met.sum()), -1, np.int32)
        return SeenSweep(frame, rays.select(met), none, np.zeros(0), ())
    missing = tuple(rings.missing(rays))
    return SeenSweep(frame, rays.select(met), rings.ring[met], rings.elevation, missing)
