"""Write scenes as mesh files, and imported lidars as scenarios."""
