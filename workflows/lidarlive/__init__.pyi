from .playback.live import play as play
from .viewers.scanner_view import Foxglove as Foxglove
from .viewers.scanner_view import Rerun as Rerun

__all__ = [
    "Foxglove",
    "Rerun",
    "play",
]
