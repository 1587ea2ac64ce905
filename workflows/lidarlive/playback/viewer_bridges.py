"""Bridges that send sweeps to viewers, for `--as foxglove` and `--as rerun`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lidarfiles.clouds.shown_sweeps import Surroundings, SweepSequence
from lidarfiles.picture_file import PictureContent
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.sweeps.sweeps import Sweeps

from ..viewers.viewer import Viewer, check_installed, open_viewer
from .bridge import Bridge, BridgeOptions
from .schedule import Schedule


class ViewerBridge(Bridge):
    """Bridge that sends sweeps with their frames and boxes to the viewer `name`."""

    name: str

    def __init__(
        self,
        sweeps: Sweeps,
        schedule: Schedule,
        options: BridgeOptions,
        note: Callable[[str], None],
    ) -> None:
        super().__init__(sweeps, schedule, options, note)
        if len(options.to) > 1:
            raise LidarError(
                f"`--to` was passed {len(options.to)} times, but {self.name} listens on a "
                "single address."
            )
        self._sequence = SweepSequence(sweeps)
        self._viewer = self._open(*options.to)

    @classmethod
    def check_installed(cls) -> None:
        """Raise LidarError if the package that the viewer requires is not installed."""
        check_installed(cls.name)

    def _open(self, to: str | None = None) -> Viewer:
        return open_viewer(self.name, to)

    @property
    def description(self) -> str:
        """Address at which users open the viewer. It is part of the "ready" message."""
        return self._viewer.description

    def show_content(self, content: Callable[[], PictureContent | None]) -> None:
        """Show the trajectories, the scene and the planned path."""
        self._viewer.show_surroundings(Surroundings.from_sweeps(self.sweeps, content()))

    def send(self, sweep: int, points: Cloud, shift_ns: int) -> None:
        """Send a sweep.

        With `--loop`, its times are `shift_ns` later than in the survey.
        """
        shown = self._sequence.shown_sweep(sweep, points)
        times = {name: getattr(shown, name) + shift_ns for name in ("start_ns", "stamp_ns")}
        self._viewer.show_sweep(replace(shown, **times))

    def __exit__(self, *error: object) -> None:
        """Stop the viewer's server."""
        self._viewer.close()


class FoxgloveBridge(ViewerBridge):
    """Bridge that sends sweeps to Foxglove. The clock of Foxglove shows the sweep times."""

    name = "foxglove"

    def _open(self, to: str | None = None) -> Viewer:
        return open_viewer(self.name, to, sends_time=True)


class RerunBridge(ViewerBridge):
    """Bridge that sends sweeps to Rerun."""

    name = "rerun"
