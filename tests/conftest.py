"""What one test has compiled, the others need not: most of the time of these tests is XLA's."""

import os
import tempfile
from pathlib import Path

import jax

# The same folder for both workers, and for the commands that tests start.
_run = os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid()))
_cache = os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"hiosdf_jax_tests_{_run}")
)
jax.config.update("jax_compilation_cache_dir", _cache)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
