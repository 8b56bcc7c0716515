"""Kernels on disk are used again as long as nothing changed that they are made of, and no longer.

A small package in a temporary folder takes parts of its kernel from a second file. Each run of it
is a process of its own that reports what the kernel returned and whether it was compiled.
"""

import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import real2sim_server

KERNEL = """
from typing import NamedTuple
from real2sim_server._numba import func, kernel
from . import parts
from .parts import FACTOR, Pair, generated, registered, shifted

@func
def inside(x):
    return shifted(x) * FACTOR + registered(x)

@kernel
def computed(pair):
    return inside(pair.first) + parts.TABLE[1] + generated(pair.first)
"""

PARTS = '''
from typing import NamedTuple
from numba import types
from numba.extending import intrinsic, register_jitable
from real2sim_server._numba import func

FACTOR = 2.0
TABLE = (0.0, 100.0)
EMITTED = 10_000.0

class Pair(NamedTuple):
    first: float
    second: float

@func
def shifted(x):
    """Documented."""
    return x + 1.0

@register_jitable
def registered(x):
    return 1000.0 * x

def emit(builder, value):
    return builder.fmul(value, value.type(EMITTED))

@intrinsic
def generated(typingctx, x):
    def generate(context, builder, signature, arguments):
        return emit(builder, arguments[0])
    return types.float64(types.float64), generate
'''

RUN = """
import json
from real2sim_server._numba import is_on_disk
from small.kernels import Pair, computed
there = is_on_disk(computed)
result = computed(Pair(1.0, 3.0))
print(json.dumps([result, sum(computed.stats.cache_misses.values()), there]))
"""

BEFORE = 2.0 * 2.0 + 1000.0 + 100.0 + 10_000.0


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A folder with the package after its first run."""
    root = tmp_path_factory.mktemp("compiled")
    folder = root / "small"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "kernels.py").write_text(KERNEL)
    (folder / "parts.py").write_text(PARTS)
    assert run(root) == (BEFORE, "compiled")
    return root


@pytest.fixture
def package(compiled, tmp_path):
    """A copy of it, with times of files and compiled kernels."""
    shutil.copytree(compiled, tmp_path, dirs_exist_ok=True)
    return tmp_path


SLOW = """
import os, signal
import real2sim_server._numba as n
def never(*arguments):
    print("compiled", flush=True)
    signal.pause()
n._KernelCache.save_overload = never
os.nice(n.LOW_PRIORITY)
"""
LISTENING = """
import sys
from real2sim_server import _numba, console
_numba.made.expect(1)
console.LISTENERS.append(lambda text: print(text, file=sys.stderr))
"""
IMPATIENT = """
import real2sim_server._numba as n
def refuse(seconds):
    raise SystemExit("it waits")
n.time.sleep = refuse
"""
READ_ONLY = """
import tempfile
def refuse(*args, **options):
    raise OSError(30, "Read-only file system")
