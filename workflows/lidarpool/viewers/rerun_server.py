"""Sends sweeps to a server of Rerun, which viewers in browsers and on desktops open."""

from __future__ import annotations

import subprocess
import sys

import rerun as rr

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats

from ..clouds.rrd import APPLICATION, RerunLog
from ..clouds.shown_sweeps import ShownSweep, Surroundings
from . import attached_child
from .viewer import Address, Viewer

PORT = 9876  # Rerun's own default
_READY_S = 20.0


class RerunServer(Viewer):
    """A server of Rerun in a separate process, and the page of its viewer for browsers.

    Parameters
    ----------
    to
        ADDRESS:PORT to listen on, the page of the viewer on the port after it; by default
        127.0.0.1:9876, or another port if it is in use.
    title
        Name of the recording in Rerun.

    Raises
    ------
    LidarError
        If the address cannot be used, or the server does not start.
    """

    def __init__(self, to: str | None = None, title: str = "lidarpool") -> None:
        address = Address.choose(to, PORT, count=2)
        page = Address(address.host, address.port + 1)
        # `RecordingStream.serve_grpc` would listen on all interfaces.
        command = ["--serve-web", "--bind", address.host, "--port", f"{address.port}"]
        command += ["--web-viewer-port", f"{page.port}", "--hide-welcome-screen"]
        self._process = subprocess.Popen(
            [sys.executable, attached_child.__file__, sys.executable, "-m", "rerun", *command],
            stdin=subprocess.PIPE,  # whose end tells the server that this process is gone
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process, which ends the server
        )
        self._recording = rr.RecordingStream(APPLICATION)
        try:
            address.wait_until_open(_READY_S, lambda: self._process.poll() is None)
            source = f"rerun+http://{address}/proxy"
            self._recording.connect_grpc(source)
        except LidarError:
            self.close()
            raise
        self._recording.send_recording_name(title)
        self._log = RerunLog(self._recording)
        self.description = (
            f"Rerun is available at http://{page}/?url={source} or with the command rerun {source}"
        )

    def show_surroundings(self, surroundings: Surroundings) -> None:
        """Show scene, trajectories and path in place of earlier surroundings."""
        self._log.show_surroundings(surroundings)

    def show_path(self, path: Floats) -> None:
        """Show a planned path, (w, 3), meters, world coordinates."""
        self._log.show_path(path)

    def show_sweep(self, shown: ShownSweep) -> None:
        """Show the points of a sweep, its frames and its boxes of actors, and return at once."""
        self._log.show_sweep(shown)

    def close(self) -> None:
        """Send waiting messages, and end the server."""
        self._recording.disconnect()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
