"""A robot imports the core alone: no simulator, mesh library or plotting."""

import subprocess
import sys

OPTIONAL = ["mujoco", "mujoco.mjx", "trimesh", "skimage", "matplotlib", "scipy.spatial", "tqdm"]


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
for name in ("matplotlib", "trimesh", "skimage", "tqdm"):
    sys.modules[name] = None  # importing it raises ImportError
import hiosdf_jax.datasets, hiosdf_jax.planning, hiosdf_jax.scoring, hiosdf_jax.view
"""
    subprocess.run([sys.executable, "-c", code], check=True)