tempfile.TemporaryFile = refuse  # by which Numba finds out whether a folder can be written
"""


def run(
    folder: Path,
    seed: int = 0,
    *,
    other_signature: bool = False,
    cache: Path | None = None,
    before: str = "",
) -> tuple[float, str]:
    """What the kernel gave, and whether it was kept; ``is_on_disk`` looks at no signature."""
    result, misses, there = finished(started(folder, seed, cache=cache, before=before))
    assert there == (misses == 0 or other_signature)
    return result, "compiled" if misses else "kept"


def started(
    folder: Path, seed: int = 0, *, cache: Path | None = None, before: str = ""
) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "PYTHONPATH": f"{folder}{os.pathsep}{Path(real2sim_server.__file__).parents[1]}",
        "PYTHONHASHSEED": str(seed),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    environment.pop("NUMBA_CACHE_DIR", None)
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    return subprocess.Popen(
        [sys.executable, "-c", before + RUN],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen[str]) -> tuple[float, int, bool]:
    """Result, number of compilations, and whether anything was there before."""
    try:
        printed, errors = process.communicate()
    finally:
        process.kill()
    assert process.returncode == 0, errors
    result, misses, there = json.loads(printed)
    return result, misses, there


def change(package: Path, old: str, new: str, *, file: str = "parts.py") -> None:
    path = package / "small" / file
    source = path.read_text()
    assert source.count(old) == 1
    path.write_text(source.replace(old, new))


@pytest.mark.slow
def test_kernels_that_an_image_brings_along_are_used_from_a_folder_that_is_read_only(package):
    cache = package / "cache"
    assert run(package, cache=cache) == (BEFORE, "compiled")
    assert run(package, cache=cache, before=READ_ONLY) == (BEFORE, "kept")


@pytest.mark.slow
def test_a_kernel_that_cannot_be_kept_is_compiled_each_time(package):
    cache = package / "cache"
    for _ in range(2):
        assert run(package, cache=cache, before=READ_ONLY) == (BEFORE, "compiled")


def test_a_kernel_is_compiled_once(package):
    assert run(package, seed=1) == (BEFORE, "kept")


@pytest.mark.slow
def test_how_many_kernels_are_ready_is_told_while_some_are_compiled(package):
    assert told(package) == []
    change(package, "FACTOR = 2.0", "FACTOR = 3.0")
    said = "compiling kernels, on the first run only"
    assert told(package) == [f"{said}: 0 of 1", f"{said}: 1 of 1"]


def told(package: Path) -> list[str]:
    """What is told of a run whose warm-up has promised one kernel."""
    process = started(package, before=LISTENING)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    return errors.splitlines()


def test_processes_that_need_a_kernel_at_once_compile_it_once(package):
    change(package, "FACTOR = 2.0", "FACTOR = 3.0")
    both = [started(package), started(package)]
    (first, its_misses, _), (second, other_misses, _) = map(finished, both)
    assert first == second == BEFORE + 2.0
    assert its_misses + other_misses == 1


@pytest.mark.slow
def test_a_low_priority_process_does_not_block_others(package):
    change(package, "FACTOR = 2.0", "FACTOR = 3.0")
    slow = started(package, before=SLOW)
    try:
        assert slow.stdout.readline() == "compiled\n"
        assert run(package, before=IMPATIENT) == (BEFORE + 2.0, "compiled")
    finally:
        slow.kill()
        slow.communicate()


@pytest.mark.slow
def test_a_lock_that_another_never_gives_back_delays_only(package):
    change(package, "FACTOR = 2.0", "FACTOR = 3.0")
    (lock,) = package.rglob("*.lock")
    impatient = "import real2sim_server._numba as n; n.MAX_WAIT_S = 0.2\n"
    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert run(package, before=impatient) == (BEFORE + 2.0, "compiled")


@pytest.mark.parametrize(
    ("old", "new", "difference"),
    [
        ("FACTOR = 2.0", "FACTOR = 3.0", 2.0),
        ("(0.0, 100.0)", "(0.0, 200.0)", 100.0),
        ("EMITTED = 10_000.0", "EMITTED = 10_001.0", 1.0),
        ("return x + 1.0", "return x + 2.0", 2.0),
        ("return 1000.0 * x", "return 1001.0 * x", 1.0),
        ("builder.fmul(value,", "builder.fadd(value,", 1.0),
    ],
    ids=["constant", "constant of a module", "constant of an intrinsic", "func", "jitable", "emit"],
)
def test_a_change_in_another_file_compiles_anew(package, old, new, difference):
    change(package, old, new)
    assert run(package) == (BEFORE + difference, "compiled")


def test_a_changed_order_of_a_tuples_fields_compiles_anew(package):
    fields = "    first: float\n    second: float"
    change(package, fields, "    second: float\n    first: float")
    three = 4.0 * 2.0 + 3000.0 + 100.0 + 30_000.0
    assert run(package, other_signature=True) == (three, "compiled")


def test_a_renamed_tuple_compiles_anew(package):
    change(package, "class Pair", "class Couple")
    change(package, "FACTOR, Pair,", "FACTOR, Couple as Pair,", file="kernels.py")
    assert run(package) == (BEFORE, "compiled")


def test_changed_options_of_a_func_compile_anew(package):
    change(package, "@func\ndef shifted", "@func(fastmath=True)\ndef shifted")
    assert run(package) == (BEFORE, "compiled")


def test_comments_in_another_file_do_not_recompile(package):
    change(package, '"""Documented."""', '"""Documented anew."""  # and why')
    assert run(package) == (BEFORE, "kept")
