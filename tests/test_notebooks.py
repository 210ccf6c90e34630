"""The quickstart runs from its text source, and the notebook file is made from it."""

from pathlib import Path

import jupytext
import nbclient

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"


def test_the_quickstart_runs():
    notebook = jupytext.read(NOTEBOOKS / "quickstart.py")
    client = nbclient.NotebookClient(
        notebook, timeout=180, kernel_name="python3", resources={"metadata": {"path": NOTEBOOKS}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    printed = "".join(output.get("text", "") for output in outputs)
    error_cm = float(printed.split("mean error on this slice: ")[1].split(" cm")[0])
    assert error_cm < 10


def test_the_notebook_is_its_text_source():
    text = jupytext.read(NOTEBOOKS / "quickstart.py")
    paired = jupytext.read(NOTEBOOKS / "quickstart.ipynb")
    assert [(cell.cell_type, cell.source) for cell in paired.cells] == [
        (cell.cell_type, cell.source) for cell in text.cells
    ]
    assert not any(cell.get("outputs") for cell in paired.cells)
