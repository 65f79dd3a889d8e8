"""MCAP files of ROS 2 messages, written as a run goes on, by rosbags. The extra `ros` is needed, ROS itself is not.

rosbags writes folders. The file is written in a folder beside its place, and moved there when it is complete, so a file
of that name is always whole. Chunks are compressed (zstd) and written as they fill: memory does not grow with the run.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchfsid.errors import ConfigError, LogError, one_line

OURS = "/torchfsid/"
"""Topics of this package begin so."""


def require_new_mcap(path: Path) -> None:
    """Check that an MCAP file can be written. This is quick, so it comes before any work.

    Raises:
        ConfigError: the extra is missing, the name does not end with .mcap, something of that name exists, or its
            folder does not.
    """
    try:
        import rosbags.rosbag2
    except ImportError as error:
        raise ConfigError("--mcap: writing MCAP needs an extra: pip install 'torchfsid[ros]'") from error
    assert rosbags.rosbag2
    if path.suffix != ".mcap":
        raise ConfigError(f"--mcap: expected a name that ends with .mcap, got {path}")
    if path.exists():
        raise ConfigError(f"--mcap: {path} is there, and is not replaced; choose another name")
    if not path.resolve().parent.is_dir():
        raise ConfigError(f"--mcap: {path.resolve().parent} is no folder")


class McapFile:
    """An MCAP file that grows.

    A file that cannot be written (full disk) does not end the run: the file stops growing, and is removed at the end.

    Args:
        path: the file. It must not exist.
        source: a bag whose messages are copied into it, as they were received. None: no other messages.

    Attributes:
        problem: why the file stopped growing. None: it did not.

    Raises:
        OSError: it cannot be made.
        ConfigError: a type of the bag has no definition.
    """

    def __init__(self, path: Path, source: Path | None = None):
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        self.path, self.problem = path, None
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._folder = path.with_name(f"{path.name}.partial")
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        self._writer = Writer(self._folder / path.stem, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._connections: dict[str, Any] = {}
        self._copied = iter(()) if source is None else self._messages_of(source)
        try:
            self._next: tuple[Any, int, bytes] | None = next(self._copied, None)
        except BaseException:
            self._writer.abort()
            shutil.rmtree(self._folder, ignore_errors=True)
            raise

    @property
    def types(self) -> Any:
        """The classes of messages, by their type."""
        return self._store.types

    def write(self, topic: str, stamp: int, message: Any) -> None:
        """Write a message with the time `stamp` [ns], after the bag's messages of earlier times.

        A topic of the bag's is one topic, not two.
        """
        if self.problem is not None:
            return
        try:
            self._copy_until(stamp)
            kind = message.__msgtype__
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
            self._writer.write(self._connections[topic], stamp, self._store.serialize_cdr(message, kind))
        except OSError as error:
            self.problem = error

    def close(self) -> None:
        """Write the rest of the bag and the index, and move the file to its place.

        Raises:
            OSError: the file stopped growing, or cannot be completed. There is no file then.
        """
        try:
            if self.problem is None:
                self._copy_until(None)
                self._writer.close()
                written = self._folder / self.path.stem / f"{self.path.stem}.mcap"
                written.rename(self.path)
        except OSError as error:
            self.problem = error
        finally:
            if self.problem is not None:
                self._writer.abort()
            shutil.rmtree(self._folder, ignore_errors=True)
        if self.problem is not None:
            raise OSError(self.problem.errno, self.problem.strerror or str(self.problem), str(self.path))

    def _copy_until(self, stamp: int | None) -> None:
        """Copy the messages of the bag up to a time [ns], or all."""
        while self._next is not None and (stamp is None or self._next[1] <= stamp):
            self._writer.write(*self._next)
            self._next = next(self._copied, None)

    def _messages_of(self, source: Path) -> Iterator[tuple[Any, int, bytes]]:
        """The messages of a bag in the order of their times, each with its connection here."""
        from rosbags.rosbag2 import Reader

        try:
            with Reader(source) as reader:
                chosen = [c for c in reader.connections if not c.topic.startswith(OURS)]
                here = {connection.id: self._same(source, connection) for connection in chosen}
                for connection, time, raw in reader.messages(chosen) if chosen else ():
                    yield here[connection.id], time, bytes(raw)
        except (ConfigError, OSError):
            raise
        except Exception as error:  # damaged bytes make the parsers raise many kinds
            raise LogError(f"{source}: not a valid ROS bag: {one_line(error)}") from error

    def _same(self, source: Path, connection: Any) -> Any:
        """A connection of the file like that of a bag."""
        from rosbags.interfaces import MessageDefinitionFormat

        told: dict[str, Any] = {}
        if connection.msgdef.format is not MessageDefinitionFormat.NONE and connection.digest:
            told = {"msgdef": connection.msgdef.data, "rihs01": connection.digest}
        elif connection.msgtype in self.types:
            told = {"typestore": self._store}
        else:
            raise ConfigError(f"--merge: {source}: the type {connection.msgtype!r} has no definition in the bag")
        made = self._writer.add_connection(
            connection.topic,
            connection.msgtype,
            serialization_format=connection.ext.serialization_format,
            offered_qos_profiles=connection.ext.offered_qos_profiles,
            **told,
        )
        return self._connections.setdefault(connection.topic, made)
