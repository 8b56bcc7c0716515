"""Compilation and disk cache of kernels for the whole server.

Two decorators, bare or with options of ``numba.njit``, which are passed through:

``@kernel``
    For functions called from Python. Cached on disk, so that only the first run compiles it.
``@func``
    For functions called only by kernels and other funcs. Compiled and cached with them.

    from .._numba import PARALLEL_LOOPS, func, kernel

    @func
    def squared(x):
        return x * x

    @kernel(nogil=True, parallel=PARALLEL_LOOPS)
    def norms(points): ...

Both divide like NumPy (``error_model="numpy"``) by default. A family of kernels with the same
options binds them once: ``entry = functools.partial(kernel, nogil=True, fastmath=True)``. Without
``nogil`` a kernel holds the interpreter's lock. This is right for kernels that take microseconds,
because reacquiring the lock can take milliseconds.

A cached kernel cannot be stale. Numba's own cache key covers the file that defines the function and
that function's bytecode. It misses dependencies: constants, called functions, code generators of
intrinsics, the order of a tuple's fields, compiler options. :func:`fingerprint` covers all of
these: it walks from the function over every reachable global name and closure cell, with their
values at the first call. It reads no source file, so importing costs nothing, and changes to
comments or docstrings elsewhere compile nothing.

Processes that need the same kernel at the same time compile it once: the first holds a lock on a
file next to the cache entry, and the others load its result. The holder may compile other kernels
that the first one calls, so there is no deadlock; a process that has waited for two minutes
compiles itself.

The fingerprint does not cover functions that Numba finds by type or registration instead of by
name: bodies passed to ``numba.extending.overload`` and options passed to ``register_jitable`` (its
functions are covered).
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import IO, Any, ClassVar

import numpy as np
from numba import njit, types
from numba.core import config
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
)
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu_options import ParallelOptions
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

from . import console


@dataclass
class Made:
    """Kernels that this process has made ready, including those that they call.

    Attributes:
        done: loaded from disk or compiled.
        expected: announced by warm-ups; 0 without an announcement.
        compiled: kernels that were or are being compiled.
    """

    done: int = 0
    expected: int = 0
    compiled: int = 0

    def expect(self, count: int) -> None:
        """Announce that a warm-up makes ``count`` kernels ready."""
        self.expected += count

    def __str__(self) -> str:
        return f"{self.done} of {self.expected}" if self.done <= self.expected else f"{self.done}"

    def tell(self) -> None:
        """Notify listeners of compiling, see :mod:`.console`; on the thread that compiles."""
        if self.compiled and console.LISTENERS:
            console.LISTENERS[-1](f"{COMPILING}: {self}")


made = Made()
COMPILING = "compiling kernels, on the first run only"

MAX_WAIT_S = 120.0
"""Maximum wait for another process that compiles the same kernel; the longest take half a minute.
"""

LOW_PRIORITY = 10
"""Niceness from which a thread must not block others: on a busy machine it compiles for minutes."""

PARALLEL_LOOPS = ParallelOptions(
    {"comprehension": False, "reduction": False, "numpy": False, "setitem": False}
)
"""Value for ``parallel=``: only loops over ``prange`` are parallel.

With ``parallel=True`` every statement on an array also becomes a parallel loop and is compiled
separately. For the small arrays between loops, that costs seconds of compilation and gains nothing.
"""


def kernel(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile a function for calls from Python; machine code is cached on disk, see the module.

    Args:
        function: to compile; absent when the decorator is used with options.
        **options: of ``numba.njit``; ``error_model`` defaults to "numpy".

    Returns:
        A Numba dispatcher, or the decorator that makes one.
    """
    if function is None:
        return functools.partial(kernel, **options)
    compiled = func(function, **options)
    if isinstance(compiled, Dispatcher):  # else NUMBA_DISABLE_JIT is set
        cache = _KernelCache(compiled)
        compiled._cache = cache  # type: ignore[attr-defined]
        compiled.compile = cache.compiled_once(compiled.compile)  # type: ignore[method-assign,assignment]
    return compiled


