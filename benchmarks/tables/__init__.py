"""The tables of measured figures in the documents, rendered from the committed records.

python -m benchmarks.tables            # rewrites the tables
python -m benchmarks.tables --check    # exit code 1 if a table differs from its record

- `accuracy`, `robustness`, `speed`, `planning` and `registration` render the tables of their
  records, `provenance` that of where they come from;
- `markdown` lays them out, and replaces them in a document.
"""
