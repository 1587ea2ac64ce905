"""Draw images and films of scenes and point clouds, and serve them as browser pages."""

from lidarsim.environment.notebook import register_drawers

# Notebooks show these objects with a plot. The drawing code is imported for the first plot.
register_drawers(
    {
        name: f"lidarview.cell_pictures:draw_{name.lower()}"
        for name in ("Cloud", "Scene", "Sensor", "StoredCloud", "Survey")
    }
)
