"""What a store holds of secrets: hashes, and answers that only their asker can read."""

from __future__ import annotations

import hashlib
import os
import secrets
from pathlib import Path

KEY_FILE = "worker.key"
KEY_BYTES = 32
NONCE_BYTES = 16

_SEALED = b"\x01"
"""First byte of a sealed body; one that is not sealed is JSON."""


def token_hash(token: str) -> str:
    """What is kept of a token. It has 192 random bits: nobody can guess it from its hash."""
    return hashlib.sha256(b"token:" + token.encode()).hexdigest()


def sealed(body: bytes, secret: str) -> bytes:
    """A body that only the holder of ``secret`` can read; the store has the secret as a hash."""
    nonce = secrets.token_bytes(NONCE_BYTES)
    return _SEALED + nonce + _masked(body, nonce, secret)


def unsealed(stored: bytes, secret: str) -> bytes:
    """The body that was sealed with ``secret``."""
    if not stored.startswith(_SEALED):
        return stored
    nonce = stored[1 : 1 + NONCE_BYTES]
    return _masked(stored[1 + NONCE_BYTES :], nonce, secret)


def _masked(body: bytes, nonce: bytes, secret: str) -> bytes:
    mask = hashlib.shake_256(b"reply:" + nonce + secret.encode()).digest(len(body))
    size = len(body)
    both = int.from_bytes(body, "little") ^ int.from_bytes(mask, "little")
    return both.to_bytes(size, "little")


def worker_key(folder: Path) -> bytes:
    """The key of a state folder, made the first time; only its owner can read it.

    Raises:
        OSError: the folder cannot be written to.
    """
    path = folder / KEY_FILE
    if path.is_file() and len(known := path.read_bytes()) == KEY_BYTES:
        return known
    key = secrets.token_bytes(KEY_BYTES)
    temporary = folder / f".{KEY_FILE}.tmp-{secrets.token_hex(6)}"
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(key)
        file.flush()
        os.fsync(descriptor)
    temporary.replace(path)
    return key
