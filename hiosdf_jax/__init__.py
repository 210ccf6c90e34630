"""Online signed distance fields for robots that plan in JAX (HIO-SDF, arXiv 2310.09463)."""

from hiosdf_jax.checkpoint import load, save
from hiosdf_jax.config import Config
from hiosdf_jax.mapping import grow, init, snapshot, update
from hiosdf_jax.mesh import extract_mesh
from hiosdf_jax.query import query, sdf, sdf_and_grad
from hiosdf_jax.state import Field, Flag, MapState, Query, Report

__all__ = [
    "Config",
    "Field",
    "Flag",
    "MapState",
    "Query",
    "Report",
    "extract_mesh",
    "grow",
    "init",
    "load",
    "query",
    "save",
    "sdf",
    "sdf_and_grad",
    "snapshot",
    "update",
]
