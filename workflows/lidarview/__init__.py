"""Pictures, films and pages of scenes and points."""

from lidarsim.base.notebook import draw_with

# Notebooks show these objects with a picture; whatever draws is imported with the first.
draw_with(
    {
        name: f"lidarview.cell_pictures:draw_{name.lower()}"
        for name in ("Cloud", "Scene", "Sensor", "StoredCloud", "Survey")
    }
)
