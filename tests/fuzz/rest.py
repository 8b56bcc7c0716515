"""Mutations of the requests in the OpenAPI document."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import mutation
import readers
from attacked_site import DEAD_S, TOKEN, Site

HOSTILE = (
    "", ".", "..", "%2e%2e%2f%2e%2e", "..%2Fx", "%00", "%ED%A0%80", "%FF%FE", "%E2%80%AE", "%C3%A9",
    "a" * 300, "a" * 9000, "-1", "1e999", "NaN", "inf", "9" * 40, "null", "{}", "[]", "true", "*",
    "'", "%22", "%0d%0aX:%20y", "%25", "%", "%zz", ";", "a/b", "a?b", "a#b", "0", "post", "tiny",
)  # fmt: skip
HEADERS = {
    "Accept": ("", "*/*", "image/*;q=0", "image/png, image/jpeg;q=x", "application/msgpack", ","),
    "Accept-Encoding": ("gzip", "br, *;q=0", "\xff"),
    "Authorization": ("Bearer", "Bearer ", "Basic eDp5", "Bearer \xe9\xff", f"bearer  {TOKEN} "),
    "Connection": ("Upgrade", "keep-alive, x", ""),
    "Content-Encoding": ("gzip", "x"),
    "Content-Type": ("", "text/plain", "application/json; charset=x", "multipart/form-data", "\xff",
                     "multipart/form-data; boundary=", 'multipart/form-data; boundary="', "a/b/c"),
    "Expect": ("100-continue", "x"),
    "Host": ("", "evil.example", "[", "127.0.0.1:x", "\xff", "a" * 3000),
    "Idempotency-Key": ("", "k", "k" * 200, "k" * 201, "\xe9", "\x7f"),
    "If-Match": ("", "*", '"r0"', '"r999999999"', '"r9999999999"', 'W/"r1"', '"r1", "r2"', "r1"),
    "If-None-Match": ("*", '"x'),
    "If-Range": ("x",),
    "Last-Event-ID": ("0", "999999999", "9999999999", "-1", "x", ""),
    "Origin": ("null", "http://[", "http://127.0.0.1", "http://evil.example"),
    "Prefer": ("respond-async", "wait=0", "wait=99999", "wait=x", ""),
    "Range": ("bytes=0-", "bytes=5-2", "bytes=-1", "bytes=0-1,3-4", "bytes=9999999999-", "x=1",
              "bytes=" + "0-1," * 2000),
    "Sec-Fetch-Site": ("cross-site", "none", "x"),
    "Transfer-Encoding": ("identity", "gzip, chunked"),
    "Upgrade": ("websocket", "h2c", "x"),
    "X-Forwarded-For": ("x" * 2000,),
    "X-Real2Sim-Client": ("", "x" * 81, "\xe9", "\x07", "alice"),
    "X-Request-Id": ("", "x" * 81, "\xff", "a b", "ok-1"),
}  # fmt: skip
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS", "TRACE", "CONNECT", "X" * 99)
SIMPLE = METHODS[:5]
BUSY = frozenset({"QUEUE_FULL", "OVER_CAPACITY", "QUOTA_EXCEEDED", "UNSUPPORTED"})
"""Allowed error codes with status 5xx. A healthy worker gives no others."""
QUIET_S = 0.03
"""Timeout for the response to a request that may be incomplete [s]."""


@dataclass(frozen=True)
class Call:
    """A request before serialization."""

    method: str
    path: str
    query: tuple[tuple[str, str], ...] = ()
    headers: tuple[tuple[str, str], ...] = ()
    body: bytes = b""

    def data(self) -> bytes:
        """The serialized request, with a correct length."""
        query = "&".join(f"{name}={value}" for name, value in self.query)
        target = self.path + (f"?{query}" if query else "")
        headers = dict(self.headers)
        headers.setdefault("Host", "127.0.0.1")
        headers.setdefault("Authorization", f"Bearer {TOKEN}")
        if self.body:
            headers["Content-Length"] = str(len(self.body))
            headers.setdefault("Content-Type", "application/json")
        lines = [f"{self.method} {target} HTTP/1.1", *(f"{k}: {v}" for k, v in headers.items())]
        return "\r\n".join([*lines, "", ""]).encode("latin-1") + self.body

    def is_whole(self) -> bool:
        """Whether a response is required, because no header announces more data."""
        odd = {"Transfer-Encoding", "Upgrade", "Connection", "Host", "Expect"}
        return self.method in SIMPLE and not any(name in odd for name, _ in self.headers)


def described_calls(site: Site) -> list[Call]:
    """A valid request for each call of the OpenAPI document."""
    calls = []
    for path, item in site.ask("GET", "/openapi.json")["paths"].items():
        for method, operation in item.items():
            calls.append(_described(site, path, method, operation))
    return calls


def _described(site: Site, path: str, method: str, operation: dict[str, Any]) -> Call:
    query, headers = [], []
    for parameter in operation.get("parameters", ()):
        name = parameter["name"]
        value = str(site.known.get(name, parameter.get("example", "x")))
        if parameter["in"] == "path":
            path = path.replace(f"{{{name}}}", quote(value))
        elif parameter["in"] == "query" and name in site.known:
            query.append((name, value))
    if operation["operationId"] == "sessions-create":
        query = [("scene", "tiny")]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    example = _of_site(body.get("example"), site)
    content = json.dumps(example).encode() if example is not None else b""
    return Call(method.upper(), path, tuple(query), tuple(headers), content)


def _of_site(value: Any, site: Site) -> Any:
    """An example of the document, with names that this worker knows."""
    if isinstance(value, dict):
        return {k: _of_site(v, site) for k, v in value.items()}
    if isinstance(value, list):
        return [_of_site(v, site) for v in value]
    names = {
        "demo_street": "tiny", "street": "tiny", "street.r2s": "street.ply", "car_3": "car_red",
        "car_0": "car_red", "van_0": "post", "car_6": "car_blue", 640: 32, 2_000_000: 300_000,
        "sc_0123456789abcdef": site.known["scenario_id"],
    }  # fmt: skip
    return names.get(value, value) if isinstance(value, str | int) else value


# --- damage -----------------------------------------------------------------------------------


def damaged_call(call: Call, calls: list[Call], rng: random.Random) -> Call:
    """Mutate one to three parts of a request."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        damages: list[Callable[[Call, list[Call], random.Random], Call]] = [_path, _query, _header]
        damages += [_json] * 4 * bool(call.body) + [_body] + [_method] * (rng.random() < 0.3)
        call = rng.choice(damages)(call, calls, rng)
    return call


