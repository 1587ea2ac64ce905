"""Add scene formats, robots, procedural scenes, and importers for other simulators to lidarsim."""
