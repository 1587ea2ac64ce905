"""Programs that draw the plots and animations in the documentation.

Each module runs with `python -m docs.pictures.NAME`.
"""
