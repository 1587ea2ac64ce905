"""Send sweeps to a Rerun server, to which browser and desktop viewers connect."""

from __future__ import annotations

import subprocess
import sys

import rerun as rr

from lidarfiles.clouds.rrd import APPLICATION, RerunLog
from lidarfiles.clouds.shown_sweeps import ShownSweep, Surroundings
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats

from . import attached_child
from .viewer import Address, Viewer

PORT = 9876  # default port of Rerun
_READY_S = 20.0


class RerunServer(Viewer):
    """Rerun server in a separate process, which also serves a viewer page for browsers.

    Parameters
    ----------
    to
        Address and port to listen on, as ADDRESS:PORT. The page is served on the next port. By
        default, the port is 9876 on 127.0.0.1, or another port if it is in use.
    title
        Name of the recording in Rerun.

    Raises
    ------
    LidarError
        If the address cannot be used, or if the server does not start.
    """

    def __init__(self, to: str | None = None, title: str = "lidarpool") -> None:
        address = Address.choose(to, PORT, count=2)
        page = Address(address.host, address.port + 1)
        # `RecordingStream.serve_grpc` would listen on all interfaces.
        command = ["--serve-web", "--bind", address.host, "--port", f"{address.port}"]
        command += ["--web-viewer-port", f"{page.port}", "--hide-welcome-screen"]
        self._process = subprocess.Popen(
            [sys.executable, attached_child.__file__, sys.executable, "-m", "rerun", *command],
            stdin=subprocess.PIPE,  # is closed when this process exits, which stops the server
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C only interrupts this process, which stops the server
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
        """Replace the scene, trajectories and planned path."""
        self._log.show_surroundings(surroundings)

    def show_path(self, path: Floats) -> None:
        """Show a planned path in world coordinates, in meters.

        The path has shape (w, 3).
        """
        self._log.show_path(path)

    def show_sweep(self, shown: ShownSweep) -> None:
        """Show a sweep's points, frames and actor boxes without waiting for viewers."""
        self._log.show_sweep(shown)

    def close(self) -> None:
        """Send the pending messages, and stop the server."""
        self._recording.disconnect()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
