"""Tables in Markdown, and their places in a document.

A document marks the place of a table with the lines `<!-- table: NAME -->` and `<!-- /table -->`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

Tables = Mapping[str, Callable[[], str]]

MARKED = re.compile(r"^(<!-- table: (\S+) -->\n).*?^(<!-- /table -->)", re.DOTALL | re.MULTILINE)


def lay_out(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lays out a table.

    Args:
        head: The columns' headings.
        rows: Their cells.

    Returns:
        The table, a line per row.
    """
    ruled = [head, ["---"] * len(head), *rows]
    lines = ("|".join(["", *(f" {cell} " if cell else " " for cell in row), ""]) for row in ruled)
    return "".join(f"{line}\n" for line in lines)


def render(text: str, tables: Tables) -> str:
    """Renders the tables of a document anew.

    Args:
        text: The document.
        tables: What renders each table, by name.

    Returns:
        The document with each marked table as its record has it.

    Raises:
        KeyError: A marker names no table.
    """
    return MARKED.sub(lambda found: found[1] + tables[found[2]]() + found[3], text)
