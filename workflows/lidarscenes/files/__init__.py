"""Readers of OpenUSD, Collada, 3MF, MagicaVoxel, rasters of heights and CityJSON."""
