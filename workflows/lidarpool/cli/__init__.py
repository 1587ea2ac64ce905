"""The command `lidarpool`."""
