"""Foundations of the other rooms: errors, arrays, files, validation, words."""
