"""Shared by all HTTP replies: errors, authorisation, idempotency, metrics."""
