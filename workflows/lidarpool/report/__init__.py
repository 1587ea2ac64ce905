"""Reports, plots and output folders of results."""
