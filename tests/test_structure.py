"""The layout of the package: names, imports that point one way, and few entries per folder."""

import ast
import functools
import graphlib
from collections import defaultdict
from pathlib import Path

import pytest

import hiosdf_jax as hio

PACKAGE = Path(hio.__file__).parent
PRIVATE = "hiosdf_jax._src"
GRID = f"{PRIVATE}.grid"

MOST_ENTRIES = 16
MOST_FLOORS = 5


def module_name(file):
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(file): file for file in sorted(PACKAGE.rglob("*.py"))}
TREES = {name: ast.parse(file.read_text()) for name, file in FILES.items()}


def imported_modules(tree):
    """Yields the package's modules that a module imports, inside functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in FILES)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "internal imports are absolute"
            for alias in node.names:
                module = f"{node.module}.{alias.name}"
                module = module if module in FILES else node.module
                if module in FILES:
                    yield module


IMPORTS = {name: set(imported_modules(tree)) - {name} for name, tree in TREES.items()}


def is_private(name):
    return name == PRIVATE or name.startswith(f"{PRIVATE}.")


def private_imports(node_of):
    """The graph of imports inside `_src`, whose nodes are groups of modules."""
    graph = defaultdict(set)
    for name in filter(is_private, FILES):
        targets = {node_of(target) for target in IMPORTS[name] if is_private(target)}
        graph[node_of(name)] |= targets - {node_of(name)}
    return graph


def module(name):
    return name


def folder(name):
    """The folder of a module; a module at the top of `_src` stands for itself."""
    is_package = FILES[name].name == "__init__.py"
    parent = name if is_package else name.rpartition(".")[0]
    return name if parent == PRIVATE else parent


def room(name):
    """The folder or module at the top of `_src`, with all that it holds."""
    return ".".join(name.split(".")[:3])


def test_the_package_is_found():
    assert {"hiosdf_jax", PRIVATE, f"{GRID}.rays", "hiosdf_jax.planning"} <= set(FILES)
    assert f"{GRID}.rays" in IMPORTS[f"{GRID}.windows"]


def test_no_public_name_is_that_of_its_module():
    """`import a.query as q` would give the function and not the module."""
    shared = [
        name
        for name, tree in TREES.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        and node.name == name.rpartition(".")[2]
    ]
    assert shared == []


def test_no_public_name_hides_a_module():
    for name in hio.__all__:
        if f"hiosdf_jax.{name}" in FILES:
            assert getattr(hio, name).__name__ == f"hiosdf_jax.{name}"


@pytest.mark.parametrize("node_of", [module, folder, room])
def test_imports_have_no_circle(node_of):
    try:
        graphlib.TopologicalSorter(private_imports(node_of)).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"circle of imports: {' <- '.join(error.args[1])}")


def test_private_modules_import_no_public_face():
    faces = {
        name: sorted(target for target in targets if not is_private(target))
        for name, targets in IMPORTS.items()
        if is_private(name)
    }
    assert {name: targets for name, targets in faces.items() if targets} == {}


def test_the_list_of_stacks_names_tests_that_exist():
    folder = Path(__file__).parent
    head = ast.get_docstring(ast.parse((folder / "test_stacks.py").read_text()))
    named = [line.strip() for line in head.splitlines() if line.startswith("    test_")]
    assert len(named) > 20
    for name in named:
        file, _, test = name.rpartition(".")
        assert f"def {test}(" in (folder / f"{file or 'test_stacks'}.py").read_text(), name


@pytest.mark.parametrize("where", [PACKAGE, PACKAGE / "_src"], ids=["hiosdf_jax", "_src"])
def test_few_entries_at_the_top(where):
    entries = {entry.name for entry in where.iterdir()} - {"__init__.py", "__pycache__"}
    assert len(entries) <= MOST_ENTRIES, sorted(entries)


def test_the_grid_has_few_floors():
    """A module stands one floor above the highest module of the grid that it imports."""

    @functools.cache
    def chain(name):
        below = [chain(target) for target in IMPORTS[name] if target.startswith(f"{GRID}.")]
        return [*max(below, key=len, default=[]), name]

    longest = max((chain(name) for name in FILES if name.startswith(f"{GRID}.")), key=len)
    assert len(longest) <= MOST_FLOORS, longest
