"""Voxel grids with the true classes of a scene, and the voxels that a sweep observes."""

from .grid import FREE, GridFrame, Occupancy, VoxelGrid
from .sweep_occupancy import OccupancySimulator

__all__ = ["FREE", "GridFrame", "Occupancy", "OccupancySimulator", "VoxelGrid"]
