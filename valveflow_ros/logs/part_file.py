# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A file that is being written and gets its final name only when it is complete.

It is written as ``NAME.mcap.part``, which is locked as long as its writer lives,
and renamed when it is finished. A ``.part`` file without a lock therefore belongs
to a writer that died.
"""

from __future__ import annotations

import errno
import fcntl
import os
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PART_SUFFIX = '.part'
FILE_MODE = 0o600
FOLDER_MODE = 0o700
_TRIES = 20
_BLOCK = 1 << 20


class AlteredError(OSError):
    """Another program removed, replaced or changed a file that is being written."""


def _os_error(number: int, path: Path) -> OSError:
    # Python makes of it what the number says, such as a `FileExistsError`.
    return OSError(number, os.strerror(number), str(path))


class PartFile:
    """A file on disk that is being written.

    Raises `FileExistsError` if the ``.part`` file already exists.

    Parameters
    ----------
    path : Path
        The final name of the file.
    replace : bool
        Replace an unlocked ``.part`` file that a dead writer left, and on `publish` a file that
        has the final name.
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
        """Append bytes and return how many were written."""
        taken = os.write(self._descriptor, data)
        self._changed_ns = os.fstat(self._descriptor).st_mtime_ns
        return taken

    def sync(self) -> None:
        """Flush all data to disk."""
        os.fdatasync(self._descriptor)

    def check(self, size: int) -> None:
        """Check that the file still has its name and ``size`` bytes.

        Raises `AlteredError` if not, whose text continues a sentence that begins with the file's
        name, and `OSError` if this cannot be determined.
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
        """Return True if another program may have written to the file since the last `write`.

        Each change is reported once; a file system that sets the time late causes a false one.
        """
        changed_ns = os.fstat(self._descriptor).st_mtime_ns
        touched, self._changed_ns = changed_ns != self._changed_ns, changed_ns
        return touched

    def publish(self) -> None:
        """Rename the file to its final name, durably.

        Raises `FileExistsError` if another file has that name and must not be replaced, and as
        `check` does.
        """
        os.fsync(self._descriptor)
        self._check_name(self.part)
        if not self._replace and os.path.lexists(self.path):
            raise _os_error(errno.EEXIST, self.path)
        os.replace(self.part, self.path)
        # Another program may have replaced the file since the first check.
        self._check_name(self.path)
        sync_folder(self.path.parent)

    def close(self) -> None:
        """Close the file and release its lock."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            # The descriptor is closed in any case, and `sync` has reported write errors before.
            with suppress(OSError):
                os.close(descriptor)

    def discard(self) -> None:
        """Close and remove the file; a different file with its name is kept."""
        with suppress(OSError):
            self._check_name(self.part)
            self.part.unlink()
        self.close()

    def _check_name(self, path: Path) -> None:
        try:
            named = path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            raise AlteredError('was removed or renamed by another program') from None
        if not os.path.samestat(named, os.fstat(self._descriptor)):
            raise AlteredError('was replaced by another file')


def _made(part: Path) -> int:
    """Create and lock a file and return its descriptor.

    Before it is locked, another process may take it for the empty file of a dead writer and
    remove it. In this case it is created again.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
    for left in reversed(range(_TRIES)):
        descriptor = os.open(part, flags, FILE_MODE)
        try:
            # The umask may have removed permissions.
            os.fchmod(descriptor, FILE_MODE)
            fcntl.flock(descriptor, fcntl.LOCK_EX if left else fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(descriptor).st_nlink:
                return descriptor
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise _os_error(errno.ENOENT, part)


@contextmanager
def new_file(path: Path, kind: Callable[..., PartFile] = PartFile) -> Iterator[PartFile]:
    """Yield a file to write and publish; it is removed if anything fails before that."""
    make_folder(path.parent)
    out = kind(path, replace=True)
    try:
        yield out
    except BaseException:
        out.discard()
        raise


def sync_folder(folder: Path) -> None:
    """Flush the directory entries of a folder to disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create a folder and its parents with access for the owner only, where they are missing."""
    for missing in reversed([folder, *folder.parents]):
        if not os.path.isdir(missing):
            try:
                missing.mkdir(mode=FOLDER_MODE, exist_ok=True)
            except FileExistsError:
                raise _os_error(errno.ENOTDIR, missing) from None


def is_held(part: Path) -> bool:
    """Return True if a living writer holds a ``.part`` file."""
    with taken(part) as free:
        return not free


@contextmanager
def taken(part: Path) -> Iterator[bool]:
    """Lock a ``.part`` file of a dead writer, so that only one process recovers it.

    Yields False if a living writer holds it, or if it has just been removed.
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
    """Write a small file atomically: a reader sees the old content or the new one."""
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
    """Return numbers that change when a file is changed or replaced; None if it has none.

    For a link they describe both the target and the link.
    """
    try:
        found, link = path.stat(), path.lstat()
    except OSError:
        return None
    times = found.st_mtime_ns, found.st_ctime_ns
    return found.st_dev, found.st_ino, found.st_size, *times, link.st_ino
