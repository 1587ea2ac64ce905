"""Bits that mark voxels that rays observe."""

TRAVERSED = 1  # a ray passes through the voxel
HIT = 2  # a ray hits a surface in the voxel
