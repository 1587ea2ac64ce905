"""Recorded sweeps: comparison, fitted sensors, simulated weather, and reconstructed scenes."""
