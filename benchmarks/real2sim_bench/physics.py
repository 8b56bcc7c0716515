"""``real2sim bench physics``: particle substeps per second, and times of whole crashes."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numba
import numpy as np

from real2sim_server.geometry import Float, transform_from
from real2sim_server.physics.body import Body, box_particles
from real2sim_server.physics.colliders import Box, Plane
from real2sim_server.physics.materials import FixedCorotated, Material, NeoHookean
from real2sim_server.physics.solver import Solver, SolverOptions
from real2sim_server.simulation.body import DeformableBody
from real2sim_server.simulation.simulator import STEP, HybridSimulator
from real2sim_server.simulation.structure import GRAVITY, preset_of, vehicle_structure
from real2sim_server.simulation.tyres import Tyres

from .peers import PEERS, PeerBlock, missing_reason, start_peer

# Whole crashes and rolling vehicles: material, rigid motion, contacts and tyres. Bodies use the
# ``vehicle`` preset and the time step of all simulations.

CAR, CRASH_CAR_MASS = (4.5, 1.8, 1.5), 1500.0
TRUCK, TRUCK_MASS = (8.0, 2.5, 3.2), 20_000.0
CONE, CONE_MASS = (0.4, 0.4, 0.7), 3.0
CRASH_SPACING, CONE_SPACING = 0.125, 0.1
"""Particle spacing of vehicles and of the cone [m]."""
CLEARANCE = 0.25
"""Ground clearance of vehicle bodies [m]."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def _two_cars() -> list[DeformableBody]:
    """A car at 15 m/s hits the rear of a stationary one."""
    standing = _vehicle("standing", "car", CAR, CRASH_CAR_MASS, (CAR[0] + 0.05, 0.0))
    return [_vehicle("running", "car", CAR, CRASH_CAR_MASS, (0.0, 0.0), speed=15.0), standing]


def _truck_and_cone() -> list[DeformableBody]:
    """A truck at 8 m/s hits a cone off-centre."""
    place = (TRUCK[0] + CONE[0]) / 2 + 0.2, 0.6, CONE[2] / 2
    cone = _body("cone", "cone", CONE, CONE_MASS, place, spacing=CONE_SPACING)
    truck = _vehicle("truck", "truck", TRUCK, TRUCK_MASS, (0.0, 0.0), speed=8.0, spacing=0.25)
    return [truck, cone]


def _car_on_a_car() -> list[DeformableBody]:
    """A car drops from 5 cm onto the roof of another."""
    return [
        _vehicle("under", "car", CAR, CRASH_CAR_MASS, (0.0, 0.0)),
        _vehicle("over", "car", CAR, CRASH_CAR_MASS, (0.3, 0.0), above=CAR[2] + 0.05),
    ]


def _rolling() -> list[DeformableBody]:
    """A car rolls at 10 m/s without braking."""
    return [_vehicle("rolling", "car", CAR, CRASH_CAR_MASS, (0.0, 0.0), speed=10.0, brake=0.0)]


SITUATIONS: dict[str, tuple[Callable[[], list[DeformableBody]], float, float]] = {
    "two cars at 15 m/s, 2 s": (_two_cars, 2.0, 8.0),
    "truck and cone, 1 s": (_truck_and_cone, 1.0, 3.0),
    "car on a car, 3 s": (_car_on_a_car, 3.0, 10.0),
    "a car that rolls, 1 s": (_rolling, 1.0, 0.02),
}
"""By name: bodies, simulated time [s], and target for the elapsed time [s]."""


def measure(name: str) -> dict[str, Any]:
    """Elapsed and processor time of a situation [s], excluding compilation."""
    build, seconds, target = SITUATIONS[name]
    _follow(build(), seconds=0.15)
    world = _world(build())
    begin, used = time.perf_counter(), time.process_time()
    _advance(world, seconds)
    elapsed, processor = time.perf_counter() - begin, time.process_time() - used
    return {
        "name": name,
        "particles": sum(len(b.rest) for b in world.bodies),
        "simulated_s": seconds,
        "elapsed_s": elapsed,
        "processor_s": processor,
        "target_s": target,
    }


