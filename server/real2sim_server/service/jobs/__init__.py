"""Long work: it answers at once, reports as it goes, and keeps its result."""
