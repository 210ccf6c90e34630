"""The zero level set of a map as a triangle mesh."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import jax
import numpy as np

from hiosdf_jax._src.field.lattice import check_resolution, sample_counts
from hiosdf_jax._src.field.points import query
from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.state import Field, MapState

if TYPE_CHECKING:
    import trimesh

# One batch shape for every query: one compilation, and memory does not grow with the map.
_CHUNK = 65536
_NOT_ZERO = 1e-6  # m


def extract_mesh(field: MapState | Field, resolution: float = 0.05) -> trimesh.Trimesh:
    """Extracts the zero level set of a map in observed space.

    Args:
        field: A map or a snapshot of one.
        resolution: Spacing of the samples, m.

    Returns:
        The mesh, m, world frame, with normals that point to free space; without faces if the map
        shows no surface.

    Raises:
        ValueError: The resolution is not positive.

    Example:
        >>> hio.extract_mesh(field, resolution=0.05).export("mesh.ply")
    """
    check_resolution(resolution)
    low, high = np.asarray(field.config.bounds)
    shape = sample_counts(high - low, resolution)
    count = math.prod(shape)
    sdf, observed = np.empty(count, np.float32), np.empty(count, bool)

    def sample(index: np.ndarray) -> tuple[jax.Array, jax.Array]:
        points_world = low + resolution * np.stack(np.unravel_index(index, shape), axis=-1)
        return _sample(field, points_world.astype(np.float32))

    fill_in_chunks(sample, {"sdf": sdf, "observed": observed}, _CHUNK)
    # Passes stop before the end of a ray, so up to about a voxel of unknown space lies between
    # observed free space and the surface.
    reach = max(1, math.ceil(field.config.voxel_size / resolution - 1e-6))
    return mesh_from_samples(sdf.reshape(shape), observed.reshape(shape), low, resolution, reach)


def mesh_from_samples(
    sdf: np.ndarray,
    observed: np.ndarray,
    corner_world: np.ndarray,
    resolution: float,
    reach: int = 1,
) -> trimesh.Trimesh:
    """Extracts the zero level set of a sampled distance field.

    Args:
        sdf: (X, Y, Z) m, positive in free space; NaN counts as not observed.
        observed: (X, Y, Z) bool.
        corner_world: Position of sample (0, 0, 0), (3,) m.
        resolution: Spacing of the samples, m.
        reach: The surface is extracted up to this many samples from observed free space.

    Returns:
        The mesh, m, world frame, with normals that point to free space; without faces if no surface
        was observed.

    Raises:
        ValueError: The resolution or the reach is not positive, or an array has a wrong shape.
    """
    import scipy.ndimage
    import skimage.measure
    import trimesh

    check_resolution(resolution)
    if reach < 1:
        raise ValueError(f"reach is {reach}, expected at least 1 sample")
    sdf, observed = np.asarray(sdf, np.float32), np.asarray(observed, bool)
    corner_world = np.asarray(corner_world, float)
    if sdf.ndim != 3:
        raise ValueError(f"sdf has shape {sdf.shape}, expected (X, Y, Z)")
    if observed.shape != sdf.shape:
        raise ValueError(f"observed has shape {observed.shape}, expected that of sdf, {sdf.shape}")
    if corner_world.shape != (3,):
        raise ValueError(f"corner_world has shape {corner_world.shape}, expected (3,)")

    known = np.isfinite(sdf)
    # A sample of exactly 0 would make triangles without area.
    values = np.where(known, np.where(sdf == 0, _NOT_ZERO, sdf), 1)
    # A surface is seen from free space. Starting from all observed space would also extract the
    # step from "behind a wall" to the map's guess beyond it: a second wall that nobody saw.
    near = scipy.ndimage.maximum_filter(observed & known & (values > 0), size=2 * reach + 1)
    # skimage uses the cell between samples i and i + 1 where mask[i + 1]; here all eight must hold.
    mask = np.zeros(sdf.shape, bool)
    mask[1:, 1:, 1:] = True
    near &= known
    for i, j, k in itertools.product((slice(None, -1), slice(1, None)), repeat=3):
        mask[1:, 1:, 1:] &= near[i, j, k]
    if not mask.any() or values.min() > 0 or values.max() < 0:
        return trimesh.Trimesh()
    try:
        vertices, faces, _, _ = skimage.measure.marching_cubes(
            values, 0.0, mask=mask, gradient_direction="descent"
        )
    except RuntimeError:  # values on both sides of 0, but not within one cell
        return trimesh.Trimesh()
    return trimesh.Trimesh(vertices * resolution + corner_world, faces, process=False)


@jax.jit
def _sample(field: MapState | Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    answer = query(field, points_world)
    return answer.sdf, answer.observed  # XLA drops the unused gradient
