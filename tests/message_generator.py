"""Messages that a broken, old, or hostile program may send, made from the interface definitions alone.

A message is a tree of fields, written as CDR (XCDR1, little-endian) by this file, so that also bytes which no ROS
program writes can be made: cut ones, lists that lie about their length, strings that are no UTF-8, fields of another
version of the type. Samples of real messages are the plausible values from which odd ones are made.
"""

import random
import struct
from array import array
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from operator import attrgetter
from typing import Any

from rclpy.serialization import deserialize_message
from rosidl_parser.definition import AbstractGenericString, Array, BasicType, NamespacedType

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of XCDR1, little-endian."""

FORMATS = {
    "boolean": "B", "octet": "B", "uint8": "B", "char": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I",
    "int32": "i", "uint64": "Q", "int64": "q", "float": "f", "double": "d",
}
STRINGS = (
    b"", b"a", b"0", b"-1", b"rgb8", b"NaN", b"../x", b"/proc/0/none", b"%s%n{0}", b"a\nb\r\x1b[31m",
    "é漢\u202e".encode(),
    b"\xff\xfe\x80", b"\xed\xa0\x80", b"\xc3", b"x" * 300, b"y" * 20_000,
)
FLOATS = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e9, 3e38, -3e38, 1.7e308, 1e-45, 5e-324, float("nan"), float("inf"), float("-inf")
)
LENGTHS = (0, 1, 2, 3, 4, 5, 12, 64, 1000)
LONG = 5_000
"""Numbers in a long list."""
SAMPLES_KEPT = 16


@dataclass
class Lie:
    """A string or list that says another length than it has, or a string without its end."""

    length: int
    content: Any


@dataclass
class Field:
    """kind: an entry of SLOT_TYPES. value: number, bytes of a string, list, or the fields of a message."""

    kind: Any
    value: Any


def interface(name: str) -> type[Any]:
    """The class of e.g. wm_msgs/msg/EnvSpec, wm_msgs/srv/Seek, wm_msgs/action/Train_Goal or Train_SendGoal."""
    package, kind, name = name.split("/")
    module = import_module(f"{package}.{kind}")
    if kind != "action":
        found: type[Any] = getattr(module, name)
        return found
    action, _, part = name.partition("_")
    inner = {"SendGoal": "SendGoalService", "GetResult": "GetResultService"}.get(part, part)
    implied = inner != part or part == "FeedbackMessage"
    return attrgetter(f"{action}.Impl.{inner}" if implied else f"{action}.{part}")(module)


def _class_of(kind: NamespacedType) -> type[Any]:
    return interface("/".join((*kind.namespaces, kind.name)))


def has_lists(kind: type[Any]) -> bool:
    """Whether a message of this class has a list whose length the sender chooses, however deep."""
    for slot in kind.SLOT_TYPES:
        if isinstance(slot, NamespacedType) and has_lists(_class_of(slot)):
            return True
        if not isinstance(slot, BasicType | NamespacedType | AbstractGenericString | Array):
            return True
    return False


def fields_of(message: Any) -> list[Field]:
    """The fields of a message of rclpy."""
    slots = zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True)
    return [Field(kind, _value(kind, getattr(message, name))) for name, kind in slots]


def _value(kind: Any, value: Any) -> Any:
    if isinstance(kind, NamespacedType):
        return fields_of(value)
    if isinstance(kind, AbstractGenericString):
        return value.encode(errors="replace")
    if isinstance(kind, BasicType):
        return value[0] if isinstance(value, bytes) else value
    return [_value(kind.value_type, item) for item in value]


def encode(fields: list[Field]) -> bytes:
    """The CDR of a message."""
    out = bytearray()
    for field in fields:
        _write(out, field.kind, field.value)
    return HEADER + bytes(out or b"\0")


def _align(out: bytearray, size: int) -> None:
    out.extend(bytes(-len(out) % size))


def _write(out: bytearray, kind: Any, value: Any) -> None:
    if isinstance(kind, NamespacedType):
        for field in value:
            _write(out, field.kind, field.value)
    elif isinstance(kind, BasicType):
        _write_numbers(out, kind.typename, [value])
    elif isinstance(kind, AbstractGenericString):
        text, length = (value.content, value.length) if isinstance(value, Lie) else (value + b"\0", len(value) + 1)
        _write_numbers(out, "uint32", [length])
        out.extend(text)
    else:
        items, length = (value.content, value.length) if isinstance(value, Lie) else (value, len(value))
        if not isinstance(kind, Array):
            _write_numbers(out, "uint32", [length])
        if isinstance(kind.value_type, BasicType):
            _write_numbers(out, kind.value_type.typename, items)
        else:
            for item in items:
                _write(out, kind.value_type, item)


def _write_numbers(out: bytearray, typename: str, values: list[Any]) -> None:
    if values:
        letter = FORMATS[typename]
        _align(out, struct.calcsize(letter))
        out.extend(array(letter, values).tobytes())


class MessageGenerator:
    """Makes one odd message after the other; equal seeds and samples give equal ones."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self._samples: dict[type[Any], deque[bytes]] = defaultdict(lambda: deque(maxlen=SAMPLES_KEPT))
        self._sent: dict[type[Any], deque[bytes]] = defaultdict(lambda: deque(maxlen=SAMPLES_KEPT))
        self._ways: list[Callable[[type[Any]], bytes]] = [
            self.default, self.random, self.odd, self.odd, self.odd, self.cut, self.garbage, self.longer, self.shorter,
            self.swapped, self.flipped, self.repeated, self.sample,
        ]

    def learn(self, kind: type[Any], data: bytes) -> None:
        """Keep the bytes of a real message."""
        self._samples[kind].append(data)

    def next(self, kind: type[Any]) -> bytes:
        """The bytes of one more message for a topic or service of this class."""
        data = self.rng.choice(self._ways)(kind)
        self._sent[kind].append(data)
        return data

    def next_of_service(self, kind: type[Any]) -> bytes:
        """The bytes of one more request or response. Lists in it have the length that they say: rmw_fastrtps 8.4 checks
        that in messages of topics only, and 48 bytes of a request make any ROS 2 node allocate gigabytes."""
        if not has_lists(kind):
            return self.next(kind)
        return self.rng.choice([self.default, self.sample, self.longer, lambda kind: HEADER])(kind)

    def request(self, kind: type[Any]) -> Any:
        """A message of rclpy that anybody can send, plausible or not."""
        while True:
            make = self.rng.choice([self.default, self.random, self.odd, self.sample])
            try:
                return deserialize_message(make(kind), kind)
            except Exception:  # a list or string that lies
                continue

    # Ways to make one.

    def default(self, kind: type[Any]) -> bytes:
        return encode(fields_of(kind()))

    def sample(self, kind: type[Any]) -> bytes:
        return self.rng.choice(self._samples[kind]) if self._samples[kind] else self.default(kind)

    def random(self, kind: type[Any]) -> bytes:
        return encode(self._random_fields(kind))

    def odd(self, kind: type[Any]) -> bytes:
        """A sample with one to three odd values."""
        fields = self._fields(kind)
        for _ in range(self.rng.randint(1, 3)):
            self._spoil(fields)
        return encode(fields)

    def cut(self, kind: type[Any]) -> bytes:
        data = self.sample(kind)
        return data[: self.rng.choice([4, len(data) // 2, len(data) - 1, self.rng.randrange(4, len(data))])]

    def garbage(self, kind: type[Any]) -> bytes:
        data = self.rng.randbytes(self.rng.choice([1, 4, 8, 64, 1000]))
        return HEADER + data if self.rng.random() < 0.5 else data

    def longer(self, kind: type[Any]) -> bytes:
        """A later version of the type: further fields at the end."""
        return self.sample(kind) + self.rng.randbytes(self.rng.choice([1, 4, 24]))

    def shorter(self, kind: type[Any]) -> bytes:
        """An earlier version of the type: no last field."""
        return encode(self._fields(kind)[:-1])

    def swapped(self, kind: type[Any]) -> bytes:
        """Another version of the type: two fields have changed places."""
        fields = self._fields(kind)
        if len(fields) > 1:
            i, j = self.rng.sample(range(len(fields)), 2)
            fields[i], fields[j] = fields[j], fields[i]
        return encode(fields)

    def flipped(self, kind: type[Any]) -> bytes:
        data = bytearray(self.sample(kind))
        for _ in range(self.rng.randint(1, 8)):
            data[self.rng.randrange(len(data))] = self.rng.randrange(256)
        return bytes(data)

    def repeated(self, kind: type[Any]) -> bytes:
        """What was sent before, so out of its order."""
        return self.rng.choice(self._sent[kind]) if self._sent[kind] else self.sample(kind)

    def _fields(self, kind: type[Any]) -> list[Field]:
        return fields_of(deserialize_message(self.sample(kind), kind))

    def _random_fields(self, kind: type[Any]) -> list[Field]:
        slots = kind.SLOT_TYPES if kind.get_fields_and_field_types() else ()
        return [Field(slot, self._random_value(slot)) for slot in slots]

    def _random_value(self, kind: Any) -> Any:
        if isinstance(kind, NamespacedType):
            return self._random_fields(_class_of(kind))
        if isinstance(kind, BasicType):
            return self._number(kind.typename)
        if isinstance(kind, AbstractGenericString):
            return self._string()
        if isinstance(kind, Array):
            return [self._random_value(kind.value_type) for _ in range(kind.size)]
        if isinstance(kind.value_type, BasicType):
            return self._numbers(kind.value_type.typename)
        return [self._random_value(kind.value_type) for _ in range(self.rng.choice(LENGTHS[:6]))]

    def _number(self, typename: str) -> Any:
        if typename in ("float", "double"):
            return self.rng.choice(FLOATS)
        letter = FORMATS[typename]
        bits = 8 * struct.calcsize(letter)
        low, high = (0, 2**bits - 1) if letter.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        middle = (low + high) // 2
        return self.rng.choice([low, high, 0, 1, 2, 4, middle, middle + 1, high - 1, self.rng.randint(low, high)])

    def _numbers(self, typename: str) -> Any:
        length = LONG if self.rng.random() < 0.02 else self.rng.choice(LENGTHS)
        items = [self._number(typename) for _ in range(min(length, 64))]
        items = (items * (length // max(len(items), 1) + 1))[:length]
        return Lie(self.rng.choice([length + 1, 2**31, 2**32 - 1]), items) if self.rng.random() < 0.05 else items

    def _string(self) -> Any:
        text = self.rng.choice(STRINGS)
        kind = self.rng.random()
        if kind < 0.05:
            return Lie(len(text), text)
        return Lie(self.rng.choice([len(text) + 100, 2**31, 2**32 - 1]), text) if kind < 0.1 else text

    def _spoil(self, fields: list[Field]) -> None:
        """Give one field, however deep, another value."""
        if not fields:
            return
        field = self.rng.choice(fields)
        if isinstance(field.kind, NamespacedType) and field.value and self.rng.random() < 0.8:
            self._spoil(field.value)
            return
        kind = getattr(field.kind, "value_type", None)
        if isinstance(kind, BasicType) and isinstance(field.value, list) and field.value and self.rng.random() < 0.6:
            field.value = list(field.value)
            field.value[self.rng.randrange(len(field.value))] = self._number(kind.typename)
        else:
            field.value = self._random_value(field.kind)
