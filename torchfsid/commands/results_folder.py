"""The results folder: one owner at a time, never two runs mixed, and no half-written file.

A folder belongs to the kind of command whose config.yaml it holds: `observe`, or the `kind` of an experiment. The file
`.torchfsid` lists the names of the files written there, one a line. The next run of the same kind removes exactly these
files. If a file that is to be written exists and is not listed, it is somebody else's, and the folder is refused.
`.torchfsid` is locked while a command writes. A subfolder that a run wrote belongs to that run: it is no --out.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from torchfsid.errors import ConfigError

try:
    import fcntl
except ImportError:  # Windows: there is no lock there
    fcntl = None

MANIFEST = ".torchfsid"

OBSERVE = "observe"
"""The kind of a folder whose config.yaml has no `kind`."""


class ResultsFolder:
    """A folder that one command writes to.

    Args:
        path: the folder. `claim` makes it.
        kind: the kind of results that it holds. None: any folder will do, and the command adds files to what is there.

    Attributes:
        claimed: this command owns the folder now.
        replaced: names of the files of an earlier run that `claim` removed.
    """

    def __init__(self, path: Path, kind: str | None):
        self.path, self.kind = path, kind
        self.replaced: tuple[str, ...] = ()
        self._lock: BinaryIO | None = None

    @property
    def claimed(self) -> bool:
        """Does this command own the folder now?"""
        return self._lock is not None

    def require_ours(self) -> None:
        """Check that the folder may be used. This is quick, so it comes before any work.

        Raises:
            ConfigError: `path` is not a folder, is a subfolder that a run wrote, or holds the results of another kind
                of command.
        """
        if self.path.exists() and not self.path.is_dir():
            raise ConfigError(f"--out: {self.path} is not a folder")
        whole = self.path.resolve()
        if any(name.startswith(f"{whole.name}/") for name in _listed(whole.parent / MANIFEST)):
            raise ConfigError(f"{self.path}: belongs to the results in {whole.parent}; choose another --out")
        held = self._kind_held()
        if self.kind is not None and held not in (None, self.kind):
            what = f"the results of '{held}'" if held else "a config.yaml that is not of a run"
            raise ConfigError(f"{self.path}: holds {what}; choose another --out, or remove it")

    def claim(self, files: Iterable[str], config: str | None = None, resume: bool = False) -> None:
        """Become the owner, remove what an earlier run left, and write config.yaml before anything else.

        Args:
            files: names of all files that will be written, relative to the folder, with "/" after a subfolder.
            config: the content of config.yaml.
            resume: keep what is there, if its config.yaml is the same.

        Raises:
            ConfigError: see `require_ours`. Also if another command is writing there, if a file that would be replaced
                was not written by a run, or if `resume` finds another config.yaml.
            OSError: the folder cannot be made or written to.
        """
        self.require_ours()
        self.path.mkdir(parents=True, exist_ok=True)
        manifest, names = self.path / MANIFEST, [*(["config.yaml"] if config is not None else []), *files]
        is_new = not manifest.exists()
        lock = manifest.open("a+b")
        try:
            _lock(lock, self.path)
            self.require_ours()
            if resume and config is not None and _text(self.path / "config.yaml") not in (None, config):
                raise ConfigError(f"{self.path}: holds another {self.kind}; choose another --out, or remove it")
            listed = _listed(manifest)
            foreign = [name for name in names if name not in listed and (self.path / name).exists()]
            if foreign and not resume:
                raise ConfigError(f"{self.path}: {foreign[0]} is there, and no run left it; choose another --out")
        except BaseException:
            lock.close()
            if is_new:
                manifest.unlink(missing_ok=True)
            raise
        self._lock = lock
        if not resume:
            # A command that adds to a folder replaces its own files only.
            mine = names if self.kind is None else [*listed, *names]
            self.replaced = tuple(name for name in dict.fromkeys(mine) if (self.path / name).is_file())
            for name in dict.fromkeys(mine):
                self._remove(name)
            listed = [name for name in listed if name not in mine]
        lock.truncate(0)
        with named(self.path / MANIFEST):
            lock.write("".join(f"{name}\n" for name in dict.fromkeys([*listed, *names])).encode())
            lock.flush()
        if config is not None:
            write_whole(self.path / "config.yaml", config)

    def release(self) -> None:
        """Give up the ownership."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _kind_held(self) -> str | None:
        """The kind of command whose config.yaml the folder holds.

        It is "" if no command wrote the file, and None if there is no such file.
        """
        from torchfsid.config.documents import read_yaml

        path = self.path / "config.yaml"
        if not path.exists():
            return None
        try:
            content = read_yaml(path)
        except ConfigError:
            return ""
        of_observe = "task" in content or "tasks" in content
        return str(content.get("kind", OBSERVE if of_observe else ""))

    def _remove(self, name: str) -> None:
        """Remove a file of this command, and its subfolder if that is then empty."""
        relative = PurePosixPath(name)
        if not name or relative.is_absolute() or ".." in relative.parts:
            return
        path = self.path / relative
        if path.is_file() or path.is_symlink():
            path.unlink(missing_ok=True)
        if path.parent != self.path:
            with suppress(OSError):
                path.parent.rmdir()


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """In this block write the yielded file. At its end the file becomes `path`. After an error `path` is as it was."""
    partial = path.with_name(path.name + ".partial")
    try:
        with named(path):
            yield partial
            partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        OSError: it cannot be written. The file at `path` is then unchanged.
    """
    with whole(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file whole or not at all. Numbers that are not finite become null, because JSON has none."""
    write_whole(path, json.dumps(_finite(content), indent=1, allow_nan=False) + "\n")


@contextmanager
def named(path: Path) -> Iterator[None]:
    """In this block an error of the operating system that names no file gets the name of this file."""
    try:
        yield
    except OSError as error:
        if error.filename is not None and not str(error.filename).endswith(".partial"):
            raise
        raise OSError(error.errno, error.strerror or str(error), os.fspath(path)) from error


def _finite(content: Any) -> Any:
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    return [_finite(value) for value in content] if isinstance(content, list | tuple) else content


def _lock(file: BinaryIO, folder: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ConfigError(f"{folder}: another command is writing there") from error
    except OSError:  # a file system without locks
        return


def _listed(manifest: Path) -> list[str]:
    """The names of the files that the runs in a folder wrote."""
    return manifest.read_text(encoding="utf-8", errors="replace").splitlines() if manifest.exists() else []


def _text(path: Path) -> str | None:
    return path.read_text(encoding="utf-8") if path.exists() else None
