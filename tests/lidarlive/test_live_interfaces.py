"""Interfaces of live sensors over HTTP: Ouster's and Velodyne's, and clients that do not behave."""

from __future__ import annotations

import http.client
import json
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from urllib.parse import quote

import pytest

from lidarlive.devices import http_service
from lidarlive.devices.services import service_of
from lidarsim import LidarError, load_sensor
from lidarsim.packets.encoders import PacketSource, encoder_of
from lidarsim.packets.service import Destination


@contextmanager
def interface(model, mode="strongest", address="127.0.0.1:0"):
    """Yield the interface of a sensor, and the list of destinations that it has asked for."""
    encoder = encoder_of(PacketSource(load_sensor(model), mode, "roof"))
    asked = []
    destination = Destination("127.0.0.1", {port: port for port in encoder.ports.values()})
    with service_of(encoder, address, destination, asked.append) as service:
        yield service, asked


def ask(service, method, path, body=None, headers=None):
    """Return status and data of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", service.port, timeout=10)
    connection.request(method, path, body, headers or {})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, json.loads(content) if content else None


def raw(service, content, timeout_s=10.0):
    """Send bytes, and return the bytes of the answer."""
    with socket.create_connection(("127.0.0.1", service.port), timeout_s) as connection:
        connection.sendall(content)
        answer = b""
        while received := connection.recv(65_536):
            answer += received
    return answer


def test_ouster_sends_where_a_client_of_firmware_3_1_asks():
    with interface("ouster/os1-64") as (service, asked):
        _, information = ask(service, "GET", "/api/v1/sensor/metadata/sensor_info")
        assert information["prod_line"] == "OS-1-64"
        assert information["image_rev"].endswith("v3.1.0")
        assert ask(service, "GET", "/api/v1/system/firmware")[1]["fw"] == information["image_rev"]
        _, config = ask(service, "GET", "/api/v1/sensor/config")
        assert (config["udp_dest"], config["udp_port_lidar"]) == ("127.0.0.1", 7502)
        staging = "/api/v1/sensor/config?staging=true&reinit=false&persist=false"
        changed = {**config, "udp_dest": "127.0.0.7", "udp_port_lidar": 7602}
        assert ask(service, "POST", staging, json.dumps(changed)) == (204, None)
        assert ask(service, "GET", "/api/v1/sensor/config")[1] == config
        assert ask(service, "GET", "/api/v1/sensor/config?staging=true")[1] == changed
        assert not asked
        reinitialize = "/api/v1/sensor/config?staging=true&reinit=true&persist=false"
        assert ask(service, "POST", reinitialize, "{}") == (204, None)
        assert asked == [Destination("127.0.0.7", {7502: 7602, 7503: 7503})]
        assert ask(service, "GET", "/api/v1/sensor/metadata")[1]["config_params"] == changed
        standby = json.dumps({"operating_mode": "STANDBY"})
        assert ask(service, "POST", "/api/v1/sensor/config", standby)[0] == 204
        assert asked[-1] == Destination("127.0.0.7", {7502: 0, 7503: 0})


def test_ouster_finds_the_address_of_the_client():
    with interface("ouster/os0-32") as (service, asked):
        auto = '{"udp_dest": "@auto"}'
        path = "/api/v1/sensor/config?reinit=False&persist=False"
        assert ask(service, "POST", path, '{"udp_dest": "127.0.0.9"}')[0] == 204
        assert ask(service, "POST", path, auto)[0] == 204
        assert ask(service, "GET", f"{path}&staging=true")[1]["udp_dest"] == "127.0.0.1"
        assert not asked


def test_ouster_sends_where_a_client_of_firmware_3_0_asks():
    with interface("ouster/os1-64") as (service, asked):
        command = "/api/v1/sensor/cmd/"
        _, config = ask(service, "GET", f"{command}get_config_param?args=active")
        changed = quote(json.dumps({**config, "udp_port_imu": 7700}))
        answer = ask(service, "GET", f"{command}set_config_param?args=.+{changed}")
        assert answer == (200, "set_config_param")
        answer = ask(service, "GET", f"{command}set_config_param?args=udp_dest+127.0.0.5")
        assert answer == (200, "set_config_param")
        assert ask(service, "GET", f"{command}get_config_param?args=staged")[1] == {
            **config, "udp_port_imu": 7700, "udp_dest": "127.0.0.5"
        }  # fmt: skip
        assert ask(service, "GET", f"{command}reinitialize") == (200, {})
        assert asked == [Destination("127.0.0.5", {7502: 7502, 7503: 7700})]
        assert ask(service, "GET", f"{command}set_udp_dest_auto") == (200, {})
        assert ask(service, "GET", f"{command}save_config_params") == (200, {})


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ('{"udp_dest": "239.0.0.1"}', "udp_dest is not the address of a single receiver"),
        ('{"udp_dest": "255.255.255.255"}', "udp_dest is not the address of a single receiver"),
        ('{"udp_dest": 2130706433}', "udp_dest is not an IPv4 address"),
        ('{"udp_port_imu": 70000}', "udp_port_imu is not a port"),
        ('{"udp_port_imu": true}', "udp_port_imu is not a port"),
        ('{"lidar_mode": "2048x10"}', "lidar_mode is 1024x10 in this simulated sensor"),
        ('{"speed": 1}', "there is no parameter speed"),
        ("[]", "JSON object"),
        ("{", "valid JSON"),
        ("[" * 30_000, "valid JSON"),
        (b"\xff", "valid JSON"),
    ],
)
def test_ouster_refuses_what_the_simulated_sensor_cannot_do(values, reason):
    with interface("ouster/os1-64") as (service, asked):
        status, answer = ask(service, "POST", "/api/v1/sensor/config", values)
        assert status == 400
        assert reason in answer["error"]
        assert not asked


def test_ouster_keeps_the_data_of_users_and_has_documents():
    with interface("ouster/os1-64") as (service, _):
        assert ask(service, "GET", "/api/v1/user/data") == (200, "")
        assert ask(service, "PUT", "/api/v1/user/data", '"mine"')[0] == 204
        assert ask(service, "GET", "/api/v1/user/data") == (200, "mine")
        whole = ask(service, "GET", "/api/v1/user/data?include_metadata=true")[1]
        assert whole == {"policy": "clear_on_config_delete", "value": "mine"}
        assert ask(service, "DELETE", "/api/v1/user/data")[0] == 204
        documents = ["system/network", "time/system", "sensor/telemetry", "sensor/alerts"]
        documents += ["sensor/metadata/beam_intrinsics", "sensor/metadata/lidar_data_format"]
        for path in documents:
            assert ask(service, "GET", f"/api/v1/{path}")[0] == 200
        assert ask(service, "HEAD", "/api/v1/sensor/metadata") == (200, None)
        assert ask(service, "GET", "/api/v1/sensor/metadata/of")[0] == 404
        assert ask(service, "GET", "/index.html")[0] == 404
        assert ask(service, "DELETE", "/api/v1/sensor/config")[0] == 405
        assert ask(service, "POST", "/api/v1/system/firmware", "x")[0] == 405


def test_velodyne_tells_its_state_and_sends_where_a_client_asks():
    with interface("velodyne/vlp16", "dual") as (service, asked):
        assert ask(service, "GET", "/cgi/status.json")[1] == {
            "gps": {"pps_state": "Absent", "position": ""},
            "motor": {"state": "On", "rpm": 600, "lock": "Off", "phase": 0},
            "laser": {"state": "On"},
        }
        assert ask(service, "GET", "/cgi/info.json")[1]["model"] == "Velodyne VLP-16"
        settings = ask(service, "GET", "/cgi/settings.json")[1]
        assert (settings["returns"], settings["host"]["dport"]) == ("Dual", "2368")
        assert ask(service, "POST", "/cgi/setting/host", "addr=127.0.0.6&dport=2400")[0] == 204
        assert asked == [Destination("127.0.0.6", {2368: 2400, 8308: 8308})]
        assert ask(service, "POST", "/cgi/setting", "rpm=600&returns=Dual")[0] == 204
        assert ask(service, "POST", "/cgi/setting", "laser=off")[0] == 204
        assert asked[-1] == Destination("127.0.0.6", {2368: 0, 8308: 0})
        assert ask(service, "GET", "/cgi/snapshot.hdl")[1]["config"]["laser"] == "Off"
        for path, body in (
            ("setting", "rpm=300"), ("setting", "color=red"), ("setting/host", "addr=x"),
            ("setting/host", "dport=99999"), ("setting/host", "mask=1"), ("setting/net", "addr=x"),
        ):  # fmt: skip
            assert ask(service, "POST", f"/cgi/{path}", body)[0] in (400, 404)


def test_a_request_in_absolute_form_is_answered_as_by_a_proxy():
    with interface("ouster/os1-64") as (service, _):
        path = "http://127.0.0.1/api/v1/sensor/metadata/sensor_info"
        assert ask(service, "GET", path)[1]["prod_line"] == "OS-1-64"
        port = service.port
        assert f"(for clients: http_proxy=http://127.0.0.1:{port})" in service.description


@pytest.mark.parametrize(
    ("content", "status"),
    [
        (b"\r\n\r\n", 400),
        (b"GET\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n", 400),
        (b"GET / HTTP/2\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nno colon\r\n\r\n", 400),
        (b"GET http://[/ HTTP/1.1\r\n\r\n", 400),
        (b"BREW / HTTP/1.1\r\n\r\n", 405),
        (b"POST /api/v1/sensor/config HTTP/1.1\r\nContent-Length: -1\r\n\r\n", 400),
        (b"POST /api/v1/sensor/config HTTP/1.1\r\nContent-Length: 9999999999\r\n\r\n", 413),
        (b"POST /api/v1/sensor/config HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n", 411),
        (b"GET / HTTP/1.1\r\nX: " + b"x" * 40_000 + b"\r\n\r\n", 431),
        (b"POST /api/v1/sensor/config HTTP/1.1\r\nOrigin: http://a.b\r\n\r\n", 403),
        (b"GET http://site.example/api/v1/sensor/cmd/reinitialize HTTP/1.1\r\n\r\n", 403),
        (b"GET //site.example/api/v1/sensor/cmd/reinitialize HTTP/1.1\r\n\r\n", 403),
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: site.example\r\n\r\n", 403),
        (b"POST / HTTP/1.1\r\nContent-Length: 1\r\nContent-Length: 1\r\n\r\n", 400),
    ],
)
def test_what_is_not_understood_is_refused(content, status):
    with interface("ouster/os1-64") as (service, asked):
        assert raw(service, content).startswith(f"HTTP/1.1 {status} ".encode())
        assert ask(service, "GET", "/api/v1/system/firmware")[0] == 200
        assert not asked


CROSS_SITE = {"Sec-Fetch-Site": "cross-site"}
BROWSER = {"User-Agent": "Mozilla/5.0 (X11; Linux x86_64) Chrome/148.0"}
REDIRECTIONS = {
    "ouster/os1-64": [
        ("GET", "/api/v1/sensor/cmd/set_config_param?args=udp_dest+127.0.0.77", None),
        ("GET", "/api/v1/sensor/cmd/set_udp_dest_auto", None),
        ("HEAD", "/api/v1/sensor/cmd/reinitialize", None),
        ("GET", "/api/v1/sensor/cmd/reinitialize/", None),
        ("POST", "/api/v1/sensor/config", '{"udp_dest": "127.0.0.77"}'),
        ("DELETE", "/api/v1/user/data", None),
    ],
    "velodyne/vlp16": [
        ("POST", "/cgi/setting/host", "addr=127.0.0.77"),
        ("POST", "/cgi/setting", "laser=off"),
    ],
}


@pytest.mark.parametrize("model", REDIRECTIONS)
@pytest.mark.parametrize(
    "headers",
    [
        CROSS_SITE,
        {"Sec-Fetch-Site": "same-site"},
        {"Origin": "http://site.example"},
        {"Origin": "null"},
        {"Host": "site.example"},
        {"Host": "site.example:80"},
        CROSS_SITE | {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
        BROWSER,
        BROWSER | {"Referer": "http://site.example/"},
    ],
)
def test_requests_of_other_websites_change_nothing(model, headers):
    with interface(model) as (service, asked):
        before = service.destination
        for method, path, body in REDIRECTIONS[model]:
            assert ask(service, method, path, body, headers)[0] == 403
        assert (service.destination, asked) == (before, [])


@pytest.mark.parametrize("model", REDIRECTIONS)
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "127.0.0.1"},
        {"Host": "localhost:8080"},
        {"Host": socket.gethostname()},
        {"User-Agent": "curl/8.5.0"},
        BROWSER | {"Sec-Fetch-Site": "none"},
        BROWSER | {"Referer": "http://127.0.0.1:{port}/cgi/settings.json"},
    ],
)
def test_clients_and_the_user_in_a_browser_set_the_receiver(model, headers):
    with interface(model) as (service, asked):
        own = {name: value.format(port=service.port) for name, value in headers.items()}
        for method, path, body in REDIRECTIONS[model]:
            assert ask(service, method, path, body, own)[0] in (200, 204)
        assert asked


def test_a_browser_reads_what_it_may_not_change():
    with interface("ouster/os1-64") as (service, _):
        assert ask(service, "GET", "/api/v1/sensor/config", headers=BROWSER)[0] == 200
        get_config = "/api/v1/sensor/cmd/get_config_param?args=active"
        assert ask(service, "GET", get_config, headers=BROWSER)[0] == 200


# The SDK holds Python's lock while it waits for an answer, so it has a process of its own.
SDK = """
from ouster.sdk.core import SensorConfig
from ouster.sdk.sensor import get_config, set_config
print(get_config("127.0.0.1").udp_port_lidar)
config = SensorConfig()
config.udp_dest = "127.0.0.7"
config.udp_port_lidar = 7702
set_config("127.0.0.1", config)
config = SensorConfig()
config.udp_port_lidar = 7802
set_config("127.0.0.1", config, udp_dest_auto=True)
try:
    get_config("site.example")
