"""The store of a run: its database, its parts, and its jobs in flight."""
