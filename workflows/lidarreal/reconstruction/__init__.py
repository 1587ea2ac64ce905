"""Reconstruct static scenes from recordings, so that the scenes can be scanned again."""
