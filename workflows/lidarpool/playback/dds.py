"""Topics of ROS 2 without ROS: cyclonedds sends messages that are serialized already."""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from lidarsim.environment.ports import port_number
from lidarsim.errors import LidarError
from lidarsim.words import joined, shorten_name

from ..clouds.ros.messages import LATCHED_TOPICS, RosMessage, message_store

LOOPBACK = "127.0.0.1"
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
_MAX_DOMAIN = 232  # ports of further domains are above 65,535
_PARTICIPANTS = 32  # participants of a machine, as ROS 2 takes it
# Participants announce themselves once a second: readers that start later soon find the topics.
_CONFIGURATION = """<CycloneDDS><Domain Id="{domain}">
<General><Interfaces><NetworkInterface address="{address}"/></Interfaces>
{sizes}</General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>{participants}</MaxAutoParticipantIndex>
<SPDPInterval>1s</SPDPInterval><Peers>{peers}</Peers></Discovery>
<Tracing><Verbosity>none</Verbosity></Tracing>
</Domain></CycloneDDS>"""
# The loopback interface takes datagrams of any size, and readers lose fewer of a few large ones.
_LOOPBACK_SIZES = "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize>"
# A reader that stops reading delays others by no more than this.
_MAX_BLOCKING = duration(milliseconds=20)
_BASE_TYPES = {
    "bool": bool,
    "byte": types.byte,
    "char": types.uint8,
    "string": str,
    **{f"int{bits}": getattr(types, f"int{bits}") for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": getattr(types, f"uint{bits}") for bits in (8, 16, 32, 64)},
    **{f"float{bits}": getattr(types, f"float{bits}") for bits in (32, 64)},
}
# Messages that late readers may get: of the last, as nodes of ROS 2 keep them.
_DEPTHS = {"/clock": 1, "/tf": 100}
_DEPTH = 10


@dataclass(frozen=True)
class Network:
    """Where topics are: an interface of this machine, its peers, and a domain."""

    address: str = LOOPBACK  # address of the interface
    peers: tuple[str, ...] = ()  # machines that are told of the topics
    domain: int = 0

    @classmethod
    def to(cls, hosts: Sequence[str], environment: Mapping[str, str] = os.environ) -> Network:
        """Return the network that reaches hosts, of a single interface, or loopback without hosts.

        The domain is ROS_DOMAIN_ID.

        Raises
        ------
        LidarError
            If a host is unknown, unreachable or not an IPv4 address, hosts are reached through
            several interfaces, or the domain is not a number from 0 to 232.
        """
        peers = tuple(_ipv4_address(host) for host in hosts)
        interfaces = {_interface_to(peer) for peer in peers} or {LOOPBACK}
        if len(interfaces) > 1:
            raise LidarError(
                f"The addresses {joined(hosts)} of `--to` are reached through different "
                f"network interfaces ({', '.join(sorted(interfaces))}). Specify addresses in "
                "a single network."
            )
        text = environment.get(DOMAIN_VARIABLE) or "0"
        domain = port_number(text)
        if domain is None or domain > _MAX_DOMAIN:
            raise LidarError(
                f"{DOMAIN_VARIABLE} is {shorten_name(text)!r}; it must be a number from 0 to "
                f"{_MAX_DOMAIN}."
            )
        return cls(interfaces.pop(), peers, domain)

    @property
    def configuration(self) -> str:
        """The configuration of cyclonedds, as XML."""
        peers = dict.fromkeys((self.address, *self.peers))
        return _CONFIGURATION.format(
            domain=self.domain,
            address=self.address,
            sizes=_LOOPBACK_SIZES if self.address == LOOPBACK else "",
            participants=_PARTICIPANTS,
            peers="".join(f'<Peer address="{peer}"/>' for peer in peers),
        )


def _ipv4_address(host: str) -> str:
    """Return the address of a host.

    Raises LidarError for an unknown host, and without IPv4.
    """
    advice = "Specify a host name or an IPv4 address, without a port."
    try:
        infos = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise LidarError(f"The host {host} of `--to` cannot be resolved. {advice}") from error
    address = str(infos[0][4][0])
    if ipaddress.ip_address(address).is_multicast:
        raise LidarError(f"The address {host} of `--to` is a multicast address. {advice}")
    return address


def _interface_to(address: str) -> str:
    """Return the address of the interface of this machine through which an address is reached."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))  # sends nothing
        except OSError as error:
            raise LidarError(
                f"The address {address} of `--to` cannot be reached: {error.strerror}."
            ) from error
        return str(probe.getsockname()[0])


class RosPublisher:
    """Publishes messages on topics of ROS 2, as a context manager.

    Nodes find the topics on the interface of a network, and on its peers.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self.dropped = 0  # messages that a reader was too slow for
        self._writers: dict[str, Any] = {}
        try:
            self._domain = Domain(network.domain, network.configuration)
            self._participant = DomainParticipant(network.domain)
        except DDSException as error:
            raise LidarError(
                f"ROS 2 cannot be reached in domain {network.domain} on {network.address}. "
                "Its ports are in use, or the network interface is down. Set "
                f"{DOMAIN_VARIABLE} to another number, or specify another address with `--to`."
            ) from error

    def __enter__(self) -> RosPublisher:
        return self

    def __exit__(self, *error: object) -> None:
        """Take the topics away."""
        self._writers.clear()
        for entity in (self._participant, self._domain):
            with suppress(DDSException):
                entity._delete(entity._ref)

    def publish(self, message: RosMessage) -> None:
        """Publish a message.

        The topic is made with its first message.
        """
        if message.topic not in self._writers:
            self._writers[message.topic] = self._writer(message.topic, message.kind)
        writer = self._writers[message.topic]
        try:
            writer.write(_serialized(writer.data_type, bytes(message.cdr)))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            self.dropped += 1

    def _writer(self, topic: str, kind: str) -> Any:
        """Return a writer of a topic: reliable, so that readers of either reliability match."""
        latched = topic in LATCHED_TOPICS
        durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        depth = 1 if latched else _DEPTHS.get(topic, _DEPTH)
        qos = Qos(
            Policy.Reliability.Reliable(_MAX_BLOCKING),
            durability,
            Policy.History.KeepLast(depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        dds_topic = Topic(self._participant, f"rt{topic}", message_class(kind))
        return DataWriter(self._participant, dds_topic, qos=qos)


def _serialized(kind: Any, cdr: bytes) -> Any:
    """Return a message of a class that is serialized already.

    cyclonedds would take 72 to 96 ms for a cloud of 2 MB.
    """
    message = object.__new__(kind)
    message.serialize = lambda **_: cdr
    return message


@cache
def message_class(kind: str) -> Any:
    """Return the class of cyclonedds of a message, such as sensor_msgs/msg/PointCloud2.

    Names of type and fields are as in the middleware of ROS 2, with an underscore at the end.
    """
    package, _, name = kind.partition("/msg/")
    _, fields = message_store().fielddefs[kind]
    return make_idl_struct(
        f"{name}_",
        f"{package}.msg.dds_.{name}_",
        {f"{field}_": _idl_type(description) for field, description in fields},
    )


def _idl_type(description: Any) -> Any:
    """Return the type of a field of a description of rosbags."""
    node, content = description
    if node == Nodetype.BASE:
        return _BASE_TYPES[content[0]]
    if node == Nodetype.NAME:
        return message_class(content)
    element, count = content
    if node == Nodetype.ARRAY:
        return types.array[_idl_type(element), count]
    return types.sequence[_idl_type(element)]
