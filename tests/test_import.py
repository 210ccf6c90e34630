"""A robot imports the core alone: no simulator, mesh library or plotting."""

import operator
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hiosdf_jax as hio

OPTIONAL = ["mujoco", "mujoco.mjx", "trimesh", "skimage", "matplotlib", "scipy", "tqdm", "viser"]


def test_the_core_imports_without_optional_packages():
    code = f"""
import sys
class Refuse:
    def find_spec(self, name, *_):
        if name in {OPTIONAL!r}:
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
import jax, hiosdf_jax as hio
state = hio.init(hio.Config.light(((0, 0, 0), (1, 1, 1))), jax.random.key(0))
print(float(hio.sdf(state, [0.5, 0.5, 0.5])))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    float(done.stdout)


def test_the_public_modules_import_without_drawing_libraries():
    code = """
import sys
for name in ("matplotlib", "trimesh", "skimage", "tqdm", "viser"):
    sys.modules[name] = None  # importing it raises ImportError
import hiosdf_jax.datasets, hiosdf_jax.planning, hiosdf_jax.scoring, hiosdf_jax.pictures
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_modules_are_attributes_and_the_version_is_known():
    code = """
import hiosdf_jax as hio, sys
assert "hiosdf_jax.demo" not in sys.modules
names = [hio.demo, hio.datasets, hio.scoring, hio.pictures]
assert hio.planning.mjx and hio.__version__
assert {"demo", "datasets", "scoring", "pictures"} <= set(dir(hio))
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("module", [hio, hio.planning], ids=["hiosdf_jax", "planning"])
def test_dir_lists_public_names_alone(module):
    listed = {name for name in dir(module) if not name.startswith("__")}
    others = {*hio._MODULES, *hio.planning._ADAPTERS}
    assert listed >= set(module.__all__)
    assert listed - set(module.__all__) <= others
    assert "__doc__" in dir(module)


def test_the_help_of_the_package_names_calls_that_exist():
    calls = re.findall(r"hio\.([\w.]+)\(", hio.__doc__)
    assert {"init", "update", "snapshot", "sdf", "Config.light"} <= set(calls)
    for call in calls:
        assert callable(operator.attrgetter(call)(hio)), call


def test_the_package_says_that_it_has_types():
    assert (Path(hio.__file__).parent / "py.typed").exists()
