"""Fingerprints, checksums and versions, which identify files and results."""
