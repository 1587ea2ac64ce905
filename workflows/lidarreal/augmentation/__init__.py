"""Simulate weather, faults, noise and inserted objects on recorded sweeps."""
