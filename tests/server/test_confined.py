"""A function in a process of its own: what comes of it, however it ends."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from real2sim_server._confined import ConfinedError, Limits, run_confined
from real2sim_server._confined import run as starter
from tests.waiting import LIMIT_S, wait_until

MIB = 1024**2
PROGRAM = '''
import ctypes, os, socket, time

class Refused(ValueError):
    """Documented."""

def double(x): return 2 * x
def environment(): return sorted(os.environ)
def refuse(): raise Refused("not this one")
def fail(): return {}["missing"]
def crash(): return ctypes.string_at(8).decode()
def leave(): os._exit(3)
def sleep(): time.sleep(60)
def burn():
    while True: pass
def wait(folder):
    with open(os.path.join(folder, "begun"), "wb"): pass
    while not os.path.exists(os.path.join(folder, "go_on")): time.sleep(0.01)
    return "done"
def fill(): return len(bytearray(1 << 30))
def write(path, size):
    with open(path, "wb") as file: file.write(bytes(size))
    return size
def connect(): socket.create_connection(("127.0.0.1", 9), 1)
def tell_much(): return "x" * (100 << 20)
def descriptors(): return sorted(int(n) for n in os.listdir("/proc/self/fd"))[:-1]
def privileges():
    with open("/proc/self/status") as file:
        return dict(line.split(":\\t", 1) for line in file.read().splitlines())
'''


class Refused(ValueError):
    """As in the program."""


@pytest.fixture(scope="module")
def call(tmp_path_factory):
    """Calls a function of ``PROGRAM``, which lies where the starter of this process looks."""
    folder = tmp_path_factory.mktemp("program")
    (folder / "confined_program.py").write_text(PROGRAM)

    def run(function: str, *, errors=(), limits: Limits | None = None, **arguments):
        target = f"confined_program:{function}"
        return run_confined(target, arguments, limits=limits, errors=errors)

    # A starter that is begun now has the folder in its path.
    starter._STARTER.close()
    sys.path.insert(0, str(folder))
    yield run
    sys.path.remove(str(folder))
    starter._STARTER.close()


def test_the_value_is_returned(call):
    assert call("double", x=21) == 42


def test_errors_that_are_expected_are_raised_again(call):
    with pytest.raises(Refused, match="not this one"):
        call("refuse", errors=(Refused,))


def test_other_errors_are_told(call):
    with pytest.raises(ConfinedError, match="KeyError: 'missing'"):
        call("fail")


def test_a_crash_is_an_error(call):
    with pytest.raises(ConfinedError, match="signal SIGSEGV"):
        call("crash")


def test_a_silent_exit_is_an_error(call):
    with pytest.raises(ConfinedError, match="exit code 3"):
        call("leave")


@pytest.mark.parametrize("function", ["sleep", "burn"])
def test_a_call_that_takes_too_long_is_stopped(call, function):
    with pytest.raises(ConfinedError, match=r"time limit of 0\.5 s"):
        call(function, limits=Limits(seconds=0.5))


def test_more_memory_than_allowed_is_an_error(call):
    with pytest.raises(ConfinedError, match="more than 256 MiB of memory"):
        call("fill", limits=Limits(memory_bytes=256 * MIB))


def test_nothing_is_written_unless_allowed(call, tmp_path):
    with pytest.raises(ConfinedError, match="File too large"):
        call("write", path=str(tmp_path / "a"), size=1)
    limits = Limits(written_bytes=1000)
    assert call("write", path=str(tmp_path / "b"), size=1000, limits=limits) == 1000


def test_an_endless_answer_is_an_error(call):
    with pytest.raises(ConfinedError, match="longer than"):
        call("tell_much")


def test_the_environment_is_nearly_empty(call, monkeypatch):
    monkeypatch.setenv("REAL2SIM_TOKEN", "a secret of the worker")
    assert "REAL2SIM_TOKEN" not in call("environment")


@pytest.mark.skipif(sys.platform != "linux", reason="privileges are those of Linux")
def test_privileges_are_given_up(call):
    status = call("privileges")
    assert status["NoNewPrivs"] == "1"
    # What reading the files of others takes, at most.
    assert int(status["CapEff"], 16) & ~0b110 == 0
    assert int(status["CapPrm"], 16) & ~0b110 == 0


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_it_holds_no_descriptor_of_the_program(call):
    assert call("descriptors") == [0, 1, 2, 3]


@pytest.mark.skipif(sys.platform != "linux", reason="namespaces are those of Linux")
def test_it_reaches_no_network_where_namespaces_are_allowed(call):
    with pytest.raises(ConfinedError):
        call("connect")


def test_calls_of_several_threads_do_not_wait_for_each_other(call, tmp_path):
    limits = Limits(seconds=2 * LIMIT_S, written_bytes=1)
    with ThreadPoolExecutor() as threads:
        slow = threads.submit(call, "wait", folder=str(tmp_path), limits=limits)
        wait_until(lambda: (tmp_path / "begun").exists() or slow.done(), "the slow call to begin")
        try:
            assert call("double", x=2) == 4
            assert not slow.done()
        finally:
            (tmp_path / "go_on").touch()
        assert slow.result() == "done"


def test_a_stopped_starter_is_restarted(call):
    call("double", x=1)
    process = starter._STARTER._process
    assert process is not None
    process.kill()
    process.wait()
    assert call("double", x=3) == 6


def test_the_starter_ends_with_the_program(tmp_path):
    (tmp_path / "program.py").write_text(
        "from real2sim_server._confined import run, run_confined\n"
        "run_confined('os:getcwd', {})\n"
        "import os\n"
        "print(run._STARTER._process.pid, flush=True)\n"
        "os._exit(0)\n"
    )
    found = subprocess.run(
        [sys.executable, tmp_path / "program.py"], check=True, capture_output=True
    )
    pid = int(found.stdout)
    wait_until(lambda: not _runs(pid), "the starter to end")


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or ") Z " not in state.read_text()
