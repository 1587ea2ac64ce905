"""Readers for clouds and recordings in any supported format."""
