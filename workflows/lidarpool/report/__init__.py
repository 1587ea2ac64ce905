"""Reports, pictures and output folders of results."""
