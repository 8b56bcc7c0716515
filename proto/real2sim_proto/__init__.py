"""The contract between a Real2Sim worker and everyone who talks to it.

Models live in the module of their concept: ``operations``, ``scenes``, ``scenarios``,
``sessions``, ``drive``, ``errors``; ``codec`` turns drive messages into bytes and back.
"""

from .codec import CodecError, decode, encode
from .conventions import CONVENTIONS
from .errors import HTTP_STATUS, PROBLEM_MEDIA_TYPE, RETRYABLE, ErrorCode, Problem, ProblemDetail
from .semantics import SEMANTIC_CLASSES
from .version import DRIVE_SUBPROTOCOL, PROTOCOL_VERSION, SUPPORTED_SUBPROTOCOLS, protocol_mismatch

__all__ = [
    "CONVENTIONS",
    "DRIVE_SUBPROTOCOL",
    "HTTP_STATUS",
    "PROBLEM_MEDIA_TYPE",
    "PROTOCOL_VERSION",
    "RETRYABLE",
    "SEMANTIC_CLASSES",
    "SUPPORTED_SUBPROTOCOLS",
    "CodecError",
    "ErrorCode",
    "Problem",
    "ProblemDetail",
    "decode",
    "encode",
    "protocol_mismatch",
]
