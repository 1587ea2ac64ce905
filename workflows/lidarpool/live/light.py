"""Light on a page, under which the colours of a surface are those of its bar."""

from __future__ import annotations

from .page import LivePage

# Together pi at most: more than that is paler than the colour itself. viser's own are three times
# as bright from above, where a floor of any colour is nearly white.
_AROUND, _SUN = 0.9, 2.4
_FROM = (0.15, -0.75, 1.2)  # left of the camera's first place, so that no two sides look alike


def light_evenly(page: LivePage) -> None:
    """Replace the lights of a page."""
    page.scene.configure_environment_map(None)
    page.scene.configure_default_lights(enabled=False, cast_shadow=False)
    page.scene.add_light_ambient("/light/around", intensity=_AROUND)
    page.scene.add_light_directional("/light/sun", intensity=_SUN, position=_FROM)
