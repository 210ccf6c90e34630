"""Maps of scenes whose distances are known in closed form."""

import jax.numpy as jnp
import numpy as np

from hiosdf_jax.state import Baked


def baked(exact_sdf, low, high, resolution):
    """Samples a distance function, (..., 3) m -> (...) m, on a lattice; all of it observed."""
    axes = [
        a + resolution * np.arange(round((b - a) / resolution) + 1)
        for a, b in zip(low, high, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return Baked(
        corner_world=jnp.array(low, jnp.float32),
        resolution=jnp.array(resolution, jnp.float32),
        sdf=jnp.array(exact_sdf(points), jnp.float32),
        frontier=jnp.full(points.shape[:-1], 100, jnp.float32),
        lower=jnp.array(exact_sdf(points), jnp.float32),
        updates=jnp.array(1, jnp.int32),
        stamp=jnp.array(0, jnp.float32),
    )


def half_space(normal, offset, reach=8.0):
    """What lies beyond a plane is solid: sdf = normal . p + offset, which trilinear maps hold
    exactly, in eight samples."""
    return baked(
        lambda p: p @ np.asarray(normal, float) + offset, [-reach] * 3, [reach] * 3, 2 * reach
    )


def half_spaces(count, seed=0, reach=2.0):
    """Random ones: normals (count, 3), offsets (count,) and maps."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = rng.uniform(-reach, reach, count)
    fields = [half_space(n, o) for n, o in zip(normals, offsets, strict=True)]
    return normals, offsets, fields


def count_traces(function):
    """The function, and a list that grows whenever it is traced."""
    traces = []

    def counted(*args, **kwargs):
        traces.append(1)
        return function(*args, **kwargs)

    return counted, traces
