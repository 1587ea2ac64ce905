"""Write scenes as mesh files, and lidars from other programs as scenarios."""
