"""The notebooks run, and each stored notebook is what its text source gives.

python tests/test_notebooks.py [NAME ...]    # executes notebooks/*.py and stores the notebooks
"""

import importlib.util
import os
import re
import sys
from pathlib import Path

import jupytext
import nbclient
import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
NAMES = ["quickstart", "inside_the_method", "planning", "own_data", "poses", "thousand_maps"]

# What a test replaces in a notebook to run all of its cells in less time. The stored notebooks have
# all frames and maps.
SHORTER = {
    "quickstart": {"frames=24": "frames=12"},
    "poses": {"range(0, 96, 4)": "range(0, 96, 8)", "range(77, 179, 9)": "range(77, 179, 17)"},
    "thousand_maps": {"= 1024, 4": "= 64, 4"},
}


def source(name):
    return NOTEBOOKS / f"{name}.py"


def stored_file(name):
    return NOTEBOOKS / f"{name}.ipynb"


def needed(name):
    """The optional packages of a notebook, which it names as the pages do."""
    return re.findall(r"<!-- needs: (\w+) -->", source(name).read_text("utf-8"))


def execute(name, replaced=()):
    text = source(name).read_text("utf-8")
    for old, new in dict(replaced).items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    notebook = jupytext.reads(text, fmt="py:percent")
    client = nbclient.NotebookClient(
        notebook,
        timeout=180,
        kernel_name="python3",
        resources={"metadata": {"path": NOTEBOOKS}},
        record_timing=False,
    )
    # Notebooks also share small programs, if there is a cache.
    client.execute(env={**os.environ, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"})
    return notebook


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def pictures(notebook):
    return [o["data"]["image/png"] for o in outputs(notebook) if "image/png" in o.get("data", {})]


def printed(notebook):
    return "".join(output.get("text", "") for output in outputs(notebook))


def without_numbers(text):
    """The words of a text: processors differ in the last digits, and numpy then in its columns."""
    return re.sub(r"-?\d[\d.,e+-]*", "", text).split()


@pytest.fixture(scope="module")
def executed():
    """Gives the executed notebook of a name; executes each once."""
    done = {}

    def get(name):
        for package in needed(name):
            if importlib.util.find_spec(package) is None:
                pytest.skip(f"needs the package {package}")
        if name not in done:
            done[name] = execute(name, SHORTER.get(name, {}))
        return done[name]

    return get


@pytest.mark.parametrize(
    ("name", "count", "error", "most_cm"),
    [
        ("quickstart", 2, "mean error on this slice: ", 10),
        ("own_data", 3, "median distance of held-out returns: ", 3),
        ("inside_the_method", 4, "both blended: ", 2),
        ("planning", 4, "later map: ", 25),
        ("poses", 2, "error of the merged map: ", 5),
        ("thousand_maps", 2, "median error after 4 scans: ", 8),
    ],
)
def test_a_notebook_runs(executed, name, count, error, most_cm):
    notebook = executed(name)
    assert len(pictures(notebook)) == count
    for each in (notebook, jupytext.read(stored_file(name))):
        assert float(printed(each).split(error)[1].split(" cm")[0]) < most_cm
    assert not any(output.get("name") == "stderr" for output in outputs(notebook))


def test_every_notebook_is_tested():
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.py")) == sorted(NAMES)
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_its_text_source(name):
    text, stored = jupytext.read(source(name)), jupytext.read(stored_file(name))
    assert [(cell.cell_type, cell.source) for cell in stored.cells] == [
        (cell.cell_type, cell.source) for cell in text.cells
    ]


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_stored_with_its_outputs(executed, name):
    stored = jupytext.read(stored_file(name))
    assert len(pictures(stored)) == len(pictures(executed(name)))
    assert without_numbers(printed(stored)) == without_numbers(printed(executed(name)))


@pytest.mark.parametrize("name", NAMES)
def test_stored_outputs_are_small_and_name_no_machine(name):
    stored = jupytext.read(stored_file(name))
    assert stored_file(name).stat().st_size < 600_000
    assert all(output.output_type in ("stream", "display_data") for output in outputs(stored))
    assert not any(output.get("name") == "stderr" for output in outputs(stored))
    assert not re.search(r"/(home|root|tmp|usr|Users)\b", printed(stored))
    assert not any("execution" in cell.metadata for cell in stored.cells)


if __name__ == "__main__":
    for name in sys.argv[1:] or NAMES:
        notebook = execute(name)
        notebook.metadata.pop("language_info", None)  # the version of this machine's Python
        jupytext.write(notebook, stored_file(name))
