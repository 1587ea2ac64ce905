"""Light on a page, under which the colours of a surface are those of its bar."""

from __future__ import annotations

from .page import LivePage

# About pi in all: under more than that colours are paler than they are. viser's own lights make a
# floor of any colour nearly white.
_AROUND, _SUN = 1.3, 2.0
_FROM = (0.15, -0.75, 1.2)  # left of the camera's first place, so that no two sides look alike


def light_evenly(page: LivePage) -> None:
    """Replace the lights of a page."""
    page.scene.configure_environment_map(None)
    page.scene.configure_default_lights(enabled=False, cast_shadow=False)
    page.scene.add_light_ambient("/light/around", intensity=_AROUND)
    page.scene.add_light_directional("/light/sun", intensity=_SUN, position=_FROM)
