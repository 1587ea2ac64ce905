"""Services that act as live sensors for the software of the manufacturers."""

from __future__ import annotations

from collections.abc import Callable
from zlib import crc32

from lidarsim.packets.encoders import PacketEncoder
from lidarsim.packets.hesai import HesaiEncoder
from lidarsim.packets.livox import CARTESIAN, PORTS, LivoxEncoder
from lidarsim.packets.ouster import IMU_PORT, LIDAR_PORT, OusterEncoder
from lidarsim.packets.service import Destination, Service
from lidarsim.packets.velodyne import DATA_PORT, VelodyneEncoder
from lidarsim.packets.velodyne_position import POSITION_PORT

from .hesai_ptc import PtcDevice, PtcService
from .livox_service import LivoxService, LivoxState
from .ouster_api import OusterApi
from .velodyne_api import VelodyneApi, VelodyneState

SendTo = Callable[[Destination], None]


def service_of(
    encoder: PacketEncoder, address: str, destination: Destination, send_to: SendTo
) -> Service | None:
    """Return the service of a sensor, or None if its software needs none.

    Parameters
    ----------
    encoder
        Encoder of the sensor's packets.
    address
        Address to listen on: HOST for the usual port, or HOST:PORT.
    destination, send_to
        As in `Service`.
    """
    match encoder:
        case HesaiEncoder():
            return _hesai(encoder, address, destination, send_to)
        case LivoxEncoder():
            return _livox(encoder, address, destination, send_to)
        case OusterEncoder():
            ports = encoder.port("lidar", LIDAR_PORT), encoder.port("imu", IMU_PORT)
            return OusterApi(address, destination, send_to, encoder.metadata(), ports)
        case VelodyneEncoder():
            return _velodyne(encoder, address, destination, send_to)
    return encoder.service(address, destination, send_to)


def _hesai(
    encoder: HesaiEncoder, address: str, destination: Destination, send_to: SendTo
) -> PtcService:
    files = encoder.files()
    device = PtcDevice(
        name=encoder.source.name,
        model_code=encoder.layout.model_code,
        lasers=encoder.layout.channels,
        rate_rpm=encoder.rate_rpm,
        mode=encoder.source.mode,
        port=encoder.data_port,
        dated=encoder.source.dated,
        ptp=encoder.is_ptp,
        calibration=files[".angles.csv"],
        firetimes=files[".firetimes.csv"],
    )
    return PtcService(device, address, destination, send_to)


def _livox(
    encoder: LivoxEncoder, address: str, destination: Destination, send_to: SendTo
) -> LivoxService:
    ports = PORTS[encoder.device_type]
    state = LivoxState(
        device_type=encoder.device_type,
        product=encoder.source.sensor.model,
        serial=f"LIDARPOOL{crc32(encoder.source.name.encode()) % 1_000_000:06d}",
        command_port=ports.command,
        state_ports=(ports.state, ports.host_state),
        points_ports=(ports.points, encoder.ports["points"]),
        imu_ports=(ports.imu, encoder.ports["imu"]),
        data_type=int(encoder.data_type),
        data_types=tuple(CARTESIAN),
        is_synchronized=encoder.source.dated,
    )
    return LivoxService(address, destination, send_to, state, encoder.set_data_type)


def _velodyne(
    encoder: VelodyneEncoder, address: str, destination: Destination, send_to: SendTo
) -> VelodyneApi:
    source = encoder.source
    state = VelodyneState(
        model=source.sensor.model,
        serial=source.name or "lidarpool",
        return_mode=source.mode.title(),
        rpm=round(60 * source.sensor.head.rate_hz),  # type: ignore[attr-defined]
        pps_state="Locked" if source.dated else "Absent",
    )
    ports = encoder.port("data", DATA_PORT), encoder.port("position", POSITION_PORT)
    return VelodyneApi(address, destination, send_to, state, ports)
