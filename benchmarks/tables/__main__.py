"""The command that rewrites or checks the tables of all documents."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks import records
from benchmarks.tables import accuracy, planning, provenance, registration, robustness, speed
from benchmarks.tables.markdown import Tables, render

TABLES: Tables = {
    **accuracy.TABLES,
    **speed.TABLES,
    **planning.TABLES,
    **registration.TABLES,
    **robustness.TABLES,
    **provenance.TABLES,
}

_FOLDERS = (".", "docs", "benchmarks", "benchmarks/results")


def documents() -> list[Path]:
    """Returns the documents that may have tables."""
    return [path for folder in _FOLDERS for path in sorted((records.ROOT / folder).glob("*.md"))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrites or checks the tables.

    Args:
        arguments: Those after the command's name; those of the process if left out.

    Returns:
        The exit code, 1 if `--check` found a table that differs from its record.
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tables",
        description="Renders the tables of the documents from the committed records.",
    )
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    options = parser.parse_args(arguments)
    outdated = False
    for path in documents():
        text = path.read_text("utf-8")
        rendered = render(text, TABLES)
        if rendered == text:
            continue
        outdated = True
        if not options.check:
            path.write_text(rendered, "utf-8")
        print(f"{path}: {'differs from the records' if options.check else 'rewritten'}")
    return 1 if options.check and outdated else 0


if __name__ == "__main__":
    sys.exit(main())
