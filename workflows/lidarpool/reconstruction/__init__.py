"""Reconstruct static scenes from recordings, so that they can be scanned again."""
