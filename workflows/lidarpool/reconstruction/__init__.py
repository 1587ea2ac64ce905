"""Places that are rebuilt from recordings, to be scanned again: twins."""
