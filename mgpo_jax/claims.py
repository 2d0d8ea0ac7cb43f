"""Claims on folders: only one process works in a folder at a time, and others are told which one it is.

A claim is an operating-system lock on a file in the folder. The lock ends with the process, however the
process ends, so that nothing has to be cleaned up by hand.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from envs.errors import DataError, UsageError, printable

LOCK = ".lock"
ATTEMPTS = 1000  # to lock a folder while other processes create and remove it
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)  # the disk is full
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # the file system has no locks
_ON_EXIT: list[Callable[[], None]] = []


class InUseError(DataError):
    """Another process works in a folder."""


class Claim:
    """A folder on which this process holds a claim."""

    def __init__(self, folder: Path, descriptor: int, made: Sequence[Path]) -> None:
        self.folder = folder
        self._descriptor = descriptor
        self._made = made  # the parent folders that were created, innermost first

    def leave(self) -> None:
        """Remove the lock file, and the folders that were created if they are empty."""
        if _is_still_at(self.folder / LOCK, self._descriptor):
            (self.folder / LOCK).unlink(missing_ok=True)
            with suppress(OSError):
                for folder in (self.folder, *self._made):
                    folder.rmdir()  # fails unless the folder is empty

    def close(self) -> None:
        """Release the folder."""
        self.leave()
        os.close(self._descriptor)


@contextmanager
def claimed(folder: Path, wait: bool = False) -> Iterator[None]:
    """Claim a folder for the duration of the block.

    The folder and its parents are created if they are missing. Afterwards those of them that are empty are
    removed.

    Args:
      folder: the folder.
      wait: whether to wait for a process that holds the folder, after a line on stderr that says so.

    Raises:
      InUseError: if another process holds the folder.
      UsageError: if the folder is not writable.
    """
    if not os.path.exists(folder):
        check_place(folder, num_bytes=0)
    made = [above for above in folder.absolute().parents if not above.exists()]
    descriptor = None
    for _ in range(ATTEMPTS):
        descriptor = _try_to_hold(folder, wait)
        if descriptor is not None:
            break
        time.sleep(0.001)
    else:
        raise cannot_write(folder, "another process keeps creating and removing it")
    claim = Claim(folder, descriptor, made)
    try:
        with cleaned_on_exit(claim.leave):
            yield
    finally:
        claim.close()


def _try_to_hold(folder: Path, wait: bool) -> int | None:
    """Lock a folder; returns the file descriptor, or None if another process removed the folder
    meanwhile."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except (FileNotFoundError, FileExistsError) as error:
        if os.path.lexists(folder) and not folder.is_dir():
            raise cannot_write(folder, error.strerror) from None
        return None
    except OSError as error:
        if error.errno in NO_ROOM:
            raise  # a full disk is not the user's error
        raise cannot_write(folder, error.strerror) from None
    try:
        _lock(descriptor, folder, wait)
        if _is_still_at(folder / LOCK, descriptor):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"{os.getpid()} on {socket.gethostname()}\n".encode())
            return descriptor
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


def _lock(descriptor: int, folder: Path, wait: bool) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = printable(os.pread(descriptor, 200, 0).decode(errors="replace").strip())
        who = f"process {holder}" if holder else "another process"
        if not wait:
            raise InUseError(
                f"{folder} is in use by {who}; wait until it finishes, or choose another folder with --out"
            ) from None
        print(f"waiting for {who}, which works in {folder}", file=sys.stderr)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _is_still_at(path: Path, descriptor: int) -> bool:
    """Whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except OSError:
        return False


def cannot_write(folder: Path, reason: str | None) -> UsageError:
    """The error for a folder in which nothing can be written."""
    return UsageError(f"cannot write to {folder} ({reason}); choose another folder with --out")


def check_place(path: Path, flag: str = "--out", num_bytes: int = 1 << 20) -> None:
    """Raise ``UsageError`` if nothing can be written at a path that does not exist yet.

    Args:
      path: the file or folder to be created.
      flag: the flag that names the path, for the message.
      num_bytes: number of bytes that must be free there.
    """
    place = path.absolute()
    try:
        longest = max(len(os.fsencode(part)) for part in place.parts)
        while not os.path.exists(place):
            place = place.parent
        too_long = longest + len(".partial") > os.pathconf(place, "PC_NAME_MAX")
        free = shutil.disk_usage(place).free
    except FileNotFoundError:  # another process has removed it since
        return check_place(path, flag, num_bytes)
    except OSError as error:
        raise UsageError(f"{flag} {printable(str(path))}: {error.strerror}") from None
    fault = None
    if too_long:
        fault = "its name is too long"
    elif not os.path.isdir(place):
        fault = f"{place} is not a folder"
    elif not os.access(place, os.W_OK | os.X_OK):
        fault = f"{place} is not writable"
    elif free < num_bytes:
        fault = f"{place} has {free / 1e6:.1f} MB free, {num_bytes / 1e6:.0f} MB are needed"
    if fault and not os.path.lexists(place):
        return check_place(path, flag, num_bytes)
    if fault:
        raise UsageError(f"{flag} {printable(str(path))}: {fault}; choose another place")
    return None


@contextmanager
def cleaned_on_exit(clean: Callable[[], None]) -> Iterator[None]:
    """Call ``clean`` if a signal ends the process within the block."""
    _ON_EXIT.append(clean)
    try:
        yield
    finally:
        _ON_EXIT.remove(clean)


def clean_up() -> None:
    """Run the clean-up functions of all active ``cleaned_on_exit`` blocks, innermost first."""
    for clean in reversed(_ON_EXIT):
        with suppress(OSError):
            clean()
