"""Publish ROS 2 topics without a ROS installation, sending serialized messages with cyclonedds."""

from __future__ import annotations

import ipaddress
import math
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, ReadCondition, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from lidarfiles.clouds.ros.messages import CLOCK_TOPIC, LATCHED_TOPICS, RosMessage, message_store
from lidarsim.environment.ports import port_number
from lidarsim.errors import LidarError
from lidarsim.words import join_names, shorten_name

from .serialized_topics import ANY_SAMPLE, SerializedReader, SerializedTopic, SerializedWriter

LOOPBACK = "127.0.0.1"
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
_MAX_DOMAIN = 232  # ports of higher domains would exceed 65,535
_PARTICIPANTS = 32  # maximum number of participants per machine, as in ROS 2
# Participants announce themselves once per second, so readers that start later find the topics
# quickly.
_CONFIGURATION = """<CycloneDDS><Domain Id="{domain}">
<General><Interfaces><NetworkInterface address="{address}"/></Interfaces>
{sizes}</General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>{participants}</MaxAutoParticipantIndex>
<SPDPInterval>1s</SPDPInterval><Peers>{peers}</Peers></Discovery>
<Tracing><Verbosity>none</Verbosity></Tracing>
</Domain></CycloneDDS>"""
# The loopback interface accepts datagrams of any size, and readers lose fewer packets if there are
# a few large ones.
_LOOPBACK_SIZES = "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize>"
# Maximum delay that an unresponsive reader can cause for the others.
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
# Number of messages that are kept per topic, as in ROS 2 nodes.
_DEPTHS = {CLOCK_TOPIC: 1, "/tf": 100}
_DEPTH = 10
_RECEIVED_DEPTH = 5000  # messages of a topic that are kept until they are read
_TAKEN = 1000  # messages that are taken at once
_SHARED_S = 5.0  # how long a topic counts as shared after its publishers have taken turns
_MAX_SENDERS = 16  # publishers of a topic that are remembered
# Time to wait for further messages, since /clock alone can have a thousand per second.
_GATHER_S = 0.003


