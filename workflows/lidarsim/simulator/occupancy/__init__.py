"""Voxel grids with the true classes of a scene, and what the rays of a sweep observe."""

from .grid import FREE, GridFrame, Occupancy, VoxelGrid
from .sweep_occupancy import OccupancySimulator

__all__ = ["FREE", "GridFrame", "Occupancy", "OccupancySimulator", "VoxelGrid"]
