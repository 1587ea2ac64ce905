"""Readers for clouds and recordings in all supported formats."""
