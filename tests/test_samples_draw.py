"""Uniform draws from a mask."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hiosdf_jax._src.samples.draw import draw_from_mask


@given(
    mask=st.lists(st.booleans(), min_size=1, max_size=200),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=30, deadline=None)
def test_draws_are_true_elements_of_the_mask(mask, seed):
    every = np.flatnonzero(mask)
    index, possible = draw_from_mask(jnp.asarray(mask), 50, jax.random.key(seed))
    assert bool(possible) == (len(every) > 0)
    if len(every):
        bits = np.asarray(jax.random.bits(jax.random.key(seed), (50,), jnp.uint32))
        np.testing.assert_array_equal(index, every[bits % len(every)])


def test_draws_are_uniform_and_ignore_padding():
    mask = np.zeros(40, bool)
    mask[[3, 7, 8, 20, 39]] = True
    index, possible = draw_from_mask(jnp.asarray(mask), 20_000, jax.random.key(1))
    values, counts = np.unique(index, return_counts=True)
    assert values.tolist() == [3, 7, 8, 20, 39]
    assert np.sum((counts - 4000) ** 2 / 4000) < 18.5  # chi-square, 4 degrees, p = 0.001
    assert bool(possible)
    compact, _ = draw_from_mask(jnp.ones(5, bool), 20_000, jax.random.key(1))
    np.testing.assert_array_equal(np.flatnonzero(mask)[np.asarray(compact)], index)
    assert not bool(draw_from_mask(jnp.zeros(5, bool), 3, jax.random.key(1))[1])