@dataclass(frozen=True)
class Network:
    """Network interface, peers and domain of ROS 2 topics."""

    address: str = LOOPBACK  # address of the network interface
    peers: tuple[str, ...] = ()  # machines to which the topics are announced
    domain: int = 0

    @classmethod
    def for_hosts(
        cls, hosts: Sequence[str], environment: Mapping[str, str] = os.environ
    ) -> Network:
        """Return the network in which all hosts can be reached.

        Without hosts, the loopback interface is used. The domain is ROS_DOMAIN_ID.

        Raises
        ------
        LidarError
            If a host is unknown, unreachable or has no IPv4 address, if the hosts are reached
            through different interfaces, or if the domain is not a number from 0 to 232.
        """
        peers = tuple(_ipv4_address(host) for host in hosts)
        interfaces = {_interface_to(peer) for peer in peers} or {LOOPBACK}
        if len(interfaces) > 1:
            raise LidarError(
                f"The addresses {join_names(hosts)} of `--to` are reached through different "
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
        """Configuration of cyclonedds in XML."""
        peers = dict.fromkeys((self.address, *self.peers))
        return _CONFIGURATION.format(
            domain=self.domain,
            address=self.address,
            sizes=_LOOPBACK_SIZES if self.address == LOOPBACK else "",
            participants=_PARTICIPANTS,
            peers="".join(f'<Peer address="{peer}"/>' for peer in peers),
        )


def _ipv4_address(host: str) -> str:
    """Resolve the IPv4 address of a host.

    Raise LidarError if the host is unknown or has no IPv4 address, or if the address is multicast.
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
    """Return the address of the local interface that routes to `address`."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))  # sends nothing
        except OSError as error:
            raise LidarError(
                f"The address {address} of `--to` cannot be reached: {error.strerror}."
            ) from error
        return str(probe.getsockname()[0])


class RosPublisher:
    """Context manager that publishes messages on ROS 2 topics.

    Nodes discover the topics on the interface of the network, and on its peers.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self.dropped = 0  # messages that were dropped because a reader was too slow
        self._writers: dict[str, SerializedWriter] = {}
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
        """Remove all topics."""
        self._writers.clear()
        for entity in (self._participant, self._domain):
            with suppress(DDSException):
                entity._delete(entity._ref)

    def publish(self, message: RosMessage) -> None:
        """Publish a message, creating its topic if necessary."""
        if message.topic not in self._writers:
            self._writers[message.topic] = self._writer(message.topic, message.kind)
        try:
            self._writers[message.topic].write_serialized(bytes(message.cdr))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            self.dropped += 1

    def _writer(self, topic: str, kind: str) -> SerializedWriter:
        """Create a writer for a topic.

        The writer is reliable, so that it matches reliable and best-effort readers.
        """
        latched = topic in LATCHED_TOPICS
        durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        depth = 1 if latched else _DEPTHS.get(topic, _DEPTH)
        qos = Qos(
            Policy.Reliability.Reliable(_MAX_BLOCKING),
            durability,
            Policy.History.KeepLast(depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        dds_topic = SerializedTopic(self._participant, f"rt{topic}", message_class(kind))
        return SerializedWriter(self._participant, dds_topic, qos)


class _Reader(NamedTuple):
    """A reader of a topic, and the condition with which it ends waiting."""

    data_reader: SerializedReader
    condition: ReadCondition
    is_reliable: bool


class RosSubscriber:
    """Receives the messages of topics as soon as other programs publish them.

    A topic is read with the reliability and the durability of its publishers. If only some of them
    are reliable, it is read without reliability.

    Parameters
    ----------
    publisher
        Publisher whose connection to the network is used.
    is_wanted
        Function that returns whether messages are received, given a topic and a message type.
    note
        Function that shows a note about messages that are wanted, but cannot be received.
    """

    def __init__(
        self,
        publisher: RosPublisher,
        is_wanted: Callable[[str, str], bool],
        note: Callable[[str], None],
    ) -> None:
        self._participant = publisher._participant
        self._is_wanted = is_wanted
        self._note = note
        self._discovery = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._wait_set = WaitSet(self._participant)
        self._attach(self._discovery)
        # Readers by topic, message type, and whether they receive old messages.
        self._readers: dict[tuple[str, str, bool], _Reader] = {}
        self._writers: dict[Any, str] = {}  # {key of a publisher: topic}
        self._senders: dict[str, list[int]] = {}  # publishers by topic, in the order of appearance
        self._shared_s: dict[str, float] = {}  # {topic: when its publishers last took turns}

    def publishers(self, topic: str) -> int:
        """Return the number of programs that publish a topic.

        A program that was killed counts for another 10 seconds.
        """
        return sum(published == topic for published in self._writers.values())

    def is_shared(self, topic: str) -> bool:
        """Return whether messages of several programs on a topic arrive in turns."""
        return time.monotonic() - self._shared_s.get(topic, -math.inf) < _SHARED_S

    def receive(self, wait_s: float) -> Iterator[RosMessage]:
        """Yield the messages that have arrived, starting with those of the clock.

        Wait at most `wait_s` seconds for messages if there are none.
        """
        self._wait_set.wait(duration(seconds=wait_s))
        time.sleep(_GATHER_S)
        self._discover()
        # The clock comes first, because it determines which other messages are up to date.
        readers = sorted(self._readers.items(), key=lambda item: item[0][0] != CLOCK_TOPIC)
        for (topic, kind, _), reader in readers:
            # Not all samples are taken, because a flood of messages never ends.
            for sample in reader.data_reader.take_serialized(_TAKEN):
                self._record_sender(topic, sample.publisher)
                yield RosMessage(topic, kind, sample.time_ns, sample.cdr)

    def _record_sender(self, topic: str, publisher: int) -> None:
        """Record which program has sent a message.

        A program that is restarted has a new publisher, and its old one is silent.
        """
        senders = self._senders.setdefault(topic, [])
        if publisher not in senders:
            senders.append(publisher)
            del senders[:-_MAX_SENDERS]
        elif publisher != senders[-1]:
            self._shared_s[topic] = time.monotonic()

    def _attach(self, reader: Any) -> ReadCondition:
        """Let messages of a reader end waiting."""
        condition = ReadCondition(reader, ANY_SAMPLE)
        self._wait_set.attach(condition)
        return condition

    def _discover(self) -> None:
        """Create readers for new publishers of wanted topics."""
        for endpoint in self._discovery.take(_TAKEN):
            if endpoint.sample_info.instance_state != InstanceState.Alive:
                self._writers.pop(endpoint.key, None)
                continue
            topic = endpoint.topic_name.removeprefix("rt")
            kind = endpoint.type_name.replace("::", "/").replace("/dds_/", "/").removesuffix("_")
            if endpoint.topic_name == topic or not self._is_wanted(topic, kind):
                continue
            policies = [*endpoint.qos]
            mismatch = _mismatch(endpoint.type_name, kind, policies)
            if mismatch:
                self._note(
                    f"A program publishes {topic} {mismatch}, so its messages are not received."
                )
                continue
            self._writers[endpoint.key] = topic
            is_reliable = any(isinstance(p, Policy.Reliability.Reliable) for p in policies)
            is_latched = Policy.Durability.TransientLocal in policies
            # A reader without reliability also receives the messages of reliable publishers. A
            # second reader would receive each of their messages again.
            key = topic, kind, is_latched
            reader = self._readers.get(key)
            if reader is not None and reader.is_reliable and not is_reliable:
                self._wait_set.detach(reader.condition)
                reader = None
            if reader is None:
                self._readers[key] = self._reader(topic, kind, is_reliable, is_latched)

    def _reader(self, topic: str, kind: str, is_reliable: bool, is_latched: bool) -> _Reader:
        qos = Qos(
            Policy.Reliability.Reliable(0) if is_reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if is_latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(_RECEIVED_DEPTH),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        dds_topic = SerializedTopic(self._participant, f"rt{topic}", message_class(kind))
        reader = SerializedReader(self._participant, dds_topic, qos=qos)
        return _Reader(reader, self._attach(reader), is_reliable)


def _mismatch(type_name: str, kind: str, policies: Sequence[Any]) -> str:
    """Return in which way a publisher differs from those of ROS 2, or an empty string."""
    expected = message_class(kind).__idl_typename__.replace(".", "::")
    if type_name != expected:
        return f"with the type name {type_name} instead of {expected}"
    formats = [p for p in policies if isinstance(p, Policy.DataRepresentation)]
    if formats and not formats[0].use_cdrv0_representation:
        return "in the format XCDR2 instead of XCDR1"
    return ""


@cache
def message_class(kind: str) -> Any:
    """Return the cyclonedds class of a message type such as sensor_msgs/msg/PointCloud2.

    As in the ROS 2 middleware, the names of the type and of its fields end with an underscore.
    """
    package, _, name = kind.partition("/msg/")
    _, fields = message_store().fielddefs[kind]
    return make_idl_struct(
        f"{name}_",
        f"{package}.msg.dds_.{name}_",
        {f"{field}_": _idl_type(description) for field, description in fields},
    )


def _idl_type(description: Any) -> Any:
    """Convert a field description from rosbags to the corresponding cyclonedds type."""
    node, content = description
    if node == Nodetype.BASE:
        return _BASE_TYPES[content[0]]
    if node == Nodetype.NAME:
        return message_class(content)
    element, count = content
    if node == Nodetype.ARRAY:
        return types.array[_idl_type(element), count]
    return types.sequence[_idl_type(element)]
