"""The quickstart runs, and the stored notebook is what its text source gives.

python tests/test_notebooks.py    # executes notebooks/quickstart.py and stores the notebook
"""

import re
from pathlib import Path

import jupytext
import nbclient
import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
SOURCE, STORED = NOTEBOOKS / "quickstart.py", NOTEBOOKS / "quickstart.ipynb"


def execute():
    notebook = jupytext.read(SOURCE)
    client = nbclient.NotebookClient(
        notebook,
        timeout=180,
        kernel_name="python3",
        resources={"metadata": {"path": NOTEBOOKS}},
        record_timing=False,
    )
    client.execute()
    return notebook


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def pictures(notebook):
    return [o["data"]["image/png"] for o in outputs(notebook) if "image/png" in o.get("data", {})]


def printed(notebook):
    return "".join(output.get("text", "") for output in outputs(notebook))


def without_numbers(text):
    """The words of a text: processors differ in the last digits, and numpy then in its columns."""
    return re.sub(r"-?\d[\d.e+-]*", "", text).split()


@pytest.fixture(scope="module")
def executed():
    return execute()


def test_the_quickstart_runs(executed):
    assert len(pictures(executed)) == 2
    error_cm = float(printed(executed).split("mean error on this slice: ")[1].split(" cm")[0])
    assert error_cm < 10
    assert not any(output.get("name") == "stderr" for output in outputs(executed))


def test_the_notebook_is_its_text_source():
    text, stored = jupytext.read(SOURCE), jupytext.read(STORED)
    assert [(cell.cell_type, cell.source) for cell in stored.cells] == [
        (cell.cell_type, cell.source) for cell in text.cells
    ]


def test_the_notebook_is_stored_with_its_outputs(executed):
    stored = jupytext.read(STORED)
    assert len(pictures(stored)) == len(pictures(executed))
    assert without_numbers(printed(stored)) == without_numbers(printed(executed))


def test_the_stored_outputs_are_small_and_name_no_machine():
    stored = jupytext.read(STORED)
    assert STORED.stat().st_size < 600_000
    assert all(output.output_type in ("stream", "display_data") for output in outputs(stored))
    assert not any(output.get("name") == "stderr" for output in outputs(stored))
    assert not re.search(r"/(home|root|tmp|usr|Users)\b", printed(stored))
    assert not any("execution" in cell.metadata for cell in stored.cells)


if __name__ == "__main__":
    notebook = execute()
    notebook.metadata.pop("language_info", None)  # the version of this machine's Python
    jupytext.write(notebook, STORED)
