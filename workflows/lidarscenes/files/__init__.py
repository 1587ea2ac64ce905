"""Read OpenUSD, COLLADA, 3MF, IFC, CityJSON, AMAPVox, and elevation rasters."""
