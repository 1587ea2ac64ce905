"""The report as a page: one HTML file that opens anywhere and asks for nothing."""

from .page import write_page
from .recipe import Recipe, make_recipe

__all__ = ["Recipe", "make_recipe", "write_page"]
