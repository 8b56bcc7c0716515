"""File system errors and clock shifts on demand, for workers in their own processes, without root.

A small preloaded library intercepts system calls. Writes below a folder fail with the error number
in a file, which can limit the failure to some paths. A second file holds the offset of the wall
clock in seconds.
"""

from __future__ import annotations

import contextlib
import errno
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <fnmatch.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

#define LENGTH 4096
#define NEXT(type, name, ...) \
    static type (*next)(__VA_ARGS__); if (!next) next = dlsym(RTLD_NEXT, #name)

/* The number that a file begins with; what stands behind it, to the end of the line, is `rest`. */
static int number_in(const char *variable, char *rest) {
    const char *file = getenv(variable);
    *rest = 0;
    if (!file) return 0;
    int fd = (int)(long)((long (*)(int, const char *, int, int))dlsym(RTLD_NEXT, "openat"))(
        AT_FDCWD, file, O_RDONLY | O_CLOEXEC, 0);
    if (fd < 0) return 0;
    char text[LENGTH] = {0};
    ssize_t n = read(fd, text, sizeof text - 1);
    close(fd);
    int number = 0;
    if (n > 0) sscanf(text, "%d %[^\n]", &number, rest);
    return number;
}

static int fails_at(const char *path) {
    const char *folder = getenv("FAILING_FOLDER");
    if (!folder || !path || strncmp(path, folder, strlen(folder))) return 0;
    char pattern[LENGTH];
    int number = number_in("FAILING_ERRNO_FILE", pattern);
    if (*pattern && fnmatch(pattern, path, 0)) return 0;
    if (number) errno = number;
    return number;
}

static int fails(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return fails_at(path);
}

ssize_t write(int fd, const void *data, size_t size) {
    NEXT(ssize_t, write, int, const void *, size_t);
    return fails(fd) ? -1 : next(fd, data, size);
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) {
    NEXT(ssize_t, pwrite, int, const void *, size_t, off_t);
    return fails(fd) ? -1 : next(fd, data, size, at);
}
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
    NEXT(ssize_t, pwrite64, int, const void *, size_t, off64_t);
    return fails(fd) ? -1 : next(fd, data, size, at);
}
int ftruncate64(int fd, off64_t size) {
    NEXT(int, ftruncate64, int, off64_t);
    return fails(fd) ? -1 : next(fd, size);
}
int ftruncate(int fd, off_t size) {
    NEXT(int, ftruncate, int, off_t);
    return fails(fd) ? -1 : next(fd, size);
}
int mkdir(const char *path, mode_t mode) {
    NEXT(int, mkdir, const char *, mode_t);
    return fails_at(path) ? -1 : next(path, mode);
}
int rename(const char *from, const char *to) {
    NEXT(int, rename, const char *, const char *);
    return fails_at(to) ? -1 : next(from, to);
}
static int fails_to_open(const char *path, int flags) {
    int writes = flags & (O_CREAT | O_TRUNC) || (flags & O_ACCMODE) != O_RDONLY;
    if (!writes || !fails_at(path)) return 0;
    /* On a full disk files that are there can be opened. */
    if (errno == ENOSPC && access(path, F_OK) == 0) return 0;
    if (errno == ENOENT) errno = ENOSPC;
    return 1;
}
#define OPEN(name) \
int name(const char *path, int flags, ...) { \
    va_list more; va_start(more, flags); mode_t mode = va_arg(more, mode_t); va_end(more); \
    NEXT(int, name, const char *, int, ...); \
    return fails_to_open(path, flags) ? -1 : next(path, flags, mode); \
}
OPEN(open)
OPEN(open64)
#define OPENAT(name) \
int name(int at, const char *path, int flags, ...) { \
    va_list more; va_start(more, flags); mode_t mode = va_arg(more, mode_t); va_end(more); \
    NEXT(int, name, int, const char *, int, ...); \
    return fails_to_open(path, flags) ? -1 : next(at, path, flags, mode); \
}
OPENAT(openat)
OPENAT(openat64)

#define STATVFS(name) \
int name(const char *path, struct name *found) { \
    NEXT(int, name, const char *, struct name *); \
    int done = next(path, found); \
    if (!done && fails_at(path) == ENOSPC) found->f_bfree = found->f_bavail = 0; \
    return done; \
}
STATVFS(statvfs)
STATVFS(statvfs64)

int clock_gettime(clockid_t which, struct timespec *now) {
    NEXT(int, clock_gettime, clockid_t, struct timespec *);
    int done = next(which, now);
    char rest[LENGTH];
    if (!done && which == CLOCK_REALTIME) now->tv_sec += number_in("CLOCK_OFFSET_FILE", rest);
    return done;
}
"""


@dataclass(frozen=True)
class FailingSystem:
    """Environment of a worker under test and the failures to inject.

    Attributes:
        folder: writes below it can fail.
        environment: environment variables of the worker's process.
    """

    folder: Path
    environment: dict[str, str]

    @contextlib.contextmanager
    def refusing_writes(self, number: int, *, to: str = "") -> Iterator[None]:
        """Make writes below the folder fail inside the block.

        Args:
            number: errno of the failure.
            to: pattern of the paths below the folder that fail (default: all). ``*`` also matches
                slashes.
        """
        switch = Path(self.environment["FAILING_ERRNO_FILE"])
        # Write atomically: the worker can read the file at any time.
        written = switch.with_suffix(".new")
        written.write_text(f"{number} {self.folder / to if to else ''}\n")
        written.replace(switch)
        try:
            yield
        finally:
            switch.unlink()

    def set_clock(self, seconds: int) -> None:
        """Shift the wall clock of the worker."""
        offset = Path(self.environment["CLOCK_OFFSET_FILE"])
        written = offset.with_suffix(".new")
        written.write_text(str(seconds))
        written.replace(offset)


READ_ONLY, NO_SPACE, BROKEN = errno.EROFS, errno.ENOSPC, errno.EIO


def failing_system(folder: Path, place: Path) -> FailingSystem:
    """A failing system for state in ``folder``, built in ``place``. Skips without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler")
    source, library = place / "failing.c", place / "failing.so"
    source.write_text(SOURCE)
    command = [compiler, "-shared", "-fPIC", "-O1", "-w", "-o", library, source, "-ldl"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"the library cannot be made here: {done.stderr[-300:]}")
    environment = {
        "LD_PRELOAD": str(library),
        "FAILING_FOLDER": str(folder),
        "FAILING_ERRNO_FILE": str(place / "errno"),
        "CLOCK_OFFSET_FILE": str(place / "clock"),
    }
    return FailingSystem(folder, environment)
