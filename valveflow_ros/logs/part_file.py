# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A file that is being written: it carries its own name only when it is whole.

It is written as ``NAME.mcap.part``, locked as long as its writer lives, and
renamed when finished, so whoever finds a ``.part`` without a lock knows that
its writer died.
"""

from __future__ import annotations

import errno
import fcntl
import os
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

PART_SUFFIX = '.part'
FILE_MODE = 0o600
FOLDER_MODE = 0o700
_TRIES = 20
_BLOCK = 1 << 20


class AlteredError(OSError):
    """Another program removed, replaced or changed a file that is being written."""


class Writable(Protocol):
    """What a recording is written to."""

    def write(self, data: bytes) -> int:
        """Append bytes and return how many were taken; raises `OSError`."""

    def sync(self) -> None:
        """Bring everything to the disk; raises `OSError`."""

    def check(self, size: int) -> None:
        """See that the file still has its name and ``size`` bytes; raises `AlteredError`."""

    def check_content(self, size: int, crc: int) -> None:
        """Read ``size`` bytes back; raises `AlteredError` if they have another CRC-32."""

    @property
    def touched(self) -> bool:
        """Return True if somebody may have written into the file since `write` last did."""

    path: Path

    def publish(self) -> None:
        """Give the file its own name, ``path``; raises `OSError`."""

    def close(self) -> None:
        """Let go of the file, finished or not."""

    def discard(self) -> None:
        """Let go of an unfinished file and remove it: nothing worth keeping is in it."""


class PartFile:
    """The real thing; see `Writable`.

    Parameters
    ----------
    path : Path
        The name of the finished file.
    replace : bool
        Take the place of an unlocked ``.part`` that a dead writer left, and at the end of a file
        of the finished one's name.

    Raises
    ------
    OSError
        `FileExistsError` if the ``.part`` stands there already.
    """

    def __init__(self, path: Path, replace: bool = False) -> None:
        self.path = path
        self._replace = replace
        self.part = path.with_name(path.name + PART_SUFFIX)
        if replace and self.part.exists() and not is_held(self.part):
            self.part.unlink()
        self._descriptor = _made(self.part)
        self._changed_ns = 0

    def write(self, data: bytes) -> int:
        """Append bytes and return how many were taken."""
        taken = os.write(self._descriptor, data)
        self._changed_ns = os.fstat(self._descriptor).st_mtime_ns
        return taken

    def sync(self) -> None:
        """Bring everything to the disk."""
        os.fdatasync(self._descriptor)

    def check(self, size: int) -> None:
        """See that the file still has its name and ``size`` bytes.

        Raises
        ------
        AlteredError
            It has not; the text continues a sentence that begins with its name.
        OSError
            It cannot be found out.
        """
        self._check_name(self.part)
        if os.fstat(self._descriptor).st_size != size:
            raise AlteredError('was cut or extended by another program')

    def check_content(self, size: int, crc: int) -> None:
        """Read ``size`` bytes back and compare their CRC-32; raises as `check` does."""
        found = 0
        for start in range(0, size, _BLOCK):
            block = os.pread(self._descriptor, min(_BLOCK, size - start), start)
            found = zlib.crc32(block, found)
        if found != crc:
            raise AlteredError('was changed by another program')

    @property
    def touched(self) -> bool:
        """Return True if somebody may have written into the file since `write` last did.

        Once for each change: a file system may put the time of a write right afterwards.
        """
        changed_ns = os.fstat(self._descriptor).st_mtime_ns
        touched, self._changed_ns = changed_ns != self._changed_ns, changed_ns
        return touched

    def publish(self) -> None:
        """Give the file its own name, durably.

        Raises
        ------
        FileExistsError
            Somebody else's file has that name and is not to be replaced.
        AlteredError, OSError
            As `check`; it cannot be done.
        """
        os.fsync(self._descriptor)
        self._check_name(self.part)
        if not self._replace and os.path.lexists(self.path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.path))
        os.replace(self.part, self.path)
        # Between the two somebody may have put another file there.
        self._check_name(self.path)
        sync_folder(self.path.parent)

    def close(self) -> None:
        """Let go of the file and its lock."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            # It is gone whatever the system answers, and `sync` has told of errors before.
            with suppress(OSError):
                os.close(descriptor)

    def discard(self) -> None:
        """Let go of the file and remove it; another file of its name stays."""
        with suppress(OSError):
            self._check_name(self.part)
            self.part.unlink()
        self.close()

    def _check_name(self, path: Path) -> None:
        """Raise `AlteredError` unless ``path`` names the file that is open."""
        try:
            named = path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            raise AlteredError('was removed or renamed by another program') from None
        if not os.path.samestat(named, os.fstat(self._descriptor)):
            raise AlteredError('was replaced by another file')


def _made(part: Path) -> int:
    """Return a descriptor of a new file that is locked.

    Between making and locking somebody may look whether it is a leftover, and even take it for an
    empty one and remove it: then it is made again.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
    for left in reversed(range(_TRIES)):
        descriptor = os.open(part, flags, FILE_MODE)
        try:
            # The umask may have taken rights away; nothing may have added any.
            os.fchmod(descriptor, FILE_MODE)
            fcntl.flock(descriptor, fcntl.LOCK_EX if left else fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(descriptor).st_nlink:
                return descriptor
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(part))


@contextmanager
def new_file(path: Path) -> Iterator[PartFile]:
    """Give a file to be written and published; whatever fails meanwhile, nothing of it stays."""
    make_folder(path.parent)
    out = PartFile(path, replace=True)
    try:
        yield out
    except BaseException:
        out.discard()
        raise


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, that only its owner can enter; one that exists stays."""
    for missing in reversed([folder, *folder.parents]):
        if not os.path.isdir(missing):
            try:
                missing.mkdir(mode=FOLDER_MODE, exist_ok=True)
            except FileExistsError:
                raise NotADirectoryError(
                    errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(missing)
                ) from None


def is_held(part: Path) -> bool:
    """Tell whether a living writer holds a ``.part``."""
    with taken(part) as free:
        return not free


@contextmanager
def taken(part: Path) -> Iterator[bool]:
    """Hold a ``.part`` that no living writer holds, so that nobody else takes it up meanwhile.

    Gives False if one does, or if the file is gone by now.
    """
    descriptor = os.open(part, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = os.fstat(descriptor).st_nlink > 0
        except BlockingIOError:
            free = False
        yield free
    finally:
        os.close(descriptor)


def write_whole(path: Path, data: bytes) -> None:
    """Put a small file in place at once: it is the old one or the new one, never half."""
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.{threading.get_ident()}.tmp')
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(temporary, flags, FILE_MODE)
    try:
        os.fchmod(descriptor, FILE_MODE)
        view = memoryview(data)
        while view:
            view = view[os.write(descriptor, view) :]
        os.fsync(descriptor)
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise
    finally:
        os.close(descriptor)
    sync_folder(path.parent)


def mark_of(path: Path) -> tuple[int, ...] | None:
    """Return by what a file is known again without reading it; None if that is not found out.

    Of what a link leads to, and of the link.
    """
    try:
        found, link = path.stat(), path.lstat()
    except OSError:
        return None
    return (
        found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns,
        link.st_ino,
    )  # fmt: skip
