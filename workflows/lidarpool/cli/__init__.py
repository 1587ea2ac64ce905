"""The `lidarpool` command-line interface."""
