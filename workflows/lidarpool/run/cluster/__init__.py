"""Clusters for runs, which are started or connected to, checked and monitored."""
