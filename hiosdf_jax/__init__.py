"""Online signed distance fields for robots that plan in JAX (HIO-SDF, arXiv 2310.09463)."""

from hiosdf_jax import planning
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field.baking import bake
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.field.points import query, sdf, sdf_and_grad
from hiosdf_jax._src.mapping.background import BackgroundMapper
from hiosdf_jax._src.mapping.checkpoint import load, save
from hiosdf_jax._src.mapping.forgetting import forget
from hiosdf_jax._src.mapping.moving import moving_rows
from hiosdf_jax._src.mapping.pipeline import grow, init, snapshot, update
from hiosdf_jax._src.registration.refining import Registration, refine_pose
from hiosdf_jax._src.state import Baked, Field, Flag, MapState, Query, Report

__all__ = [
    "BackgroundMapper",
    "Baked",
    "Config",
    "Field",
    "Flag",
    "MapState",
    "Query",
    "Registration",
    "Report",
    "bake",
    "extract_mesh",
    "forget",
    "grow",
    "init",
    "load",
    "moving_rows",
    "planning",
    "query",
    "refine_pose",
    "save",
    "sdf",
    "sdf_and_grad",
    "snapshot",
    "update",
]
