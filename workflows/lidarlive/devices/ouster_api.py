"""Configuration interface of a live Ouster sensor: the HTTP API of firmware 3.0 and 3.1.

Sources: sensor_http_imp.cpp, client.cpp and sensor_packet_source.cpp in ouster-sdk 1.0.1; the HTTP
API documentation of the firmware. Clients can only set whether packets are sent and to which
destination. Other properties of the simulated sensor cannot be changed.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs

from lidarsim.packets.service import Destination

from .http_service import (
    Answer,
    HttpService,
    Request,
    RequestRefusedError,
    receiver_of,
    receiver_port,
)

_ROOT = "/api/v1/"
_AUTO = "@auto"  # placeholder for the address of the client
_PORTS = ("udp_port_lidar", "udp_port_imu")
_MODES = ("NORMAL", "STANDBY")


class OusterApi(HttpService):
    """Service that answers requests of ouster-sdk, ouster-cli and ROS drivers.

    Parameters
    ----------
    address, destination, send_to
        As in `HttpService`.
    metadata
        Result of `OusterEncoder.metadata`.
    ports
        Ports of the lidar and IMU datagrams.
    """

    name = "Ouster's HTTP API"

    def __init__(
        self,
        address: str,
        destination: Destination,
        send_to: Callable[[Destination], None],
        metadata: Mapping[str, Any],
        ports: tuple[int, int],
    ) -> None:
        super().__init__(address, destination, send_to)
        self._metadata = metadata
        self._ports = ports
        numbers = [destination.ports.get(port, port) for port in ports]
        self._active: dict[str, Any] = {
            "operating_mode": "NORMAL",
            **metadata["config_params"],
            "udp_dest": destination.host,
            **dict(zip(_PORTS, numbers, strict=True)),
        }
        self._staged = self._active
        self._user_data = ""

    def answer(self, request: Request) -> Answer:
        """Return the response to a request.

        Raises RequestRefusedError if the sensor does not provide the requested resource.
        """
        path = request.path.rstrip("/")
        if not path.startswith(_ROOT):
            raise RequestRefusedError("the interface is at /api/v1", HTTPStatus.NOT_FOUND)
        resource = path.removeprefix(_ROOT)
        if resource == "sensor/config":
            return self._config(request)
        if resource == "user/data":
            return self._user(request)
        if resource.startswith("sensor/cmd/"):
            return self._command(resource.removeprefix("sensor/cmd/"), request)
        if request.method not in ("GET", "HEAD"):
            raise RequestRefusedError(
                f"{resource} cannot be changed", HTTPStatus.METHOD_NOT_ALLOWED
            )
        return Answer(self._document(resource))

    def changes_state(self, method: str, path: str) -> bool:
        """Return whether a request may change the state, as most commands do even with GET."""
        command = path.rstrip("/").removeprefix(f"{_ROOT}sensor/cmd/")
        is_command = command != path.rstrip("/") and command != "get_config_param"
        return is_command or super().changes_state(method, path)

    def _document(self, resource: str) -> Any:
        """Return a document that clients can read."""
        whole = {**self._metadata, "config_params": self._active}
        sensor = whole["sensor_info"]
        if resource == "sensor/metadata":
            return whole
        kind = resource.removeprefix("sensor/metadata/")
        if kind != resource and kind in whole:
            return whole[kind]
        now_s = time.time()
        documents: dict[str, Any] = {
            "system/firmware": {"fw": sensor["image_rev"], "commit_pending": False},
            "system/network": {
                "platform": True,
                "duplex": "full",
                "ethaddr": "02:00:00:00:00:01",
                "hostname": f"os-{sensor['prod_sn']}",
                "ipv4": {"addr": f"{self.host}/8", "link_local": None, "override": None},
                "ipv6": {"link_local": None},
                "speed": 1000,
                "speed_override": None,
            },
            "time/system": {"monotonic": time.monotonic(), "realtime": now_s},
            "sensor/telemetry": {"phase_lock_status": "DISABLED", "timestamp_ns": int(now_s * 1e9)},
            "sensor/alerts": {"active": [], "log": []},
        }
        if resource not in documents:
            raise RequestRefusedError(f"there is no {resource}", HTTPStatus.NOT_FOUND)
        return documents[resource]

    def _user(self, request: Request) -> Answer:
        """Return or change the user data that are stored in the sensor."""
        if request.method == "PUT":
            text = _json(request.body)
            if not isinstance(text, str):
                raise RequestRefusedError("user data must be text")
            self._user_data = text
            return Answer(status=HTTPStatus.NO_CONTENT)
        if request.method == "DELETE":
            self._user_data = ""
            return Answer(status=HTTPStatus.NO_CONTENT)
        if "include_metadata" in parse_qs(request.query):
            return Answer({"policy": "clear_on_config_delete", "value": self._user_data})
        return Answer(self._user_data)

    def _config(self, request: Request) -> Answer:
        """Return or change the configuration in the same way as firmware 3.1."""
        options = {name: values[-1].lower() for name, values in parse_qs(request.query).items()}
        if request.method in ("GET", "HEAD"):
            return Answer(self._staged if options.get("staging") == "true" else self._active)
        if request.method == "DELETE":
            raise RequestRefusedError(
                "the configuration cannot be deleted", HTTPStatus.METHOD_NOT_ALLOWED
            )
        self._stage(_json(request.body) if request.body else {}, request.peer)
        if options.get("reinit", "true") == "true":
            self._apply()
        return Answer(status=HTTPStatus.NO_CONTENT)

    def _command(self, command: str, request: Request) -> Answer:
        """Execute a command in the same way as firmware 3.0 and earlier."""
        arguments = parse_qs(request.query).get("args", [""])[-1]
        if command == "get_config_param":
            if arguments not in ("active", "staged"):
                raise RequestRefusedError("args must be active or staged")
            return Answer(self._active if arguments == "active" else self._staged)
        if command == "set_config_param":
            name, _, value = arguments.partition(" ")  # parse_qs decodes + as a space
            values = _json(value.encode()) if value.startswith(("{", '"')) else _loose(value)
            self._stage(values if name == "." else {name: values}, request.peer)
            return Answer("set_config_param")
        if command == "set_udp_dest_auto":
            self._stage({"udp_dest": _AUTO}, request.peer)
        elif command == "reinitialize":
            self._apply()
        elif command != "save_config_params":
            raise RequestRefusedError(f"there is no command {command}", HTTPStatus.NOT_FOUND)
        return Answer({})

    def _stage(self, values: Any, peer: str) -> None:
        """Change the staged configuration.

        Raises RequestRefusedError if a parameter cannot be set.
        """
        if not isinstance(values, dict):
            raise RequestRefusedError("the body must be a JSON object of parameters")
        staged = dict(self._staged)
        for name, value in values.items():
            if name == "udp_dest":
                staged[name] = peer if value == _AUTO else receiver_of(name, value)
            elif name in _PORTS:
                staged[name] = receiver_port(name, value)
            elif name == "operating_mode" and value in _MODES:
                staged[name] = value
            elif name not in staged:
                raise RequestRefusedError(f"there is no parameter {name}")
            elif value != staged[name]:
                raise RequestRefusedError(
                    f"{name} is {staged[name]} in this simulated sensor. Set it in the scenario"
                )
        self._staged = staged

    def _apply(self) -> None:
        """Activate the staged configuration, and send packets to its destination."""
        self._active = self._staged
        numbers = [self._active[name] for name in _PORTS]
        if self._active["operating_mode"] == "STANDBY":
            numbers = [0, 0]
        ports = dict(zip(self._ports, numbers, strict=True))
        self.destination = Destination(self._active["udp_dest"], ports)
        self.send_to(self.destination)


def _json(body: bytes) -> Any:
    """Parse JSON, or raise RequestRefusedError if it is invalid."""
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise RequestRefusedError("the body is not valid JSON") from error


def _loose(value: str) -> Any:
    """Parse an argument as a number or a Boolean value, or return it as text."""
    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        return value