def _path(call: Call, calls: list[Call], rng: random.Random) -> Call:
    parts = call.path.split("/")
    at = rng.randrange(1, len(parts))
    kind = rng.random()
    if kind < 0.7:
        parts[at] = rng.choice(HOSTILE)
    elif kind < 0.85:
        parts.insert(at, rng.choice(HOSTILE))
    else:
        parts[at] += rng.choice(HOSTILE)
    path = "/".join(parts).replace("\n", "")
    return replace(call, path=path if path.startswith("/") else "/" + path)


def _query(call: Call, calls: list[Call], rng: random.Random) -> Call:
    query = list(call.query)
    names = ("camera", "t_us", "width", "modality", "after", "limit", "scene", "frames", "x", "")
    if query and rng.random() < 0.6:
        at = rng.randrange(len(query))
        query[at] = (query[at][0], rng.choice(HOSTILE))
    else:
        query.insert(rng.randrange(len(query) + 1), (rng.choice(names), rng.choice(HOSTILE)))
    return replace(call, query=tuple(query))


def _header(call: Call, calls: list[Call], rng: random.Random) -> Call:
    name = rng.choice(sorted(HEADERS))
    return replace(call, headers=(*call.headers, (name, rng.choice(HEADERS[name]))))


def _json(call: Call, calls: list[Call], rng: random.Random) -> Call:
    return replace(call, body=mutation.damaged_json(call.body, rng))


def _body(call: Call, calls: list[Call], rng: random.Random) -> Call:
    odd = (b"", b"{", b"[" * 50_000, b'{"a":' * 20_000, b"\xff", b'{"name":"\\ud800"}', b"9" * 5000)
    if call.body and rng.random() < 0.7:
        return replace(call, body=mutation.damaged_bytes(call.body, [], rng)[:1_000_000])
    other = rng.choice(calls).body
    return replace(call, body=rng.choice((*odd, other)))


def _method(call: Call, calls: list[Call], rng: random.Random) -> Call:
    return replace(call, method=rng.choice(METHODS))


def damaged_request(calls: list[Call], rng: random.Random) -> bytes:
    """Bytes of one or two requests, with damage that includes their framing."""
    data = b"".join(rng.choice(calls).data() for _ in range(rng.choice((1, 1, 2))))
    kind = rng.random()
    if kind < 0.1:
        data = data.replace(b"Content-Length", b"Transfer-Encoding: chunked\r\nX-Length")
    elif kind < 0.2:
        length = rng.choice((b"-1", b"0", b"9" * 30, b"1e3", b"5, 6", b"\xff", b"+2", b"00000002"))
        data = data.replace(b"Content-Length: ", b"Content-Length: " + length + b"\r\nX-Length: ")
    elif kind < 0.25:
        return data.replace(b"\r\n", rng.choice((b"\n", b"\r", b"\r\n ")), rng.choice((1, 2, 99)))
    elif kind < 0.3:
        return data.replace(b"HTTP/1.1", rng.choice((b"HTTP/1.0", b"HTTP/2.0", b"HTTP/0.9", b"X")))
    return mutation.damaged_bytes(data, [c.data() for c in rng.sample(calls, 3)], rng)


