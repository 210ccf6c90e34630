"""Online signed distance fields for robots that plan in JAX (HIO-SDF, arXiv 2310.09463)."""

from hiosdf_jax.config import Config
from hiosdf_jax.mapping import init, snapshot, update
from hiosdf_jax.query import query, sdf, sdf_and_grad
from hiosdf_jax.state import Field, Flag, MapState, Query, Report

__all__ = [
    "Config",
    "Field",
    "Flag",
    "MapState",
    "Query",
    "Report",
    "init",
    "query",
    "sdf",
    "sdf_and_grad",
    "snapshot",
    "update",
]
