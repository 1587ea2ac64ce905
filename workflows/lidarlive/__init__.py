"""Programs that send and receive sweeps while they run."""

from lidarsim.environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        ".playback.live": "play",
        ".viewers.scanner_view": "Foxglove Rerun",
    },
)
