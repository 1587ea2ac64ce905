"""Identities of runs and results, which include fingerprints, software versions and checksums."""
