"""Cast the rays of a survey into a scene with moving actors, and look up the surfaces they hit."""
