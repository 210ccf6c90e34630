"""Rows of numbers, numbered files, and what foreign parsers say of broken files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

_Path = str | os.PathLike[str]


def read_rows(path: _Path, columns: int) -> tuple[np.ndarray, list[int]]:
    """Reads a text file of numbers between spaces; blank lines and those with # are left out.

    Args:
        path: The file.
        columns: How many numbers each line has.

    Returns:
        (N, columns) float64 and the N line numbers, from 1.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A line holds something else; the message names file and line.
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
    """Goes through a text file of words; blank lines and those with # are left out.

    Args:
        path: The file.
        columns: How many words each line has.

    Yields:
        The line number, from 1, and the words.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A line has more words or fewer; the message names file and line.
    """
    # What is not UTF-8 is not a number either, and is reported as such.
    with open(path, encoding="utf-8", errors="replace") as file:
        for line, text in enumerate(file, 1):
            words = text.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) != columns:
                raise ValueError(f"{path}, line {line}: {len(words)} columns, expected {columns}")
            yield line, words


def numbered_files(folder: Path, pattern: str) -> list[tuple[int, Path]]:
    """Finds the files of a folder whose names hold a number.

    Args:
        folder: Where they lie.
        pattern: Regular expression of the whole name; its group is the number.

    Returns:
        The numbers and the paths, ascending by number.

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: No name fits.
    """
    matches = [(re.fullmatch(pattern, path.name), path) for path in folder.iterdir()]
    found = sorted((int(match[1]), path) for match, path in matches if match)
    if not found:
        raise ValueError(f"{folder}: no file is named like {pattern}")
    return found


@contextmanager
def parsing(path: _Path, kind: str) -> Iterator[None]:
    """Makes a ValueError that names the file of whatever a parser says of a broken one.

    Args:
        path: The file.
        kind: What it should be, "PLY file".

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
    except Exception as error:  # parsers fail in every way on bytes that they did not expect
        raise ValueError(f"{path}: not a readable {kind} ({error})") from error