# --- uploads ----------------------------------------------------------------------------------


@dataclass
class Uploads:
    """Upload forms with mutated splat files."""

    files: list[tuple[str, bytes]] = field(default_factory=list)

    def load(self, folder: Path) -> None:
        """Create the files."""
        for suffix in (".ply", ".spz", ".splat"):
            for parts in readers.splats(suffix)(folder)[:1]:
                path = readers.plain(suffix)(parts, folder)
                self.files.append((f"car{suffix}", path.read_bytes()))

    def call(self, number: int, rng: random.Random) -> Call:
        """An upload with a damaged file, fields or form."""
        name, data = rng.choice(self.files)
        path, fields = "/v1/assets", {"category": "car", "asset_id": f"a{number}"}
        if rng.random() < 0.3:
            path, fields = "/v1/scenes", {"scene": f"s{number}"}
        kind = rng.random()
        if kind < 0.6:
            data = mutation.damaged_bytes(data, [d for _, d in self.files], rng)
        elif kind < 0.8:
            fields[rng.choice((*fields, "length", "up", "x"))] = rng.choice(HOSTILE)
        elif kind < 0.9:
            name = rng.choice((*HOSTILE, "../../x.ply", "x.zip", "x.r2s", "\xff.ply"))
        boundary = "0123456789"
        lines = [
            f'--{boundary}\r\nContent-Disposition: form-data; name="{key}"\r\n\r\n{value}\r\n'
            for key, value in fields.items()
        ]
        head = f'--{boundary}\r\nContent-Disposition: form-data; name="file"; filename="{name}"'
        body = "".join([*lines, head, "\r\n\r\n"]).encode("latin-1", "replace") + data
        body += f"\r\n--{boundary}--\r\n".encode()
        if kind >= 0.9:
            body = mutation.damaged_bytes(body, [], rng)
        headers = (("Content-Type", f"multipart/form-data; boundary={boundary}"),)
        return Call("POST", path, (), headers, body[: 4 << 20])


# --- responses --------------------------------------------------------------------------------


def answered(site: Site, data: bytes, *, whole: bool, rng: random.Random) -> str:
    """Send a request. Returns a word that is equal for equal responses.

    Args:
        site: receives the request.
        data: bytes of the request.
        whole: whether the framing is valid, so that a response is required.
        rng: decides whether the client disconnects before the response.

    Raises:
        AssertionError: a healthy worker does not give this response.
    """
    with site.connected() as connection:
        connection.sendall(data)
        if rng.random() < 0.03:
            return "left"
        connection.settimeout(DEAD_S if whole else QUIET_S)
        try:
            answer = _received(connection, data.startswith(b"HEAD "))
        except TimeoutError:
            assert not whole, "no answer"
            return "silence"
        except ConnectionResetError:
            return "reset"
    if not answer:
        assert not whole, "closed without an answer"
        return "closed"
    return _checked(answer)


def _received(connection: Any, is_head: bool) -> bytes:
    answer, ended = b"", time.monotonic() + DEAD_S
    while time.monotonic() < ended:
        part = connection.recv(1 << 16)
        answer += part
        head, gap, body = answer.partition(b"\r\n\r\n")
        if head.startswith(b"HTTP/1.1 100") and gap:
            answer = body
            continue
        if not part or (gap and (is_head or _is_complete(head.lower(), body))):
            return answer
    raise TimeoutError


def _is_complete(head: bytes, body: bytes) -> bool:
    for line in head.split(b"\r\n")[1:]:
        name, _, value = line.partition(b":")
        if name == b"content-length":
            return len(body) >= int(value)
        if name == b"content-type" and b"event-stream" in value:
            return True
    status = head.split(b" ", 2)[1]
    return status in (b"204", b"304") or body.endswith(b"0\r\n\r\n")


def _checked(answer: bytes) -> str:
    head, _, body = answer.partition(b"\r\n\r\n")
    status = int(head.split(b" ", 2)[1])
    if status < 400:
        return f"{status}"
    if not body:
        assert status < 500, answer[:2000]
        return f"{status}"
    assert b"application/problem+json" in head, answer[:2000]
    problem = json.loads(body[: _length(head)])
    assert problem["status"] == status, answer[:2000]
    assert status < 500 or problem["code"] in BUSY, answer[:2000]
    return f"{status} {problem['code']} {mutation.shape_of(problem['detail'])}"


def _length(head: bytes) -> int | None:
    for line in head.lower().split(b"\r\n"):
        if line.startswith(b"content-length:"):
            return int(line.split(b":")[1])
    return None
