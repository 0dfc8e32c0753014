"""The message types of a bag: ROS 2 Jazzy's own and wm_msgs, as rosbags needs them (text, CDR code, RIHS01 hash)."""

import os
from functools import lru_cache
from pathlib import Path

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from wm_nodes.recording.errors import BagError

PACKAGE = "wm_msgs"
_SEPARATOR = "=" * 80 + "\n"


def message_folder() -> Path:
    """Return the folder of our .msg files: the installed wm_msgs package first, else the repository's msgs_schema.

    Raises:
        BagError: neither exists.
    """
    prefixes = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    candidates = [prefix / "share" / PACKAGE / "msg" for prefix in prefixes]
    candidates += [parent / "msgs_schema" / "msg" for parent in Path(__file__).resolve().parents]
    for folder in candidates:
        if any(folder.glob("*.msg")):
            return folder
    raise BagError(
        f"no {PACKAGE} .msg files on AMENT_PREFIX_PATH or beside the repository; source ros2_ws/install/setup.bash"
    )


@lru_cache(maxsize=1)
def message_texts() -> dict[str, str]:
    """Full type name to the .msg text as written, comments included."""
    files = sorted(message_folder().glob("*.msg"))
    return {f"{PACKAGE}/msg/{path.stem}": path.read_text(encoding="utf-8") for path in files}


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """ROS 2 Jazzy's types and ours. The same object in every call; do not register other types in it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in message_texts().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@lru_cache(maxsize=256)
def type_hash(msgtype: str) -> str:
    """The RIHS01 hash (REP 2011) of a message type; equal to rosidl's."""
    _check_known(msgtype)
    return typestore().hash_rihs01(msgtype)


@lru_cache(maxsize=256)
def _definition_hash(msgtype: str, text: str, is_idl: bool) -> str:
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_idl(text) if is_idl else get_types_from_msg(text, msgtype))
        return store.hash_rihs01(msgtype)
    except Exception:  # whatever a parser makes of a foreign text
        return ""


def recorded_hash(connection: Connection) -> str:
    """The RIHS01 hash of a recorded topic's type: as its writer says, else of the recorded definition, which may differ
    from ours in comments and order; "" where the bag tells neither."""
    if connection.digest:
        return connection.digest
    definition = connection.msgdef
    if definition.format is MessageDefinitionFormat.NONE:
        return ""
    return _definition_hash(connection.msgtype, definition.data, definition.format is MessageDefinitionFormat.IDL)


def other_type(connection: Connection) -> str:
    """How the type of a recorded topic differs from ours; "" where it is the same, or not known to be another."""
    if not is_known(connection.msgtype):
        return ""
    recorded, ours = recorded_hash(connection), type_hash(connection.msgtype)
    return f"another {connection.msgtype} ({recorded}, ours is {ours})" if recorded not in ("", ours) else ""


@lru_cache(maxsize=256)
def message_definition(msgtype: str) -> str:
    """The text to embed in a bag: the type, then every type it needs; ours with their comments (units, order)."""
    _check_known(msgtype)
    generated, _ = typestore().generate_msgdef(msgtype, ros_version=2)
    head, *parts = generated.split(_SEPARATOR)
    texts = message_texts()
    sections = [texts.get(msgtype, head)]
    for part in parts:
        title, _, body = part.partition("\n")
        name = title.removeprefix("MSG: ").replace("/", "/msg/")
        sections.append(f"{title}\n{texts.get(name, body)}")
    return _SEPARATOR.join(section if section.endswith("\n") else section + "\n" for section in sections)


def is_known(msgtype: str) -> bool:
    return msgtype in typestore().fielddefs


def _check_known(msgtype: str) -> None:
    if not is_known(msgtype):
        raise BagError(f"unknown message type {msgtype!r}; known: ROS 2 Jazzy's common interfaces and {PACKAGE}")
