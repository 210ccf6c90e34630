"""Files that are written whole or not at all.

A file is written to a temporary file in its own folder, whose name ends in `.part`, and moved into
place once the disk has all of it. A crash, a kill or a full disk therefore leaves the old file. The
writer holds a lock on its `.part` file, and the kernel drops the lock when the writer dies: the
next writer of the same file removes every `.part` file of it that nobody holds.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import shutil
import stat
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

_Path = str | os.PathLike[str]

_ASIDE = r"\.[0-9a-f]{32}\.part"
_LONGEST = 100  # bytes; file systems allow 143 or 255, and 38 are added
_TOGETHER = "results"  # files that replace others together lie in results.<32 digits>.part/


@contextlib.contextmanager
def replacing(path: _Path) -> Iterator[BinaryIO]:
    """Opens a file that takes the place of another one when the block ends without an error.

    The permissions and the owner of an existing file are kept. A link stays, and the file that it
    leads to is replaced.

    Example:
        with replacing("metrics.json") as file:
            file.write(b"{}")

    Args:
        path: The file; its folder must exist.

    Yields:
        The new file, for bytes.

    Raises:
        OSError: The file cannot be written, see `check_output`; it is as it was.
    """
    target = _target(path)
    _remove_abandoned(target.parent, target.name)
    with _naming(path, target.parent):
        aside, file = _open_aside(target)
    try:
        with _naming(path), file:
            _copy_permissions(target, file.fileno())
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(aside, target)
            _sync_folder(target.parent)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def replacing_together(folder: _Path, names: Sequence[str]) -> Iterator[Path]:
    """Makes a folder aside, whose files move into another folder when the block ends.

    If the block raises, the other folder stays as it was. Otherwise it has the new files, and of
    `names` nothing else: an older file that the block did not write again is removed.

    Args:
        folder: The folder of the results; made if it is not there.
        names: The files that belong together. The last one moves last.

    Yields:
        The folder to write into.

    Raises:
        OSError: The folder or one of the files cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(folder, _TOGETHER)
    with _naming(folder, folder):
        aside, descriptor = _make_folder_aside(folder)
    try:
        with _naming_instead(aside, folder):
            yield aside
        targets = {name: _target(folder / name) for name in names}
        for name, target in targets.items():
            if (aside / name).exists():
                _copy_permissions(target, aside / name)
            else:
                (folder / name).unlink(missing_ok=True)
        for name, target in targets.items():
            if (aside / name).exists():
                _move(aside / name, target)
        _sync_folder(folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        os.close(descriptor)


def check_output(path: _Path) -> None:
    """Checks that a file can be written, without changing it.

    Args:
        path: The file.

    Raises:
        OSError: The folder is missing or cannot be written; the file is a folder, no regular file,
            or read-only.
    """
    target = _target(path)
    with _naming(target.parent, target.parent):
        aside, file = _open_aside(target)
    file.close()
    aside.unlink(missing_ok=True)


def check_output_folder(folder: _Path, names: Sequence[str]) -> None:
    """Checks that a folder is there or can be made, and that files in it can be written.

    Args:
        folder: The folder.
        names: The files.

    Raises:
        OSError: The folder cannot be made or written, or one of the files is a folder, no regular
            file, or read-only.
    """
    folder = Path(folder)
    nearest = next(each for each in (folder, *folder.parents) if _exists(each))
    if not nearest.is_dir():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(nearest))
    if nearest == folder:
        for name in names:
            _target(folder / name)
    with _naming(nearest, nearest):
        aside, descriptor = _make_folder_aside(nearest)
    os.close(descriptor)
    aside.rmdir()


