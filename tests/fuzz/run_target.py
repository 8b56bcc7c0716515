"""Fuzz one reader in a separate process. Prints its faults as JSON.

    python tests/fuzz/run_target.py ply --inputs 1000 --seed 0 --corpus FOLDER

A crash or a hang ends this process. The current input is then in the corpus folder as ``current``.
Inputs with a new outcome are kept there and mutated further in the next run.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import hashlib
import json
import pickle
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import mutation
import readers

MEMORY_BYTES = 2 << 30
HANG_S = 20.0
"""CPU time [s] that counts as a hang. Normal inputs take milliseconds."""
DEAD_S = 120.0
"""A reader still running after this time hangs, even on a busy machine [s]."""
MAX_KEPT = 500
MAX_PART_BYTES = 1 << 20
GROWTH_BYTES = 256 << 20


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("target")
    parser.add_argument("--inputs", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--drive", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    faulthandler.enable()
    target = readers.target(given.target, given.drive)
    corpus = given.corpus / target.name
    corpus.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(run(target, Path(folder), corpus, given.inputs, given.seed)))
    (corpus / "current").unlink(missing_ok=True)
    return 0


def run(target: readers.Target, folder: Path, corpus: Path, inputs: int, seed: int) -> dict:
    valid = target.sample(folder)
    samples = list(valid)
    for sample in valid:
        target.read(target.write(sample, folder))
    kept = sorted(p for p in corpus.glob("*.kept"))
    seen = {p.stem for p in kept}
    with contextlib.suppress(ValueError, EOFError, pickle.UnpicklingError):
        samples += [pickle.loads(p.read_bytes()) for p in kept]
    limit_memory()
    report = {"target": target.name, "inputs": 0, "read": 0, "failures": [], "kept": 0}
    settled = 0
    for number in range(inputs):
        rng = random.Random(f"{seed} {target.name} {number}")
        # Mutations of valid inputs reach deepest, so they are preferred.
        base = rng.choice(valid if rng.random() < 0.6 else samples)
        parts = damaged(base, samples, rng)
        (corpus / "current").write_bytes(pickle.dumps(parts))
        outcome, failure, seconds = attempt(target, parts, folder)
        report["inputs"] += 1
        report["read"] += outcome == "read"
        if failure or seconds > HANG_S:
            name = f"failure-{seed}-{number}"
            (corpus / name).write_bytes(pickle.dumps(parts))
            report["failures"].append(
                {"input": name, "seconds": round(seconds, 2), "error": failure or "hang"}
            )
            if len(report["failures"]) >= 20:
                break
        signature = hashlib.sha256(outcome.encode()).hexdigest()[:16]
        if signature not in seen and len(seen) < MAX_KEPT:
            seen.add(signature)
            samples.append(parts)
            (corpus / f"{signature}.kept").write_bytes(pickle.dumps(parts))
            report["kept"] += 1
        if number == inputs // 4:
            settled = resident()
    report["growth_bytes"] = resident() - settled if settled else 0
    if report["growth_bytes"] > GROWTH_BYTES:
        report["failures"].append({"error": f"memory grew by {report['growth_bytes']} bytes"})
    return report


def damaged(parts: readers.Parts, samples: list, rng: random.Random) -> readers.Parts:
    """A copy with one part damaged, missing or replaced by another."""
    parts = dict(parts)
    if not parts:
        return parts
    name = rng.choice(sorted(parts))
    kind = rng.random()
    if kind < 0.02 and len(parts) > 1:
        del parts[name]
        return parts
    if kind < 0.04:
        parts[name] = parts[rng.choice(sorted(parts))]
        return parts
    is_json = name.endswith(".json") or parts[name].startswith(b"{")
    if is_json and kind < 0.8:
        parts[name] = mutation.damaged_json(parts[name], rng)
    elif parts[name].startswith(b"<") and kind < 0.6:
        parts[name] = mutation.damaged_xml(parts[name], rng)
    elif name.endswith(".msgpack") and kind < 0.8:
        parts[name] = mutation.damaged_msgpack(parts[name], rng)
    else:
        others = [s[name] for s in rng.sample(samples, min(3, len(samples))) if name in s]
        parts[name] = mutation.damaged_bytes(parts[name], others, rng)[:MAX_PART_BYTES]
    return parts


def attempt(target: readers.Target, parts: readers.Parts, folder: Path) -> tuple[str, str, float]:
    """Outcome (a word that is equal for equal reasons), failure, and seconds."""
    path = target.write(parts, folder)
    faulthandler.dump_traceback_later(DEAD_S, exit=True)
    started = time.process_time()
    try:
        target.read(path)
        outcome, failure = "read", ""
    except target.errors as error:
        reason = str(error).replace(str(path), "")
        outcome, failure = mutation.shape_of(reason), ""
    except BaseException as error:
        outcome = failure = "".join(traceback.format_exception(error))[-3000:]
        if isinstance(error, KeyboardInterrupt):
            raise
    seconds = time.process_time() - started
    faulthandler.cancel_dump_traceback_later()
    return outcome, failure, seconds


def limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


if __name__ == "__main__":
    sys.exit(main())
