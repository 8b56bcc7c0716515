"""What every HTTP answer shares: errors, authorisation, idempotency, metrics."""
