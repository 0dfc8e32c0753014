"""Peek into serialised messages without decoding them."""

import struct

_HEADER_BYTES, _STRING_AT, _TEXT_AT = 4, 12, 16


def session_and_seq(data: bytes | memoryview) -> tuple[int, int]:
    """Return (session, seq) of a message that starts with std_msgs/Header, uint64 session, uint64 seq.

    CDR: 4 bytes of encapsulation, then sec, nanosec, length and text of frame_id, then 8-byte alignment.

    Raises:
        ValueError: too short for such a message.
    """
    order = "<" if len(data) > 1 and data[1] else ">"
    try:
        (length,) = struct.unpack_from(f"{order}I", data, _STRING_AT)
        end = _TEXT_AT - _HEADER_BYTES + length
        session, seq = struct.unpack_from(f"{order}QQ", data, _HEADER_BYTES + end + (-end % 8))
    except struct.error:
        raise ValueError(f"{len(data)} bytes are too short for a header, session and seq") from None
    return session, seq
