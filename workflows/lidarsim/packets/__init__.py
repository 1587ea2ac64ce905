"""Encode sweeps as sensor packets in the manufacturers' protocols, and decode these packets."""
