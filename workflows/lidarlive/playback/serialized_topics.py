"""Topics whose messages stay serialized, and that are matched by the name of their type.

cyclonedds announces the definition of each type, and does not connect programs whose definitions
differ, even if the bytes of their messages are equal. Like the middleware of ROS 2, these topics
announce the name only. The C library is called directly, because the Python package always
announces definitions.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any, NamedTuple

from cyclonedds.core import DDSException, Entity, InstanceState, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import DDS, dds_c_t
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

ANY_SAMPLE = ViewState.Any | SampleState.Any | InstanceState.Any
_LOCAL_SCOPE = 1  # DDS_FIND_SCOPE_LOCAL_DOMAIN
_FLAGS = 2  # index of `m_flagset` in dds_topic_descriptor
_HAS_DEFINITION = 1 << 6  # DDS_TOPIC_XTYPES_METADATA
_DATA_SAMPLE = 2  # SDK_DATA

_Pointer = ctypes.c_void_p


class _Bytes(ctypes.Structure):
    """Address and size of serialized data (ddsrt_iovec_t)."""

    _fields_ = (("data", ctypes.c_char_p), ("size", ctypes.c_size_t))


def _c_function(name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(DDS._dll_handle, name)
    function.restype = result
    function.argtypes = arguments
    return function


_entity, _status = dds_c_t.entity, dds_c_t.returnv
_get_typeinfo = _c_function("dds_get_typeinfo", _status, _entity, _Pointer)
_free_typeinfo = _c_function("dds_free_typeinfo", _status, _Pointer)
_create_descriptor = _c_function(
    "dds_create_topic_descriptor",
    _status,
    ctypes.c_int,
    _entity,
    _Pointer,
    ctypes.c_int64,
    _Pointer,
)
_delete_descriptor = _c_function("dds_delete_topic_descriptor", None, _Pointer)
_create_topic = _c_function(
    "dds_create_topic", _entity, _entity, _Pointer, ctypes.c_char_p, _Pointer, _Pointer
)
_get_sertype = _c_function("dds_get_entity_sertype", _status, _entity, _Pointer)
_from_bytes = _c_function(
    "ddsi_serdata_from_ser_iov",
    _Pointer,
    _Pointer,
    ctypes.c_int,
    ctypes.c_size_t,
    _Pointer,
    ctypes.c_size_t,
)
_size = _c_function("ddsi_serdata_size", ctypes.c_uint32, _Pointer)
_to_bytes = _c_function(
    "ddsi_serdata_to_ser", None, _Pointer, ctypes.c_size_t, ctypes.c_size_t, _Pointer
)
_release = _c_function("ddsi_serdata_unref", None, _Pointer)
_write = _c_function("dds_writecdr", _status, _entity, _Pointer)
_take = _c_function(
    "dds_takecdr", _status, _entity, _Pointer, ctypes.c_uint32, _Pointer, ctypes.c_uint32
)


class SerializedTopic(Topic):
    """A topic that announces the name of its type, but not its definition.

    Parameters
    ----------
    participant
        Participant of the topic.
    name
        Name of the topic.
    kind
        cyclonedds class of the messages. Messages with other contents are not received.
    """

    def __init__(self, participant: DomainParticipant, name: str, kind: Any) -> None:
        defined = Topic(participant, name, kind)
        self.data_type = kind
        info = _Pointer()
        _check(_get_typeinfo(defined._ref, ctypes.byref(info)))
        descriptor = ctypes.POINTER(ctypes.c_uint32)()
        try:
            _check(
                _create_descriptor(
                    _LOCAL_SCOPE, participant._ref, info, 0, ctypes.byref(descriptor)
                )
            )
        finally:
            _free_typeinfo(info)
        descriptor[_FLAGS] &= ~_HAS_DEFINITION
        topic = _create_topic(participant._ref, descriptor, name.encode(), None, None)
        _delete_descriptor(descriptor)
        Entity.__init__(self, topic)  # raises an exception if there is no topic


class SerializedWriter(DataWriter):
    """A writer of serialized messages.

    Parameters
    ----------
    participant
        Participant of the writer.
    topic
        Topic of the messages.
    qos
        Qualities of service.
    """

    def __init__(self, participant: DomainParticipant, topic: SerializedTopic, qos: Any) -> None:
        super().__init__(participant, topic, qos)
        self._sertype = _Pointer()  # it exists as long as the writer
        _check(_get_sertype(self._ref, ctypes.byref(self._sertype)))

    def write_serialized(self, cdr: bytes) -> None:
        """Write a message.

        Raises
        ------
        DDSException
            If the message is not of the type of the topic, or if a reader does not respond in time.
        """
        buffer = _Bytes(cdr, len(cdr))
        data = _from_bytes(self._sertype, _DATA_SAMPLE, 1, ctypes.byref(buffer), len(cdr))
        if data is None:
            _check(DDSException.DDS_RETCODE_BAD_PARAMETER)
        _check(_write(self._ref, data))


class SerializedSample(NamedTuple):
    """A received message."""

    time_ns: int  # when it was sent, in Unix time
    publisher: int  # identifies the writer that sent it
    cdr: bytes


class SerializedReader(DataReader):
    """A reader of serialized messages."""

    def take_serialized(self, limit: int) -> Iterator[SerializedSample]:
        """Yield up to `limit` messages that have arrived."""
        data = (_Pointer * limit)()
        infos = (dds_c_t.sample_info * limit)()
        count = _check(_take(self._ref, data, limit, infos, ANY_SAMPLE))
        samples = []
        for pointer, info in zip(data[:count], infos[:count], strict=True):
            if info.valid_data:
                cdr = ctypes.create_string_buffer(_size(pointer))
                _to_bytes(pointer, 0, len(cdr), cdr)
                samples.append(
                    SerializedSample(info.source_timestamp, info.publication_handle, cdr.raw)
                )
            _release(pointer)
        yield from samples


def _check(status: int) -> int:
    """Return the result of a function. Raise DDSException if it is negative."""
    if status < 0:
        raise DDSException(status)
    return status
