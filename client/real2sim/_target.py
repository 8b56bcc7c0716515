"""Which worker is meant, and how long to wait for it."""

from __future__ import annotations

import ipaddress
import os
import re
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from real2sim_proto.base import bearer_token

from ._call import bearer
from ._retry import RetryPolicy

DEFAULT_URL = "http://127.0.0.1:8600"
URL_VARIABLE = "REAL2SIM_URL"
TOKEN_VARIABLE = "REAL2SIM_TOKEN"
CLIENT_HEADER = "X-Real2Sim-Client"


@dataclass(frozen=True)
class Target:
    """Where the worker is and how long to wait for it.

    Attributes:
        url: ``http://host:port`` or ``https://...``, with an optional path prefix.
        token: sent as bearer token; never shown.
        timeout: seconds that a reply may take.
        long_timeout: seconds for the calls that may load a scene, compile kernels or run many
            steps.
        name: who is calling, for the history of scenarios.
        policy: which requests are sent again.
        shared_memory: whether sessions that do not say must have it (True) or must not (False).
    """

    url: str
    token: str | None = field(default=None, repr=False)
    timeout: float = 30.0
    long_timeout: float = 300.0
    name: str | None = None
    policy: RetryPolicy = field(default_factory=RetryPolicy, repr=False)
    shared_memory: bool | None = None

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise ValueError(f"url {self.url!r} is not an address like {DEFAULT_URL!r}")
        if parts.username or parts.password:
            raise ValueError("the url holds credentials; give a token as token=... instead")
        if self.name is not None and not re.fullmatch(r"[ -~]{1,80}", self.name):
            raise ValueError(f"name {self.name!r} is not 1 to 80 printable ASCII characters")
        if self.timeout <= 0:
            raise ValueError(f"timeout is {self.timeout!r}; give seconds above 0")
        if self.token is not None:
            object.__setattr__(self, "token", bearer_token(self.token) or None)
        object.__setattr__(self, "url", self.url.rstrip("/"))
        object.__setattr__(self, "long_timeout", max(self.long_timeout, self.timeout))

    def __str__(self) -> str:
        return f"{self.url!r}, token={'***' if self.token else None}"

    @property
    def loopback(self) -> bool:
        """Whether the worker is on this machine, as far as the address tells."""
        host = urlsplit(self.url).hostname or ""
        if host == "localhost":
            return True
        try:
            return ipaddress.ip_address(host).is_loopback
        except ValueError:
            return False

    @property
    def headers(self) -> dict[str, str]:
        headers = bearer(self.token)
        return headers if self.name is None else headers | {CLIENT_HEADER: self.name}

    def drive_url(self, session_id: str) -> str:
        """Address of a session's drive socket, by the way this client reaches the worker."""
        scheme, rest = self.url.split("://", 1)
        return f"{'wss' if scheme == 'https' else 'ws'}://{rest}/v1/sessions/{session_id}/drive"

    def codec(self, codec: str) -> str:
        """'auto' made concrete: raw on loopback, where copying beats coding; else jpeg."""
        if codec != "auto":
            return codec
        return "raw" if self.loopback else "jpeg"

    def image_codec(self, codec: str, modality: str) -> str:
        """'auto' made concrete for an image of a modality; only rgb has a lossy codec."""
        if codec == "auto" and modality != "rgb":
            return "raw"
        return self.codec(codec)


def resolve_target(
    url: str | None,
    token: str | None,
    *,
    timeout: float,
    name: str | None,
    retries: int,
    shared_memory: bool | None = None,
) -> Target:
    """The target of these arguments; what is None comes from the environment, else the default.

    Raises:
        ValueError: not such an address; the sentence says so where the environment gave it.
    """
    found = url or os.environ.get(URL_VARIABLE) or DEFAULT_URL
    if token is None:
        token = os.environ.get(TOKEN_VARIABLE)
    policy = RetryPolicy(retries)
    try:
        return Target(
            found, token or None, timeout, name=name, policy=policy, shared_memory=shared_memory
        )
    except ValueError as error:
        if url or found == DEFAULT_URL:
            raise
        raise ValueError(f"{error} (from {URL_VARIABLE})") from None
