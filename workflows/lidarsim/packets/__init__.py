"""Packets that sensors send: returns of sweeps in the protocols of their makers."""
