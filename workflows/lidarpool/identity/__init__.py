"""Identity of runs and results: content fingerprints, software versions, checksums and shards."""
