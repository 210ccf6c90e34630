"""Online signed distance fields for robots that plan in JAX (HIO-SDF, arXiv 2310.09463).

The main calls:

    config = hio.Config.light(bounds)            # settings for a CPU; hio.Config(bounds) for a GPU
    state = hio.init(config, jax.random.key(0))  # an empty map
    state = hio.update(state, cloud, pose)       # the map with one more point cloud
    field = hio.snapshot(state)                  # what a planner keeps
    distances = hio.sdf(field, points)           # m, at points of any shape (..., 3)
    distances, gradients = hio.sdf_and_grad(field, points)
    hio.Flag(state.report.update_flags)          # what was wrong with the last cloud

`planning` has clearances for controllers, `datasets` the readers of recordings, and `demo` a
simulated apartment. `help(hio.update)` has the rest of a call.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from hiosdf_jax import planning
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field.baking import bake
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.field.queries import query, sdf, sdf_and_grad
from hiosdf_jax._src.mapping.background.mapper import BackgroundMapper
from hiosdf_jax._src.mapping.checkpoint import load, save
from hiosdf_jax._src.mapping.forgetting import forget
from hiosdf_jax._src.mapping.joining.merging import correct, merge, transform
from hiosdf_jax._src.mapping.lifecycle import grow, init, snapshot
from hiosdf_jax._src.mapping.moving_returns import moving_rows
from hiosdf_jax._src.mapping.pipeline import pad_cloud, update
from hiosdf_jax._src.mapping.registration.refining import Registration, refine_pose
from hiosdf_jax._src.mapping.registration.relocalizing import Relocalization, relocalize
from hiosdf_jax._src.mapping.registration.smoothing import smooth_poses
from hiosdf_jax._src.mapping.tracking import predict_pose, track
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import Baked, Field, MapState, Query, Report
from hiosdf_jax._src.view.live import Viewer, view

if TYPE_CHECKING:
    from hiosdf_jax import datasets as datasets
    from hiosdf_jax import demo as demo
    from hiosdf_jax import exports as exports
    from hiosdf_jax import pictures as pictures
    from hiosdf_jax import scoring as scoring

__version__ = "0.1.0"

__all__ = [
    "BackgroundMapper",
    "Baked",
    "Config",
    "Field",
    "Flag",
    "MapState",
    "Query",
    "Registration",
    "Relocalization",
    "Report",
    "Viewer",
    "bake",
    "correct",
    "extract_mesh",
    "forget",
    "grow",
    "init",
    "load",
    "merge",
    "moving_rows",
    "pad_cloud",
    "planning",
    "predict_pose",
    "query",
    "refine_pose",
    "relocalize",
    "save",
    "sdf",
    "sdf_and_grad",
    "smooth_poses",
    "snapshot",
    "track",
    "transform",
    "update",
    "view",
]

_MODULES = ("datasets", "demo", "exports", "pictures", "scoring")


def __getattr__(name: str) -> ModuleType:
    """Imports the other public modules on first use."""
    if name in _MODULES:
        return importlib.import_module(f"hiosdf_jax.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Lists the public names alone: those modules too, and nothing that this file imports."""
    special = (name for name in globals() if name.startswith("__"))
    return sorted({*__all__, *_MODULES, *special})
