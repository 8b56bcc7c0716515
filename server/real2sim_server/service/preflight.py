"""What can be refused before anything heavy is loaded: the scene folder and the address."""

from __future__ import annotations

import errno
import ipaddress
import socket

from ..settings import Settings
from .storage.connection import check_state_folder


class SceneFolderError(ValueError):
    """The folder of scenes that was named is not there."""


class AddressError(OSError):
    """The address cannot be listened on."""


def check_start(settings: Settings) -> None:
    """Refuse to start where it cannot go well.

    Raises:
        SceneFolderError: the folder of scenes is missing.
        StateFolderError: another worker is on the state folder, or it cannot be written to.
        AddressError: the address is taken, or none of this machine.
    """
    check_scenes(settings)
    check_state_folder(settings.data_dir)
    bind(settings.host, settings.port).close()


def check_scenes(settings: Settings) -> None:
    """Raises SceneFolderError where a folder of scenes is named that is not there."""
    folder = settings.scenes_dir
    if folder is None or folder.is_dir():
        return
    problem = "is not a folder" if folder.exists() else "does not exist"
    raise SceneFolderError(
        f"the scene folder {str(folder)!r} {problem}: name the folder that holds the scene bundles "
        f"with --scenes or REAL2SIM_SCENES_DIR, or make an empty one: mkdir -p {folder}"
    )


def bind(host: str, port: int) -> socket.socket:
    """A socket bound to the address, not listening yet; port 0 takes a free one.

    Raises:
        AddressError: saying which address, and what to do.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise _unusable(host, port, error) from error
    # Named as TCP, or asyncio would not turn Nagle's algorithm off on accepted connections, and
    # every answer would wait 40 ms for an acknowledgement.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        listener.close()
        raise _unusable(host, port, error) from error
    return listener


def listen(listener: socket.socket) -> None:
    """Accept connections on a bound socket. Raises AddressError: it was taken since."""
    host, port = listener.getsockname()[:2]
    try:
        listener.listen(2048)
    except OSError as error:
        listener.close()
        raise _unusable(host, port, error) from error


def url_of(host: str, listener: socket.socket) -> str:
    """How clients reach a bound socket, for example ``http://127.0.0.1:8600``."""
    return f"http://{_in_url(host)}:{listener.getsockname()[1]}"


def _unusable(host: str, port: int, error: OSError) -> AddressError:
    address = f"{_in_url(host)}:{port}"
    if error.errno == errno.EADDRINUSE:
        return AddressError(
            f"{address} is in use already: another program, perhaps another worker, listens on "
            f"port {port}. Stop it, or give another port with --port or REAL2SIM_PORT; 0 picks a "
            "free one"
        )
    return AddressError(
        f"cannot listen on {address}: {error.strerror or error}. Give an address of this machine "
        "with --host or REAL2SIM_HOST, and a port with --port or REAL2SIM_PORT"
    )


def _in_url(host: str) -> str:
    try:
        version = ipaddress.ip_address(host).version
    except ValueError:
        version = 4
    return f"[{host}]" if version == 6 else host
