"""Fuzz a worker with mutated requests and messages. Prints its faults as JSON.

    python tests/fuzz/run_service.py drive view --inputs 1000 --seed 0

The worker runs in this process, on loopback, with a memory limit. A session is driven during the
attack and must not be affected. A crash ends the process.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import json
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import rest
import sockets
from attacked_site import Site, attacked
from run_target import DEAD_S, GROWTH_BYTES, HANG_S, limit_memory, resident

BESIDE = 5
"""Number of inputs between two steps of the concurrent drive."""
TIDY = 250
"""Number of inputs between two cleanups."""
MAX_FAILURES = 20

Attack = Callable[[int, random.Random], str]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("targets", nargs="+", choices=sorted(ATTACKS))
    parser.add_argument("--inputs", type=int, required=True, help="for each target")
    parser.add_argument("--seed", type=int, required=True)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    faulthandler.enable()
    with tempfile.TemporaryDirectory() as folder, attacked(Path(folder)) as site:
        attacks = {name: ATTACKS[name](site, Path(folder)) for name in given.targets}
        warm_up(site, attacks, min(30, given.inputs))
        limit_memory()
        reports = [run(site, n, a, given.inputs, given.seed) for n, a in attacks.items()]
        site.driver.leave()
    print(json.dumps(reports))
    return 0


def warm_up(site: Site, attacks: dict[str, Attack], inputs: int) -> None:
    """Compile and load everything first, so that it is not attributed to an input."""
    for call in rest.described_calls(site):
        site.restore()
        rest.answered(site, call.data(), whole=True, rng=random.Random(1))
    for name, attack in attacks.items():
        for number in range(inputs):
            attack(number, random.Random(f"warm {name} {number}"))
    site.tidy()
    site.log.taken()


def run(site: Site, name: str, attack: Attack, inputs: int, seed: int) -> dict:
    report: dict = {"target": name, "inputs": 0, "failures": [], "steps_beside": 0}
    outcomes: Counter[str] = Counter()
    slowest = settled = 0.0
    began = time.monotonic()
    for number in range(inputs):
        faulthandler.dump_traceback_later(5 * DEAD_S, exit=True)
        failure, seconds = "", 0.0
        started = time.process_time()
        try:
            outcomes[attack(number, random.Random(f"{seed} {name} {number}"))] += 1
            site.settle()
            seconds = time.process_time() - started
            if number % BESIDE == 0:
                site.driver.drive()
                report["steps_beside"] += 1
            if number % TIDY == TIDY - 1:
                site.tidy()
            site.restore() if number % 10 == 9 else None
        except Exception as error:
            failure = "".join(traceback.format_exception(error))[-3000:]
        report["inputs"] += 1
        slowest = max(slowest, seconds)
        failure += site.log.taken() or ("hang" if seconds > HANG_S else "")
        if failure:
            report["failures"].append(
                {"input": f"{seed} {name} {number}", "seconds": seconds, "error": failure}
            )
            if len(report["failures"]) >= MAX_FAILURES:
                break
        if number == inputs // 4:
            settled = kept_memory(site)
    faulthandler.cancel_dump_traceback_later()
    report["growth_bytes"] = int(kept_memory(site) - settled) if settled else 0
    if report["growth_bytes"] > GROWTH_BYTES:
        report["failures"].append({"error": f"memory grew by {report['growth_bytes']} bytes"})
    report |= {"seconds": round(time.monotonic() - began, 1), "slowest_s": round(slowest, 3)}
    report |= {"different": len(outcomes), "most": outcomes.most_common(12)}
    return report


def kept_memory(site: Site) -> int:
    """Resident memory after everything has been released."""
    site.tidy()
    gc.collect()
    return resident()


def _routes(site: Site, _folder: Path) -> Attack:
    def attack(_number: int, rng: random.Random) -> str:
        calls = rest.described_calls(site) if not known or rng.random() < 0.02 else known
        known[:] = calls
        call = rest.damaged_call(rng.choice(calls), calls, rng)
        return rest.answered(site, call.data(), whole=call.is_whole(), rng=rng)

    known: list[rest.Call] = []
    return attack


def _requests(site: Site, _folder: Path) -> Attack:
    def attack(_number: int, rng: random.Random) -> str:
        calls = rest.described_calls(site) if not known or rng.random() < 0.02 else known
        known[:] = calls
        return rest.answered(site, rest.damaged_request(calls, rng), whole=False, rng=rng)

    known: list[rest.Call] = []
    return attack


def _uploads(site: Site, folder: Path) -> Attack:
    uploads = rest.Uploads()
    uploads.load(folder)

    def attack(number: int, rng: random.Random) -> str:
        return rest.answered(site, uploads.call(number, rng).data(), whole=True, rng=rng)

    return attack


def _drive(site: Site, _folder: Path) -> Attack:
    drive = sockets.Drive(site)
    return lambda _number, rng: drive.attack(rng)


def _view(site: Site, _folder: Path) -> Attack:
    view = sockets.View(site)
    return lambda _number, rng: view.attack(rng)


def _frames(site: Site, _folder: Path) -> Attack:
    return lambda _number, rng: sockets.odd_frames(site, rng)


ATTACKS: dict[str, Callable[[Site, Path], Attack]] = {
    "routes": _routes,
    "requests": _requests,
    "uploads": _uploads,
    "drive": _drive,
    "view": _view,
    "frames": _frames,
}


if __name__ == "__main__":
    sys.exit(main())
