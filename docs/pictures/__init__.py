"""Pictures and films of the documentation; each module runs with `python -m docs.pictures.NAME`."""