def func(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile a function for calls from kernels and other funcs; cached as part of the kernels.

    Arguments and result as for :func:`kernel`.
    """
    if function is None:
        return functools.partial(func, **options)
    return njit(**{"error_model": "numpy", **options})(function)


def fingerprint(compiled: Any) -> str:
    """64 hexadecimal digits that change with every dependency of a kernel.

    Args:
        compiled: result of :func:`kernel` or :func:`func`.
    """
    reach = _Reach()
    reach.reference(compiled)
    digest = hashlib.sha256()
    for part in reach.parts:  # grows during the loop
        digest.update(reach.describe(part).encode())
    return digest.hexdigest()


def is_on_disk(compiled: Any) -> bool:
    """Whether the machine code of a kernel with its current sources is on disk."""
    cache = getattr(compiled, "_cache", None)
    return not isinstance(cache, _KernelCache) or cache.holds_any()


class _ReadOnlyCacheLocator(UserProvidedCacheLocator):
    """A read-only folder of NUMBA_CACHE_DIR, as in an image with a read-only root.

    Numba would ignore the folder and its contents, and compile everything at each start.
    """

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if not config.CACHE_DIR:  # type: ignore[attr-defined]
            return None
        locator = cls(py_func, py_file)
        try:
            locator.ensure_cache_path()  # type: ignore[no-untyped-call]
        except OSError:
            return locator
        return None


class _KernelFiles(CompileResultCacheImpl):
    _locator_classes: ClassVar = [  # type: ignore[misc]
        _ReadOnlyCacheLocator,
        *CompileResultCacheImpl._locator_classes,
    ]


class _KernelCache(FunctionCache):
    """Numba's disk cache of one function, with a key that nothing slips through."""

    _impl_class = _KernelFiles

    def __init__(self, compiled: Dispatcher) -> None:
        super().__init__(compiled.py_func)  # type: ignore[no-untyped-call]
        self._compiled = compiled
        self._until_kept: contextlib.ExitStack | None = None
        self._cache_file = _Index(  # type: ignore[no-untyped-call]
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )

    def compiled_once(self, compile_: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """A dispatcher's ``compile`` that keeps others from compiling the same at the same time."""

        def load_or_compile(signature: Any) -> Any:
            with global_compiler_lock, contextlib.ExitStack() as until_kept:
                outer, self._until_kept = self._until_kept, until_kept
                _COMPILING.append(self)
                try:
                    return compile_(signature)
                finally:
                    self._until_kept = outer
                    _COMPILING.pop()
                    if not _COMPILING:
                        made.done += 1
                        made.tell()

        return load_or_compile

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Cached code for a signature; None if this process must compile it."""
        kept = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if kept is None and self._until_kept is not None:
            self._until_kept.enter_context(_locked(f"{self._cache_file._index_path}.lock"))
            kept = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            if kept is None and len(_COMPILING) == 1:
                made.compiled += 1
                made.tell()
        return kept

    def _index_key(self, sig: tuple[Any, ...], codegen: Any) -> tuple[Any, ...]:
        return sig, codegen.magic_tuple(), self._fingerprint, tuple(_tuple_fields(sig))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code; if the folder is not writable, the next start compiles it again."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    def holds_any(self) -> bool:
        """Whether there is code for the current fingerprint, for any signature."""
        kept = self._cache_file._load_index()
        return any(self._fingerprint in key for key in kept)

    @functools.cached_property
    def _fingerprint(self) -> str:
        return fingerprint(self._compiled)


class _Index(IndexDataCacheFile):
    """Cached entries of one function, by key."""

    def _load_index(self) -> dict[Any, str]:
        try:
            kept: dict[Any, str] = super()._load_index()  # type: ignore[no-untyped-call]
        except (AttributeError, ImportError):
            # Keys are pickled with the classes of their named tuples. If those were renamed, no
            # entry can be used.
            return {}
        return kept


@contextlib.contextmanager
def _locked(path: str) -> Iterator[None]:
    """Hold an exclusive lock on ``path`` against other processes.

    No effect if files cannot be locked, and after ``MAX_WAIT_S``. Requires the compiler's lock.
    """
    if path in _LOCKED:
        yield
        return
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(open(path, "a"))
            _wait_for(file)
            if os.nice(0) >= LOW_PRIORITY:
                fcntl.flock(file, fcntl.LOCK_UN)
            stack.callback(fcntl.flock, file, fcntl.LOCK_UN)
        _LOCKED.add(path)
        stack.callback(_LOCKED.discard, path)
        yield


def _wait_for(file: IO[str]) -> None:
    deadline = time.monotonic() + MAX_WAIT_S
    while time.monotonic() < deadline:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.02)
        else:
            return


def _tuple_fields(signature: Any) -> Iterator[tuple[str, ...]]:
    """Field names of the named tuples in a signature: Numba tells them apart by class alone."""
    for kind in signature:
        if isinstance(kind, types.BaseTuple):
            yield tuple(getattr(kind, "fields", ()))
            yield from _tuple_fields(kind)


class _Reach:
    """All functions and classes that a kernel reaches, numbered in the order of discovery.

    Attributes:
        parts: dispatchers, intrinsics, functions and classes; :meth:`describe` adds to them.
    """

    def __init__(self) -> None:
        self.parts: list[Any] = []
        self._numbers: dict[int, int] = {}

    def reference(self, part: Any) -> str:
        """Short text that identifies a part."""
        number = self._numbers.setdefault(id(part), len(self.parts))
        if number == len(self.parts):
            self.parts.append(part)
        return f"#{number}"

    def describe(self, part: Any) -> str:
        """Full text of a part, with references to the parts that it uses."""
        if isinstance(part, Dispatcher):
            return f"compiled {self._value(part.py_func)} {self._value(part.targetoptions)}"
        if isinstance(part, _Intrinsic):
            return f"intrinsic {self._value(part._defn)}"
        if isinstance(part, FunctionType):
            return self._describe_function(part)
        return self._describe_class(part)

    def _describe_function(self, function: FunctionType) -> str:
        names: set[str] = set()
        code = self._code(function.__code__, function.__doc__, names)
        cells = [_content(cell) for cell in function.__closure__ or ()]
        defaults = (function.__defaults__, function.__kwdefaults__)
        outside = [
            f"{name}={self._value(value)}"
            for name, value in _lookup(names, function.__globals__, set())
        ]
        return f"function {code} {self._value(cells)} {self._value(defaults)} {outside}"

    def _code(self, code: CodeType, doc: str | None, names: set[str]) -> str:
        """Text of a function's code; adds the outside names it may look up to ``names``."""
        names.update(code.co_names)
        constants = [
            self._code(constant, None, names)
            if isinstance(constant, CodeType)
            else self._value(constant)
            for constant in code.co_consts
            if doc is None or constant != doc
        ]
        variables = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        return f"{code.co_code.hex()} {variables} {constants}"

    def _describe_class(self, kind: type) -> str:
        if issubclass(kind, Enum):
            return f"enum {[(name, self._value(m.value)) for name, m in kind.__members__.items()]}"
        members = [
            f"{name}={self._value(value)}"
            for name, value in sorted(vars(kind).items())
            if not name.startswith("__") or isinstance(value, FunctionType)
        ]
        return f"class {[self._value(base) for base in kind.__bases__]} {members}"

    def _value(self, value: Any) -> str:
        """Text of a value, identical in every process."""
        if isinstance(value, (Dispatcher, _Intrinsic)):
            return self.reference(value)
        if isinstance(value, (FunctionType, type)):
            outside = _of_library(value.__module__)
            return value.__qualname__ if outside else self.reference(value)
        if isinstance(value, ModuleType):
            return value.__name__
        if isinstance(value, Enum):
            return f"{self._value(type(value))}.{value.name}"
        if isinstance(value, np.ndarray):
            return f"{value.dtype!r}{value.shape}{hashlib.sha256(value.tobytes()).hexdigest()}"
        return self._wrapped(value) or self._collection(value) or _ADDRESS.sub("", repr(value))

    def _wrapped(self, value: Any) -> str | None:
        if isinstance(value, (staticmethod, classmethod)):
            return self._value(value.__func__)
        if isinstance(value, property):
            return self._value(value.fget)
        if isinstance(value, functools.partial):
            return self._value((value.func, value.args, value.keywords))
        return None

    def _collection(self, value: Any) -> str | None:
        if isinstance(value, (tuple, list)):
            return f"{self._value(type(value))}{[self._value(item) for item in value]}"
        if isinstance(value, (set, frozenset)):
            return f"set{sorted(self._value(item) for item in value)}"
        if isinstance(value, Mapping):
            return f"{sorted((self._value(k), self._value(v)) for k, v in value.items())}"
        return None


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # a function that its own body has not yet defined
        return None


def _lookup(
    names: set[str], scope: Mapping[str, Any], modules: set[str]
) -> Iterator[tuple[str, Any]]:
    """Values of ``names`` in a scope and, for modules of ours among them, also in these."""
    for name in sorted(names & scope.keys()):
        value = scope[name]
        yield name, value
        if isinstance(value, ModuleType) and value.__name__ not in modules:
            modules.add(value.__name__)
            if not _of_library(value.__name__):
                yield from _lookup(names, vars(value), modules)


def _of_library(module: str | None) -> bool:
    """Whether a module changes only with Python, NumPy or Numba."""
    root = (module or "builtins").partition(".")[0]
    return root in _LIBRARIES or (root in sys.stdlib_module_names and root != "__main__")


_COMPILING: list[_KernelCache] = []
"""The kernel that is being made ready, and those that it calls; guarded by the compiler's lock."""

_LOCKED: set[str] = set()
_LIBRARIES = frozenset({"llvmlite", "numba", "numpy"})
_ADDRESS = re.compile(r"0x[0-9a-f]+")
