"""The cluster of a run: clients, started clusters, checks, and loss of workers."""
