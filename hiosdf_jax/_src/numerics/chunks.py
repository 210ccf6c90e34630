"""Evaluation in chunks: memory does not grow with the number of points, and a map compiles once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def fill_in_chunks(
    function: Callable[[np.ndarray], tuple[Any, ...]],
    arrays: Mapping[str, np.ndarray],
    size: int,
    *,
    pad: bool = True,
) -> None:
    """Fills arrays row by row from a function that is called with chunks of row numbers.

    Example:
        distances = np.empty(len(points))
        fill_in_chunks(lambda rows: (sdf(points[rows]),), {"sdf": distances}, 8192)

    Args:
        function: Maps (n,) row numbers to one array (n, ...) for each of `arrays`, in their order.
        arrays: The arrays to fill, (N, ...) each, by the names that messages use.
        size: Rows per chunk.
        pad: Repeat the last row number until the last chunk is full, so that every call has the
            same n. The values of repeated rows are dropped.

    Raises:
        ValueError: The function returned an array of the wrong shape.
    """
    count = len(next(iter(arrays.values())))
    for start in range(0, count, size):
        stop = min(start + size, count)
        rows = np.minimum(np.arange(start, start + size if pad else stop), count - 1)
        for (name, array), values in zip(arrays.items(), function(rows), strict=True):
            expected = (len(rows), *array.shape[1:])
            if np.shape(values) != expected:
                raise ValueError(
                    f"{name} has shape {np.shape(values)} for {len(rows)} points, "
                    f"expected {expected}"
                )
            array[start:stop] = np.asarray(values)[: stop - start]
