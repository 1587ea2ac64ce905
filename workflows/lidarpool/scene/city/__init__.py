"""A made-up city of any size: streets, houses, towers, trees, cars."""

from .city import city

__all__ = ["city"]
