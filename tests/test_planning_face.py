"""The public face of planning: one default policy, lazy adapters, examples that run."""

import inspect
import re
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path
from types import ModuleType

import git_packages
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from analytic import half_space

import hiosdf_jax as hio
from hiosdf_jax import planning

ADAPTERS = {
    "cbf": "cbfpy",
    "frax": "frax",
    "hydrax": "hydrax",
    "jaxls": "jaxls",
    "mjx": "mujoco",
    "mppi": "jax_mppi",
    "pyroki": "pyroki",
}
REPOSITORIES = {"hydrax": "vincekurtz", "jaxls": "brentyi", "pyroki": "chungmin99"}
EXAMPLES = [
    "sphere_clearance",
    "clearance_and_jacobian",
    "robot_clearance",
    "robot_clearance_and_grad",
    "swept_clearance",
    "swept_clearance_and_grad",
    "spheres_from_model",
    "collision_cost",
    "optimize_trajectory",
    "mppi.controller",
    "cbf.velocity_filter",
    "frax.arm_clearance",
]


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch):
    git_packages.install(monkeypatch, *REPOSITORIES)


def adapter(name):
    """An adapter, or a skip where its library is missing."""
    pytest.importorskip(ADAPTERS[name], reason="needs the extra 'plan'")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return getattr(planning, name)


def defaults_of_unknown(module, names):
    """The default of `unknown` of each function that has it."""
    functions = {name: getattr(module, name) for name in names}
    signatures = {k: inspect.signature(f) for k, f in functions.items() if inspect.isfunction(f)}
    return {
        k: s.parameters["unknown"].default
        for k, s in signatures.items()
        if "unknown" in s.parameters
    }


def test_unseen_space_is_an_obstacle_by_default():
    defaults = defaults_of_unknown(planning, planning.__all__)
    assert len(defaults) == 8
    assert set(defaults.values()) == {"obstacle"}


@pytest.mark.parametrize(
    ("name", "functions"),
    (dict.fromkeys(ADAPTERS, 0) | {"cbf": 1, "frax": 2, "jaxls": 2}).items(),
)
def test_unseen_space_is_an_obstacle_by_default_in_adapters(name, functions):
    module = adapter(name)
    own = [key for key, value in vars(module).items() if inspect.getmodule(value) is module]
    public = [key for key in own if not key.startswith("_")]
    defaults = defaults_of_unknown(module, public)
    assert len(defaults) == functions
    assert set(defaults.values()) <= {"obstacle"}


def test_planning_imports_no_optional_library():
    code = """
import sys
class Refuse:
    def find_spec(self, name, *_):
        if name.split(".")[0] in (
            "mujoco", "trimesh", "cbfpy", "frax", "jax_mppi", "jaxls", "pyroki", "hydrax"
        ):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
from hiosdf_jax import planning
assert "scipy.spatial" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ADAPTERS)
def test_adapters_are_attributes_and_can_be_imported_by_name(name):
    module = adapter(name)
    scope = {}
    exec(f"from hiosdf_jax.planning import {name}", scope)
    assert scope[name] is module
    assert name in dir(planning)


@pytest.mark.parametrize("name", ["cbf", "mppi"])
def test_a_missing_library_is_named_with_how_to_install_it(name, monkeypatch):
    monkeypatch.setitem(sys.modules, ADAPTERS[name], None)
    monkeypatch.delitem(sys.modules, f"hiosdf_jax._src.planning.adapters.{name}", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install '\.\[plan\]'") as caught:
        getattr(planning, name)
    assert caught.value.name == ADAPTERS[name]
    assert name not in dir(planning)


def forget(name, monkeypatch):
    for module in [each for each in sys.modules if each.partition(".")[0] == name]:
        monkeypatch.delitem(sys.modules, module)


@pytest.mark.parametrize("name", REPOSITORIES)
def test_a_library_that_pypi_lacks_is_named_with_its_repository(name, monkeypatch):
    forget(name, monkeypatch)
    monkeypatch.setitem(sys.modules, name, None)
    url = f"https://github.com/{REPOSITORIES[name]}/{name}.git"
    with pytest.raises(ModuleNotFoundError, match=re.escape(f"pip install 'git+{url}'")):
        getattr(planning, name)
    assert name not in dir(planning)


@pytest.mark.parametrize("name", REPOSITORIES)
def test_another_package_of_the_same_name_is_seen(name, monkeypatch):
    forget(name, monkeypatch)
    monkeypatch.setitem(sys.modules, name, ModuleType(name))
    with pytest.raises(ModuleNotFoundError, match=rf"needs {name}, but .*'git\+https"):
        getattr(planning, name)


def test_other_names_are_unknown():
    with pytest.raises(AttributeError, match=r"'hiosdf_jax\.planning' has no attribute 'barrier'"):
        _ = planning.barrier


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_docstrings_run(name, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[1])
    scope = {"hio": hio, "jax": jax, "jnp": jnp, "mujoco": mujoco, "planning": planning}
    function = planning
    if "." in name:
        adapter(name.split(".")[0])
        library = ADAPTERS[name.split(".")[0]]
        scope[library] = sys.modules[library]
    for part in name.split("."):
        function = getattr(function, part)
    text = inspect.getdoc(function).split("Example:\n")[1].split("\nArgs:")[0]
    scope["field"] = half_space([0.0, 0.0, 1.0], 0.0)
    before = set(scope)
    exec(textwrap.dedent(text), scope)
    arrays = jax.tree.leaves([scope[key] for key in set(scope) - before])
    arrays = [np.asarray(leaf) for leaf in arrays if isinstance(leaf, jax.Array)]
    arrays = [array for array in arrays if np.issubdtype(array.dtype, np.floating)]
    assert arrays and all(np.isfinite(array).all() for array in arrays)
