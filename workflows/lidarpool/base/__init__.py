"""Helpers that all packages of lidarpool use, such as fingerprints, shards and the timeline."""
