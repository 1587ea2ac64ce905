"""Serve simulated sweeps to simulators over gRPC."""