except RuntimeError as error:
    print("not a name of this server" in str(error))
"""


@pytest.mark.slow
def test_ouster_sdk_configures_the_sensor_through_a_proxy():
    pytest.importorskip("ouster.sdk.sensor")
    with interface("ouster/os0-32") as (service, asked):
        environment = os.environ | {"http_proxy": f"http://127.0.0.1:{service.port}"}
        command = [sys.executable, "-c", SDK]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["7502", "True"]
        assert asked == [
            Destination("127.0.0.7", {7502: 7702, 7503: 7503}),
            Destination("127.0.0.1", {7502: 7802, 7503: 7503}),
        ]


@pytest.mark.parametrize("digits", ["9" * 5000, "\u0662", "-1", "65536", "", "1e3"])
def test_a_port_that_is_none_is_refused(digits):
    with interface("velodyne/vlp16") as (service, asked):
        body = f"dport={quote(digits)}"
        assert ask(service, "POST", "/cgi/setting/host", body)[0] == 400
    with interface("ouster/os1-64") as (service, _):
        path = f"/api/v1/sensor/cmd/set_config_param?args=udp_port_lidar+{quote(digits)}"
        assert ask(service, "GET", path)[0] == 400
    assert not asked


def test_beyond_the_limit_the_oldest_unfinished_connection_gives_way():
    with interface("ouster/os1-64") as (service, _), ExitStack() as stack:
        address = ("127.0.0.1", service.port)
        slow = []
        for number in range(200):
            slow.append(stack.enter_context(socket.create_connection(address, 10)))
            slow[-1].send(b"GET /api/v1/system/firmware HTTP/1.1\r\n")
            if number % 50 == 49:
                assert ask(service, "GET", "/api/v1/system/firmware")[0] == 200
        closed = len(slow) - service.max_connections
        for connection in slow[:closed]:
            with suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        slow[-1].send(b"\r\n")
        assert slow[-1].recv(12) == b"HTTP/1.1 200"


def test_connections_that_never_end_and_floods_leave_the_interface_alive(monkeypatch):
    monkeypatch.setattr(http_service, "_WITHIN_S", 0.3)
    with interface("ouster/os1-64") as (service, _):
        before = threading.active_count()
        address = ("127.0.0.1", service.port)
        opened = [socket.create_connection(address, 10) for _ in range(100)]
        for connection in opened[:50]:
            connection.send(b"GET /api")
        assert threading.active_count() <= before + 1
        stop = time.monotonic() + 10
        while True:
            try:
                if ask(service, "GET", "/api/v1/system/firmware")[0] == 200:
                    break
            except (OSError, http.client.HTTPException):
                assert time.monotonic() < stop
        for connection in opened:
            connection.close()


def test_an_address_that_cannot_be_had_is_refused_in_a_line():
    with interface("ouster/os1-64") as (service, _):
        taken = f"127.0.0.1:{service.port}"
        in_use = pytest.raises(LidarError, match=r"cannot listen at .*in use")
        with in_use as raised, interface("ouster/os1-64", address=taken):
            pass
        assert "\n" not in str(raised.value)
    elsewhere = pytest.raises(LidarError, match="Cannot assign requested address")
    with elsewhere, interface("ouster/os1-64", address="203.0.113.1:8080"):
        pass