def as_row(line: dict[str, Any]) -> str:
    """The figures of a situation as text."""
    unit, factor = ("s", 1.0) if line["target_s"] >= 1 else ("ms", 1e3)
    shown = [f"{factor * line[k]:.3g} {unit}" for k in ("elapsed_s", "processor_s", "target_s")]
    return f"{shown[0]}, {shown[1]} of processors; {shown[2]} wanted"


def _follow(bodies: Sequence[DeformableBody], *, seconds: float) -> None:
    _advance(_world(bodies), seconds)


def _world(bodies: Sequence[DeformableBody]) -> HybridSimulator:
    return HybridSimulator(
        bodies,
        [Plane(name="road", friction=0.7)],
        road=["road"],
        gravity=(0.0, 0.0, -GRAVITY),
        backend="cpu",
        brake_after_hit=1.0,
    )


def _advance(world: HybridSimulator, seconds: float) -> None:
    for _ in range(round(seconds / STEP)):
        world.advance(STEP)


def _vehicle(
    name: str,
    category: str,
    size: tuple[float, float, float],
    mass: float,
    place: tuple[float, float],
    *,
    speed: float = 0.0,
    brake: float = 1.0,
    above: float = 0.0,
    spacing: float = CRASH_SPACING,
) -> DeformableBody:
    """A vehicle on its wheels, raised by ``above`` [m]."""
    at = (*place, size[2] / 2 + above)
    body = _body(name, category, size, mass, at, spacing=spacing, clearance=CLEARANCE, speed=speed)
    centre: Float = body.rest.centre_of_mass
    body.tyres = Tyres.of(size, centre, GRAVITY * mass, brake=brake)
    return body


