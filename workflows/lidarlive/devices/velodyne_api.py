"""Web interface of a live Velodyne sensor, which reports its state and sets the receiver.

Sources: user manual of the VLP-16 (63-9243), sections "Web Interface" and "Sensor Control with
curl"; drivers that use the interface (Autoware's velodyne_monitor and nebula). Clients can only set
the receiver and switch the laser on or off. Other properties of the simulated sensor cannot be
changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qsl

from lidarsim.environment.ports import port_number
from lidarsim.packets.service import Destination

from .http_service import (
    Answer,
    HttpService,
    Request,
    RequestRefusedError,
    receiver_of,
    receiver_port,
)

_PORTS = ("dport", "tport")  # ports of data and position packets


@dataclass(frozen=True)
class VelodyneState:
    """Properties of a sensor that the web interface reports."""

    model: str
    serial: str
    return_mode: str  # Strongest, Last or Dual
    rpm: int
    pps_state: str  # Locked or Absent


class VelodyneApi(HttpService):
    """Service that answers requests such as `cgi/status.json` and `cgi/setting/host`.

    The latter sets the receiver of the packets.

    Parameters
    ----------
    address, destination, send_to
        As in `HttpService`.
    state
        Properties that the interface reports.
    ports
        Ports of the data and position packets.
    """

    name = "Velodyne's web interface"

    def __init__(
        self,
        address: str,
        destination: Destination,
        send_to: Callable[[Destination], None],
        state: VelodyneState,
        ports: tuple[int, int],
    ) -> None:
        super().__init__(address, destination, send_to)
        self._state = state
        self._ports = ports
        numbers = [destination.ports.get(port, port) for port in ports]
        self._host = destination.host
        self._host_ports = dict(zip(_PORTS, numbers, strict=True))
        self._laser = "On"

    def answer(self, request: Request) -> Answer:
        """Return the response to a request.

        Raises RequestRefusedError if the sensor does not provide the requested resource.
        """
        documents: dict[str, Callable[[], Mapping[str, Any]]] = {
            "/cgi/info.json": self._info,
            "/cgi/status.json": self._status,
            "/cgi/settings.json": self._settings,
            "/cgi/snapshot.hdl": lambda: {"config": self._settings(), "info": self._info()},
        }
        if request.method in ("GET", "HEAD") and request.path in documents:
            return Answer(documents[request.path]())
        if request.method != "POST" or not request.path.startswith("/cgi/"):
            raise RequestRefusedError(f"there is no {request.path}", HTTPStatus.NOT_FOUND)
        values = dict(parse_qsl(request.body.decode("latin-1"), keep_blank_values=True))
        if request.path == "/cgi/setting/host":
            self._set_receiver(values)
        elif request.path == "/cgi/setting":
            self._set(values)
        elif request.path != "/cgi/save":
            raise RequestRefusedError(f"{request.path} cannot be set", HTTPStatus.NOT_FOUND)
        return Answer(status=HTTPStatus.NO_CONTENT)

    def _info(self) -> Mapping[str, Any]:
        return {
            "mac_addr": "02-00-00-00-00-01",
            "model": self._state.model,
            "serial": self._state.serial,
            "version": {"sensor": {"application": "lidarpool"}},
        }

    def _status(self) -> Mapping[str, Any]:
        return {
            "gps": {"pps_state": self._state.pps_state, "position": ""},
            "motor": {"state": "On", "rpm": self._state.rpm, "lock": "Off", "phase": 0},
            "laser": {"state": self._laser},
        }

    def _settings(self) -> Mapping[str, Any]:
        return {
            "returns": self._state.return_mode,
            "rpm": str(self._state.rpm),
            "laser": self._laser,
            "fov": {"start": "0", "end": "359"},
            "phaselock": {"enabled": "Off", "offset": "0"},
            "host": {"addr": self._host, **{k: str(v) for k, v in self._host_ports.items()}},
            "net": {"addr": self.host, "dhcp": "Off"},
        }

    def _set_receiver(self, values: Mapping[str, str]) -> None:
        """Change the receiver of the packets."""
        host = self._host
        ports = dict(self._host_ports)
        for name, value in values.items():
            if name == "addr":
                host = receiver_of(name, value)
            elif name in ports:
                ports[name] = receiver_port(name, port_number(value))
            else:
                raise RequestRefusedError(f"the host has no {name}")
        self._host = host
        self._host_ports = ports
        self._apply()

    def _set(self, values: Mapping[str, str]) -> None:
        """Switch the laser on or off.

        Raises RequestRefusedError if another setting would change.
        """
        current = {"returns": self._state.return_mode, "rpm": str(self._state.rpm)}
        laser = self._laser
        for name, value in values.items():
            if name == "laser" and value.title() in ("On", "Off"):
                laser = value.title()
            elif name not in current:
                raise RequestRefusedError(f"there is no setting {name}")
            elif value != current[name]:
                raise RequestRefusedError(
                    f"{name} is {current[name]} in this simulated sensor. Set it in the scenario"
                )
        if laser != self._laser:
            self._laser = laser
            self._apply()

    def _apply(self) -> None:
        """Send packets to the receiver, or stop sending if the laser is off."""
        numbers = [0, 0] if self._laser == "Off" else [*self._host_ports.values()]
        ports = dict(zip(self._ports, numbers, strict=True))
        self.destination = Destination(self._host, ports)
        self.send_to(self.destination)
