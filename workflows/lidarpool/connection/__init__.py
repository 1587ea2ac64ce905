"""Addresses and certificates for connections to a Dask cluster."""