def _body(
    name: str,
    category: str,
    size: tuple[float, float, float],
    mass: float,
    at: tuple[float, float, float],
    *,
    spacing: float,
    clearance: float = 0.0,
    speed: float = 0.0,
) -> DeformableBody:
    """A block with the preset's structure, filled from ``clearance`` [m] above its underside."""
    lifted = transform_from(np.array([0.0, 0.0, clearance / 2]), np.array(UPRIGHT))
    block = box_particles((*size[:2], size[2] - clearance), spacing=spacing, density=1.0)
    filled = block.with_mass(mass).moved(lifted)
    preset = preset_of("vehicle")
    materials, regions, particles = preset.build(category, filled, spacing)
    return DeformableBody(
        name,
        particles,
        materials,
        regions,
        friction=preset.friction,
        cell=2 * spacing,
        T_world_object=transform_from(np.array(at), np.array(UPRIGHT)),
        velocity=np.array([speed, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )


SIZES = (10_000, 100_000, 1_000_000)
MATERIALS: dict[str, Material] = {
    "fixed_corotated": FixedCorotated(young=2e6, poisson=0.4),
    "neo_hookean": NeoHookean(young=2e6, poisson=0.4),
}
VEHICLE = "vehicle_structure"
"""Name of a block with all zones of the ``vehicle`` preset."""
VEHICLE_DENSITY = 150.0
"""Density of that block before its zones redistribute mass [kg/m^3]."""
PARTICLES_PER_CELL = 14
SPACING = 0.05
REPEATS = 8
"""Number of runs; the best counts, because other load only slows runs down."""
SECONDS_PER_RUN = 0.3
REFERENCE_PARTICLES = 2_000
PEER_PARTICLES = 100_000
PEER_TURNS = 3
PEER_STEPS = 30
"""Substeps after which the falling distance is compared with that of peers."""
TARGETS = {"fixed_corotated": 10e6, "neo_hookean": 13e6, VEHICLE: 8e6}
"""Target particle substeps per second with 100,000 particles on two cores."""
CUDA_TARGETS = dict.fromkeys(TARGETS, 500e6)
"""Target particle substeps per second with 1,000,000 particles on an H200."""
CAR_SIZE, CAR_MASS, CAR_SPEED = (4.5, 1.8, 1.4), 1500.0, 15.7
"""Size [m], mass [kg] and speed [m/s] of the car that hits a wall."""
CRASH_SECONDS = 0.08
"""Simulated time of the wall crash, while the front deforms [s]."""


def run(
    *,
    peers: bool = False,
    backend: str = "cpu",
    on_progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure the solver and return the figures.

    Args:
        peers: also measure other frameworks on the same block, in the same process.
        backend: ``cpu`` or ``cuda``; ``cuda`` only measures rates and memory traffic.
        on_progress: callback with (parts done, total).

    Returns:
        Figures as JSON values. ``rate`` is in particle substeps per second of elapsed time, the
        best of REPEATS runs. ``cpu_rate`` is per second of processor time and thread, an estimate
        for an otherwise idle machine.
    """
    report_progress = on_progress or (lambda done, parts: None)
    cases = [(m, n) for m in (*MATERIALS, VEHICLE) for n in SIZES]
    whole = len(SITUATIONS)
    parts = len(cases) + (3 + whole + peers) * (backend == "cpu")
    report: dict[str, Any] = {
        "threads": numba.get_num_threads(),
        "cores": os.cpu_count(),
        "particles_per_cell": PARTICLES_PER_CELL,
        "repeats": REPEATS,
        "backend": backend,
        "targets": TARGETS if backend == "cpu" else CUDA_TARGETS,
        "speed": [],
        "domain": [],
    }
    for done, (material, particles) in enumerate(cases):
        report_progress(done, parts)
        report["speed"].append(_speed(material, particles, backend))
    report_progress(len(cases), parts)
    if backend != "cpu":
        return report
    report["domain"] = _domain()
    report_progress(len(cases) + 1, parts)
    report["crash"] = _crash()
    report["situations"] = []
    for done, name in enumerate(SITUATIONS, len(cases) + 2):
        report_progress(done, parts)
        report["situations"].append(measure(name))
    report_progress(len(cases) + 2 + whole, parts)
    report["reference"] = _reference()
    if peers:
        report_progress(len(cases) + 3 + whole, parts)
        report["peers"] = _peers()
    report_progress(parts, parts)
    return report


def as_rows(figures: dict[str, Any]) -> dict[str, str]:
    """The figures as text, by name."""
    rows = {"backend": figures["backend"], "threads": str(figures["threads"])}
    for line in figures["speed"]:
        name = f"{line['material'].replace('_', ' ')}, {line['particles']:,} particles"
        rows[name] = f"{line['rate'] / 1e6:.2f} M/s, {line['substep_ms']:.2f} ms a substep"
        if "moved_bytes" in line:
            floor = line["moved_bytes"] / line["floor_bytes"]
            rows[name] += f", {line['bandwidth'] / 1e12:.2f} TB/s of {floor:.1f} times the floor"
    for line in figures["domain"]:
        rows[f"two blocks {line['distance']:,.0f} m apart"] = f"{line['rate'] / 1e6:.2f} M/s"
    if "crash" not in figures:
        return rows
    crash = figures["crash"]
    name = f"a car against a wall, {crash['particles']:,} particles"
    rows[name] = f"{crash['rate'] / 1e6:.2f} M/s, {crash['substeps']} substeps"
    for line in figures["situations"]:
        rows[line["name"]] = as_row(line)
    rows["times as fast as plain torch"] = f"{figures['reference']['ratio']:.0f}"
    for line in figures.get("peers", ()):
        name = f"{line['name']}, {line.get('particles', 0):,} particles"
        if "missing" in line:
            rows[line["name"]] = line["missing"]
        elif line["name"] != "this solver":
            rows[name] = f"{line['rate'] / 1e6:.2f} M/s; here {line['ratio']:.2f} times as fast"
        else:
            rows[name] = f"{line['rate'] / 1e6:.2f} M/s"
    return rows


def _speed(material: str, particles: int, backend: str) -> dict[str, Any]:
    """Rate of a rotating, falling block of about ``particles`` particles."""
    solver = Solver([_block(material, particles)], [Plane(name="ground")], _options(backend))
    elapsed, processor = _time_substep(solver)
    count = len(solver.model.masses)
    figures = _traffic(solver, elapsed) if backend == "cuda" else {}
    return {
        **figures,
        "material": material,
        "particles": count,
        "rate": count / elapsed,
        "cpu_rate": count / processor,
        "substep_ms": 1e3 * elapsed,
    }


def _traffic(solver: Solver, elapsed: float) -> dict[str, Any]:
    """Counted memory traffic of a substep on the device [bytes], and its bandwidth [bytes/s]."""
    from real2sim_server.physics.backends.cuda.memory import substep_traffic

    simulation: Any = solver.simulation
    positions = simulation.particles().positions / solver.dx
    plastic = bool(solver.model.plastic.any())
    traffic = substep_traffic(
        **simulation.counts(), nodes=_nodes(positions), plastic=plastic, itemsize=4
    )
    return {
        "moved_bytes": traffic.moved,
        "floor_bytes": traffic.floor,
        "bandwidth": traffic.moved / elapsed,
    }


def _nodes(cells: Any) -> int:
    """Number of grid nodes touched by particles at ``cells`` [N, 3]."""
    first = np.unique(np.floor(cells - 0.5).astype(np.int64), axis=0)
    offsets = np.stack(np.meshgrid(*[range(3)] * 3), axis=-1).reshape(-1, 3)
    return len(np.unique((first[:, None] + offsets).reshape(-1, 3), axis=0))


def _domain() -> list[dict[str, Any]]:
    """Rates of two blocks of 50,000 particles at growing distance, which should be constant."""
    rows = []
    for distance in (4.0, 100.0, 2_000.0):
        blocks = [_block("fixed_corotated", 50_000, x, str(x)) for x in (0.0, distance)]
        solver = Solver(blocks, (), _options())
        elapsed, processor = _time_substep(solver)
        rows.append(
            {
                "distance": distance,
                "rate": len(solver.model.masses) / elapsed,
                "cpu_rate": len(solver.model.masses) / processor,
            }
        )
    return rows


def _crash() -> dict[str, Any]:
    """A car of the ``vehicle`` preset hits a wall; includes the checks of each step."""
    spacing = 0.1
    block = box_particles(CAR_SIZE, spacing=spacing, density=VEHICLE_DENSITY).with_mass(CAR_MASS)
    materials, regions, particles = vehicle_structure("car", block, spacing=spacing)
    car = Body(
        name="car",
        particles=particles,
        material=materials,
        regions=regions,
        velocity=(CAR_SPEED, 0, 0),
    )
    wall = np.eye(4)
    wall[0, 3] = CAR_SIZE[0] / 2 + 0.5
    solver = Solver(
        [car],
        [Box(name="wall", T_world_box=wall, size=(0.9, 4, 4))],
        SolverOptions(dx=2 * spacing, gravity=(0, 0, 0)),
    )
    begin, used = time.perf_counter(), time.process_time()
    report = solver.step(CRASH_SECONDS)
    elapsed, processor = time.perf_counter() - begin, time.process_time() - used
    work = len(particles) * report.substeps
    return {
        "particles": len(particles),
        "substeps": report.substeps,
        "rate": work / elapsed,
        "cpu_rate": work / processor,
    }


def _reference() -> dict[str, Any]:
    """Speedup over plain torch."""
    rates = {}
    for backend in ("cpu", "reference"):
        body = _block("fixed_corotated", REFERENCE_PARTICLES)
        solver = Solver([body], (), _options(backend))
        elapsed, _ = _time_substep(solver)
        rates[backend] = len(body.particles) / elapsed
    return {"particles": REFERENCE_PARTICLES, **rates, "ratio": rates["cpu"] / rates["reference"]}


def _peers() -> list[dict[str, Any]]:
    """Rates of the same falling block in all frameworks; the falling distances must agree."""
    edge = SPACING * round(PEER_PARTICLES ** (1 / 3))
    body = _block("fixed_corotated", PEER_PARTICLES)
    dx, n = _options().dx, len(body.particles)
    assert dx is not None
    positions = body.particles.positions - body.particles.positions.min(axis=0) + 3 * dx
    body = replace(
        body,
        particles=replace(body.particles, positions=positions + np.array([0, 0, edge / 2])),
        angular_velocity=(0, 0, 0),
    )
    solver = Solver([body], (), _options())
    dt = solver.time_step()
    start = body.particles.positions[:, 2].mean()

    def own(steps: int) -> None:
        solver.simulation.advance(steps, dt, ())

    own(PEER_STEPS)
    fallen = start - solver.simulation.particles().positions[:, 2].mean()
    runs: dict[str, Callable[[int], None]] = {"this solver": own}
    rows: list[dict[str, Any]] = [{"name": "this solver", "particles": n}]
    for peer in PEERS:
        reason = missing_reason(peer)
        if reason:
            rows.append({"name": peer, "missing": reason})
            continue
        other = start_peer(peer, _as_peer_block(body, dx, dt))
        other.advance(PEER_STEPS)
        runs[peer] = other.advance
        error = start - other.positions().astype(np.float64)[:, 2].mean() - fallen
        rows.append({"name": peer, "particles": n, "fall_differs_by_m": abs(float(error))})
    rates = _rates_by_turns(runs, n)
    for row in rows:
        if row["name"] in rates:
            row["rate"] = rates[row["name"]]
            row["ratio"] = rates["this solver"] / row["rate"]
    return rows


def _rates_by_turns(runs: dict[str, Callable[[int], None]], particles: int) -> dict[str, float]:
    """Best rate of each framework; they take turns, so that temporary load affects all."""
    best = dict.fromkeys(runs, math.inf)
    for _ in range(PEER_TURNS):
        for name, advance in runs.items():
            best[name] = min(best[name], _best(advance)[0])
    return {name: particles / elapsed for name, elapsed in best.items()}


def _as_peer_block(body: Body, dx: float, dt: float) -> PeerBlock:
    material = body.materials[0]
    return PeerBlock(
        positions=body.particles.positions.astype(np.float32),
        velocities=body.velocities.astype(np.float32),
        mass=float(body.particles.masses[0]),
        volume=float(body.particles.volumes[0]),
        mu=material.shear_modulus,
        lam=material.lame_lambda,
        dx=dx,
        dt=dt,
        gravity=SolverOptions.gravity[2],
        threads=numba.get_num_threads(),
    )


def _block(material: str, particles: int, x: float = 0.0, name: str = "block") -> Body:
    edge = SPACING * round(particles ** (1 / 3))
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, edge / 2 + 5.0
    motion: dict[str, Any] = {"velocity": (0, 0, -2), "angular_velocity": (1, 0, 0)}
    if material == VEHICLE:
        block = box_particles([edge] * 3, spacing=SPACING, density=VEHICLE_DENSITY)
        kinds, regions, block = vehicle_structure("car", block, spacing=SPACING)
        return Body(
            name=name, particles=block.moved(pose), material=kinds, regions=regions, **motion
        )
    kind = MATERIALS[material]
    block = box_particles([edge] * 3, spacing=SPACING, density=kind.density)
    return Body(name=name, particles=block.moved(pose), material=kind, **motion)


def _options(backend: str = "cpu") -> SolverOptions:
    return SolverOptions(dx=SPACING * PARTICLES_PER_CELL ** (1 / 3), backend=backend)


def _time_substep(solver: Solver) -> tuple[float, float]:
    """Shortest elapsed time of a substep [s], and processor time per thread [s], without checks."""
    simulation, dt = solver.simulation, solver.time_step()
    simulation.advance(2, dt, solver.colliders)
    return _best(lambda steps: simulation.advance(steps, dt, solver.colliders))


def _best(advance: Callable[[int], None]) -> tuple[float, float]:
    """Shortest elapsed time of a substep [s], and processor time per thread [s]."""
    begin = time.perf_counter()
    advance(1)
    steps = max(int(SECONDS_PER_RUN / (time.perf_counter() - begin)), 1)
    best = [float("inf"), float("inf")]
    for _ in range(REPEATS):
        begin, used = time.perf_counter(), time.process_time()
        advance(steps)
        taken = time.perf_counter() - begin, time.process_time() - used
        best[0] = min(best[0], taken[0] / steps)
        best[1] = min(best[1], taken[1] / steps / numba.get_num_threads())
    return best[0], best[1]
