"""Read OpenUSD, COLLADA, 3MF, IFC, CityJSON, and AMAPVox files, and elevation rasters."""
