"""Text files of numbers, numbered files, and errors of third-party parsers."""

from __future__ import annotations

import io
import itertools
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

_Path = str | os.PathLike[str]

_ALWAYS_RETURNS = 1 << 21  # the images of most cameras have fewer pixels

_LONGEST_LINE = 10_000
_MOST_CHARACTERS = 300  # of a parser's message


def read_rows(path: _Path, columns: int) -> tuple[np.ndarray, list[int]]:
    """Reads a text file of numbers separated by spaces, without blank lines and # comments.

    Args:
        path: The file.
        columns: Numbers per line.

    Returns:
        (N, columns) float64 and the N line numbers, from 1.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A line holds anything else; the message names file and line.
    """
    rows, lines = [], []
    for line, words in read_words(path, columns):
        try:
            rows.append([float(word) for word in words])
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
        lines.append(line)
    return np.array(rows, float).reshape(-1, columns), lines


def read_words(path: _Path, columns: int) -> Iterator[tuple[int, list[str]]]:
    """Reads a text file of words line by line, without blank lines and # comments.

    Args:
        path: The file.
        columns: Words per line.

    Yields:
        The line number, from 1, and the words.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A line has more words or fewer; the message names file and line.
    """
    for line, text in read_lines(path):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != columns:
            raise ValueError(f"{path}, line {line}: {len(words)} columns, expected {columns}")
        yield line, words


def read_lines(path: _Path) -> Iterator[tuple[int, str]]:
    """Reads a text file line by line.

    Args:
        path: The file.

    Yields:
        The line number, from 1, and the line.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a regular file, or a line is too long; the message names the file.
    """
    # Bytes that are not UTF-8 are not a number either, and are reported as such.
    with io.TextIOWrapper(open_regular(path), encoding="utf-8", errors="replace") as file:
        for line in itertools.count(1):
            text = file.readline(_LONGEST_LINE)
            if not text:
                return
            if len(text) == _LONGEST_LINE:
                raise ValueError(f"{path}, line {line}: longer than {_LONGEST_LINE} characters")
            yield line, text


def numbered_files(folder: Path, pattern: str) -> list[tuple[int, Path]]:
    """Finds the files of a folder whose names contain a number.

    Args:
        folder: The folder.
        pattern: Regular expression of the whole name; its group is the number.

    Returns:
        The numbers and the paths, ascending by number.

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: No name matches.
    """
    matches = [(re.fullmatch(pattern, path.name), path) for path in folder.iterdir()]
    found = sorted((int(match[1]), path) for match, path in matches if match)
    if not found:
        raise ValueError(f"{folder}: no file name matches {pattern}")
    return found


def open_regular(path: _Path) -> io.BufferedReader:
    """Opens a file for reading, and nothing else: opening a pipe or a device could wait forever.

    Args:
        path: The file.

    Returns:
        The open file.

    Raises:
        FileNotFoundError: There is no such file.
        IsADirectoryError: It is a folder.
        PermissionError: It may not be read.
        ValueError: It is a pipe, a device or a socket, or the path is none.
    """
    try:
        mode = os.stat(os.fspath(path)).st_mode
    except (TypeError, ValueError) as error:  # such as a null character in the name
        raise ValueError(f"path is {path!r}, expected the name of a file: {error}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise ValueError(f"{path}: is a pipe or a device, expected a file")
    return open(path, "rb")


def most_returns(file_bytes: int) -> int:
    """Limits a cloud of a compressed file, which could inflate to a thousand times its size.

    Args:
        file_bytes: Size of the file.

    Returns:
        The largest number of returns: 2 million, or one for each byte of the file.
    """
    return max(_ALWAYS_RETURNS, file_bytes)


@contextmanager
def parsing(path: _Path, kind: str) -> Iterator[None]:
    """Turns any error of a parser into a ValueError that names the file.

    Args:
        path: The file.
        kind: What the file should be, such as "PLY file".

    Raises:
        OSError: The file itself cannot be opened.
        ValueError: The parser failed.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise ValueError(_unreadable(path, kind, error)) from error
    except Exception as error:  # parsers raise anything on unexpected bytes
        raise ValueError(_unreadable(path, kind, error)) from error


def _unreadable(path: _Path, kind: str, error: Exception) -> str:
    """One line, also where a parser shows half of the file."""
    reason = " ".join(str(error).split()) or type(error).__name__
    if len(reason) > _MOST_CHARACTERS:
        reason = f"{reason[:_MOST_CHARACTERS]} ..."
    return f"{path}: not a readable {kind} ({reason})"
