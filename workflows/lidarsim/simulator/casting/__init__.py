"""Casting: rays of a survey against a scene whose actors move, and the surfaces that they hit."""
