"""Vectors as three arrays against numpy."""

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics import vectors
from hiosdf_jax._src.numerics.vectors import join, split


def test_vectors_of_three_arrays():
    rng = np.random.default_rng(0)
    table, rows = rng.normal(size=(40, 9)).astype(np.float16), rng.integers(40, size=(5, 2))
    taken = vectors.take(jnp.asarray(table), jnp.asarray(rows, jnp.int32), 3)
    np.testing.assert_array_equal(join(taken), table[rows, 3:6].astype(np.float32))
    jumps = vectors.take(jnp.asarray([[-128, 0, 127]], jnp.int8), jnp.zeros(2, jnp.int32))
    np.testing.assert_array_equal(join(jumps), [[-128, 0, 127]] * 2)
    a, b = (rng.normal(size=(6, 3)).astype(np.float32) for _ in range(2))
    np.testing.assert_allclose(vectors.dot(split(a), split(b)), np.sum(a * b, axis=1), rtol=1e-5)
    a[0] = 0
    sizes, pull = jax.vjp(lambda v: vectors.length(split(v)), jnp.asarray(a))
    exact = np.linalg.norm(a, axis=1)
    np.testing.assert_allclose(sizes, exact, rtol=1e-6)
    np.testing.assert_allclose(
        pull(jnp.ones(6))[0], a / np.where(exact > 0, exact, 1)[:, None], rtol=1e-5
    )
