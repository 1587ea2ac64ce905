"""Render scenes with the project's own ray caster and draw points over them."""
