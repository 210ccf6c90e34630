"""A robot imports the core alone: no simulator, mesh library or plotting."""

import subprocess
import sys
from pathlib import Path

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
assert hio.planning.trajectory and hio.__version__
assert {"demo", "datasets", "scoring", "pictures"} <= set(dir(hio))
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_package_says_that_it_has_types():
    assert (Path(hio.__file__).parent / "py.typed").exists()