def _exists(path: Path) -> bool:
    """Whether there is such an entry; raises an OSError if there cannot be, as for a long name."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _target(path: _Path) -> Path:
    """The file that a path leads to; raises an OSError if it may not be replaced."""
    target = Path(os.path.realpath(path))
    try:
        found = os.lstat(target)
    except FileNotFoundError:
        folder = target.parent if os.path.islink(path) else Path(path).parent
        if not folder.is_dir():
            raise FileNotFoundError(errno.ENOENT, "no such folder", str(folder)) from None
        return target
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))
    # A move needs only the folder's permissions. A read-only file is refused all the same.
    if not found.st_mode & 0o222 or not os.access(target, os.W_OK, effective_ids=True):
        raise PermissionError(errno.EACCES, "the file is read-only", os.fspath(path))
    return target


def _open_aside(target: Path) -> tuple[Path, BinaryIO]:
    """Makes a file beside the target, and holds it."""
    while True:
        aside = _name_aside(target.parent, target.name)
        file = aside.open("xb")
        try:
            if _hold(file.fileno(), aside):
                return aside, file
        except BaseException:
            file.close()
            aside.unlink(missing_ok=True)
            raise
        file.close()


def _make_folder_aside(folder: Path) -> tuple[Path, int]:
    """Makes a folder inside another one, and locks it by an open descriptor."""
    while True:
        aside = _name_aside(folder, _TOGETHER)
        aside.mkdir(mode=0o700)
        descriptor = None
        try:
            descriptor = os.open(aside, os.O_RDONLY)
            if _hold(descriptor, aside):
                return aside, descriptor
        except FileNotFoundError:  # taken for abandoned before it was locked
            pass
        except BaseException:
            if descriptor is not None:
                os.close(descriptor)
            aside.rmdir()
            raise
        if descriptor is not None:
            os.close(descriptor)


def _name_aside(folder: Path, name: str) -> Path:
    return folder / f"{_short(name)}.{uuid.uuid4().hex}.part"


def _short(name: str) -> str:
    """A name that leaves room for more: the name itself, or for a long one a hash of it."""
    encoded = os.fsencode(name)
    return name if len(encoded) <= _LONGEST else hashlib.sha256(encoded).hexdigest()


def _hold(descriptor: int, aside: Path) -> bool:
    """Locks a new file; False if another writer has removed it in between."""
    with contextlib.suppress(OSError):  # a file system without locks: nothing is ever removed there
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(aside))
    except FileNotFoundError:
        return False


def _remove_abandoned(folder: Path, name: str) -> None:
    """Removes what killed writers of a file have left beside it."""
    pattern = re.compile(re.escape(_short(name)) + _ASIDE)
    with contextlib.suppress(OSError):  # a folder that may be written, but not listed
        for entry in list(os.scandir(folder)):
            if pattern.fullmatch(entry.name):
                _remove_if_free(Path(entry.path))


def _remove_if_free(aside: Path) -> None:
    with contextlib.suppress(OSError):
        descriptor = os.open(aside, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if stat.S_ISDIR(os.fstat(descriptor).st_mode):
                shutil.rmtree(aside)
            else:
                aside.unlink()
        finally:
            os.close(descriptor)


def _copy_permissions(target: Path, new: int | Path) -> None:
    """Gives a new file the owner and the mode of the one that it replaces, if there is one."""
    with contextlib.suppress(FileNotFoundError):
        old = os.stat(target)
        with contextlib.suppress(PermissionError):  # only root can give files away
            os.chown(new, old.st_uid, old.st_gid)
        os.chmod(new, stat.S_IMODE(old.st_mode))


def _move(source: Path, target: Path) -> None:
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        with replacing(target) as file, source.open("rb") as content:  # a link to another disk
            shutil.copyfileobj(content, file)


def _sync_folder(folder: Path) -> None:
    """Makes a renaming survive a loss of power, where the file system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def _naming_instead(aside: Path, folder: Path) -> Iterator[None]:
    """Puts the files of a folder into errors that name those aside."""
    try:
        yield
    except OSError as error:
        if isinstance(error.filename, str) and Path(error.filename).is_relative_to(aside):
            error.filename = str(folder / Path(error.filename).relative_to(aside))
        raise


@contextlib.contextmanager
def _naming(path: _Path, inside: Path | None = None) -> Iterator[None]:
    """Puts a path into errors that name no file, or name one inside a folder that is ours."""
    try:
        yield
    except OSError as error:
        named = error.filename
        ours = named is not None and inside is not None and Path(named).parent == inside
        if error.errno is not None and (named is None or ours):
            error.filename = os.fspath(path)
        raise
