"""Text files of numbers, numbered files, and errors of foreign parsers."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

_Path = str | os.PathLike[str]


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
    # Bytes that are not UTF-8 are no number either, and are reported as such.
    with open(path, encoding="utf-8", errors="replace") as file:
        for line, text in enumerate(file, 1):
            words = text.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) != columns:
                raise ValueError(f"{path}, line {line}: {len(words)} columns, expected {columns}")
            yield line, words


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
        raise ValueError(f"{path}: not a readable {kind} ({error})") from error
    except Exception as error:  # parsers raise anything on unexpected bytes
        raise ValueError(f"{path}: not a readable {kind} ({error})") from error
