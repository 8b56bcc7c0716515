"""The protocol between a Real2Sim worker and its clients.

Each module has the models of one concept: ``operations``, ``scenes``, ``scenarios``,
``sessions``, ``drive``, ``errors``. ``codec`` encodes and decodes drive messages.
"""

from .codec import CodecError, decode, encode
from .conventions import (
    CONVENTIONS,
    DRIVE_SUBPROTOCOL,
    PROTOCOL_VERSION,
    SEMANTIC_CLASSES,
    SUPPORTED_SUBPROTOCOLS,
    protocol_mismatch,
)
from .errors import HTTP_STATUS, PROBLEM_MEDIA_TYPE, RETRYABLE, ErrorCode, Problem, ProblemDetail

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
