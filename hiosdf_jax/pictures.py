"""Pictures of maps, drawn without a display."""

from hiosdf_jax._src.view.shading import save_shaded
from hiosdf_jax._src.view.slices import save_slices

__all__ = ["save_shaded", "save_slices"]
