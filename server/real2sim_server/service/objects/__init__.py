"""Objects that workers share: bundles of scenes and assets, and what jobs leave, by content."""
