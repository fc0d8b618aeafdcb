"""The files of a bag, by rosbags: one reader of ROS 1 and ROS 2, which needs no more than it reads.

A definition counts when a message of its type is read: that of another topic may be anything.
"""

from __future__ import annotations

import importlib
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from heapq import merge
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

SEVERAL = "several types"
_DEFINITIONS = ("ros2msg", "ros2idl", "")
"""Encodings of definitions in MCAP that are read; Foxglove writes others beside them."""
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_TOPICS = """SELECT topics.id, name, type, type_description_hash, count(messages.id),
    serialization_format, offered_qos_profiles FROM topics
    LEFT JOIN messages ON messages.topic_id = topics.id GROUP BY topics.id ORDER BY topics.id"""
_DEFINED = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
_SPAN = "SELECT min(timestamp), max(timestamp), count(*) FROM messages"
_IDL_FILE = "=" * 80 + "\n"
_ANY_DIGEST = "*"  # what topic_tools and rostopic write for the md5 of a type
_ZSTD = b"\x28\xb5\x2f\xfd"  # how a compressed message begins; CDR never does
_ZSTD_MODULES = ("compression.zstd", "backports.zstd", "zstandard")


class RosbagFiles:
    """An open bag of any kind, or one in several files; :meth:`close` it.

    Attributes
    ----------
    is2 : whether it is one of ROS 2
    connections : one for each topic, type and file

    Raises whatever rosbags stumbles over.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.is2 = any(path.suffix != ".bag" for path in paths)
        self._default = get_typestore(Stores.LATEST if self.is2 else Stores.ROS1_NOETIC)
        self._stores: dict[str, Typestore] = {}
        with ExitStack() as stack:
            kind: Any = _Reader2 if self.is2 else Reader1
            self._readers: list[Any] = [stack.enter_context(kind(path)) for path in paths]
            self._open = stack.pop_all()
        self.connections: list[Connection] = [c for r in self._readers for c in r.connections]

    def close(self) -> None:
        """Close all files."""
        self._open.close()

    @property
    def start_time(self) -> int:
        """Receive time (ns) of the earliest message."""
        first: int = min(reader.start_time for reader in self._readers)
        return first

    @property
    def topics(self) -> Mapping[str, tuple[str, int]]:
        """Topic -> (message type, number of messages that the files promise)."""
        found: dict[str, tuple[str, int]] = {}
        for connection in sorted(self.connections, key=lambda connection: connection.topic):
            kind, count = connection.msgtype, connection.msgcount
            if connection.topic in found:
                before, counted = found[connection.topic]
                kind, count = kind if kind == before else SEVERAL, count + counted
            found[connection.topic] = kind, count
        return found

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[Connection, int, bytes]]:
        """(connection, receive time (ns), bytes) of every message of some topics, by time."""
        streams = []
        for reader in self._readers:
            if wanted := [c for c in reader.connections if c.topic in topics]:
                streams.append(reader.messages(connections=wanted))
        for connection, received, raw in merge(*streams, key=lambda message: message[1]):
            compressed = self.is2 and raw[:4] == _ZSTD
            yield connection, received, _decompress(raw) if compressed else raw

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """A message of a type by the definition in the bag, or else by that of ROS."""
        if kind not in self._stores:
            candidates = (self._registered(c) for c in self.connections if c.msgtype == kind)
            self._stores[kind] = next(filter(None, candidates), self._default)
        store = self._stores[kind]
        return store.deserialize_cdr(raw, kind) if self.is2 else store.deserialize_ros1(raw, kind)

    def _registered(self, connection: Connection) -> Typestore | None:
        """A store with the definition of a connection; None if it is missing, or cannot be it."""
        kind, digest = connection.msgtype, connection.digest
        store = get_typestore(Stores.EMPTY)
        try:
            store.register(_types_of(connection.msgdef, kind))
            store.get_msgdef(kind)  # with all types that are in it
            if digest in ("", None, _ANY_DIGEST):
                return store
            computed = store.hash_rihs01(kind) if self.is2 else store.generate_msgdef(kind)[1]
        except Exception:  # whatever its parser stumbles over
            return None
        return store if computed == digest or kind not in self._default.fielddefs else None


class _Schemas(dict[int, Any]):
    """Schemas of an MCAP file; one of another encoding, as of protobuf or JSON, is a mere name."""

    def __setitem__(self, key: int, schema: Any) -> None:
        if schema.encoding not in _DEFINITIONS:
            schema = schema._replace(encoding="", data="")
        super().__setitem__(key, schema)


class _Mcap(McapReader):
    def __init__(self, path: Any) -> None:
        super().__init__(path)
        self.schemas = _Schemas()


class _Database(Sqlite3Reader):
    """A ``.db3``, also one in which a type has no definition (``unknown``, as rosbag2 writes)."""

    def open(self) -> None:
        try:
            super().open()
        except (KeyError, AssertionError):  # as older and newer rosbags put it
            place = Path(str(self.path)).resolve().as_uri()
            database: Any = sqlite3.connect(f"{place}?immutable=1", uri=True)
            try:
                self._list(database)
            except BaseException:
                database.close()
                raise
            self.dbconn = database

    def _list(self, database: sqlite3.Connection) -> None:
        """The topics, those without a definition too."""
        none = MessageDefinition(MessageDefinitionFormat.NONE, "")
        definitions = {
            kind: MessageDefinition(_FORMATS[encoding], text)
            for kind, encoding, text in database.execute(_DEFINED)
            if encoding in _FORMATS
        }
        self.connections = [
            Connection(number, name, kind, definitions.get(kind, none), digest, count, ext, self)
            for number, name, kind, digest, count, *qos in database.execute(_TOPICS)
            for ext in [ConnectionExtRosbag2(qos[0], parse_qos(qos[1]))]
        ]
        first, last, count = database.execute(_SPAN).fetchone()
        if count:
            span = {"start_time": first, "end_time": last + 1, "duration": last + 1 - first}
            self.metadata = self.metadata._replace(message_count=count, **span)


class _Folder(DirectoryReader):
    """A folder whose metadata may describe topics otherwise than its files, and count too few."""

    STORAGE_PLUGINS: Mapping[str, Any] = MappingProxyType({"mcap": _Mcap, "sqlite3": _Database})

    def open(self) -> None:
        super().open()
        for storage in self.storages:
            storage.connections[:] = [self._as_described(c) for c in storage.connections]
        self.connections[:] = [self._counted(c) for c in self.connections]

    def _as_described(self, found: Connection) -> Connection:
        """A topic of a file with the QoS of the metadata: rosbags reads no other."""
        same = [c.ext for c in self.connections if _is_same(c, found)]
        return found if found.ext in same or not same else found._replace(ext=same[0])

    def _counted(self, found: Connection) -> Connection:
        there = [c for storage in self.storages for c in storage.connections if _is_same(c, found)]
        count = sum(c.msgcount for c in there if c.ext == found.ext)
        few = isinstance(found.msgcount, int) and found.msgcount < count
        return found._replace(msgcount=count) if few else found


def _is_same(one: Connection, other: Connection) -> bool:
    return (one.topic, one.msgtype) == (other.topic, other.msgtype)


class _Reader2(Reader2):
    STORAGE_PLUGINS: Mapping[str, Any] = MappingProxyType(
        {"dir": _Folder, ".mcap": _Mcap, ".db3": _Database}
    )


def _types_of(definition: MessageDefinition, kind: str) -> Any:
    """The types of a definition; a ValueError if there is none."""
    text = definition.data
    if definition.format == MessageDefinitionFormat.NONE or not text.strip():
        raise ValueError("no definition")
    if definition.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(text, kind)
    if not text.startswith(f"{_IDL_FILE}IDL: "):
        return get_types_from_idl(text)
    types: dict[str, Any] = {}
    for part in text.split(_IDL_FILE)[1:]:
        types |= get_types_from_idl(part.partition("\n")[2])
    return types


def _decompress(raw: bytes) -> bytes:
    """A message of a file of a bag of compressed messages, whose metadata are not beside it."""
    for name in _ZSTD_MODULES:
        try:
            module = importlib.import_module(name)
        except ImportError:
            continue
        return bytes(module.decompress(raw))
    raise ValueError("compressed messages: open the folder with its metadata.yaml")
