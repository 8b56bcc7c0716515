"""Long-running work: jobs reply immediately, report progress, and store their results."""
