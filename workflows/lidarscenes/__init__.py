"""Add scene formats, robots, procedural scenes, and importers for other programs to lidarsim."""
