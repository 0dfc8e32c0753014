"""Raw bytes on any DDS topic, also on those of services, for which rclpy has no publisher: the middleware's C functions
by ctypes (rclpy puts a slash before each name, and rq/<service>Request has none)."""

import ctypes
from typing import Any

_RCL, _RMW = ctypes.CDLL("librcl.so"), ctypes.CDLL("librmw_fastrtps_cpp.so")
_RELIABLE, _VOLATILE, _KEEP_LAST, _AUTOMATIC = 1, 2, 1, 1


class _Time(ctypes.Structure):
    _fields_ = (("sec", ctypes.c_uint64), ("nsec", ctypes.c_uint64))


class _Qos(ctypes.Structure):
    _fields_ = (
        ("history", ctypes.c_int), ("depth", ctypes.c_size_t), ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int), ("deadline", _Time), ("lifespan", _Time), ("liveliness", ctypes.c_int),
        ("lease", _Time), ("avoid_ros_namespace_conventions", ctypes.c_bool),
    )


class _Options(ctypes.Structure):
    _fields_ = (("payload", ctypes.c_void_p), ("unique_flow", ctypes.c_int))


class _Bytes(ctypes.Structure):
    _fields_ = (
        ("buffer", ctypes.c_void_p), ("length", ctypes.c_size_t), ("capacity", ctypes.c_size_t),
        ("allocator", ctypes.c_void_p * 5),
    )


_RCL.rcl_node_get_rmw_handle.restype = ctypes.c_void_p
_RCL.rcl_node_get_rmw_handle.argtypes = [ctypes.c_void_p]
_RMW.rmw_create_publisher.restype = ctypes.c_void_p
_RMW.rmw_create_publisher.argtypes = [
    ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p, ctypes.POINTER(_Qos), ctypes.POINTER(_Options)
]
_RMW.rmw_publish_serialized_message.argtypes = [ctypes.c_void_p, ctypes.POINTER(_Bytes), ctypes.c_void_p]
_RMW.rmw_publisher_wait_for_all_acked.argtypes = [ctypes.c_void_p, _Time]
_RMW.rmw_destroy_publisher.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
_POINTER, _NAME = ctypes.pythonapi.PyCapsule_GetPointer, ctypes.pythonapi.PyCapsule_GetName
_POINTER.restype, _POINTER.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
_NAME.restype, _NAME.argtypes = ctypes.c_char_p, [ctypes.py_object]


class RawPublisher:
    """A reliable, volatile publisher. kind: class whose name the readers expect. topic: as DDS has it."""

    def __init__(self, node: Any, kind: Any, topic: str) -> None:
        if kind._TYPE_SUPPORT is None:
            type(kind).__import_type_support__()
        self._node = _RCL.rcl_node_get_rmw_handle(node.handle.pointer)
        qos = _Qos(
            history=_KEEP_LAST, depth=100, reliability=_RELIABLE, durability=_VOLATILE, liveliness=_AUTOMATIC,
            avoid_ros_namespace_conventions=True,
        )
        support = _POINTER(kind._TYPE_SUPPORT, _NAME(kind._TYPE_SUPPORT))
        self._publisher = _RMW.rmw_create_publisher(
            self._node, support, topic.encode(), ctypes.byref(qos), ctypes.byref(_Options())
        )
        assert self._publisher, f"no publisher for {topic}"

    def publish(self, data: bytes) -> None:
        buffer = ctypes.create_string_buffer(data, max(1, len(data)))
        message = _Bytes(ctypes.cast(buffer, ctypes.c_void_p), len(data), len(data))
        _RMW.rmw_publish_serialized_message(self._publisher, ctypes.byref(message), None)  # refuses what is too long

    def destroy(self) -> None:
        """What was published has arrived by then, unless a reader is away for more than 5 s."""
        _RMW.rmw_publisher_wait_for_all_acked(self._publisher, _Time(5, 0))
        _RMW.rmw_destroy_publisher(self._node, self._publisher)
