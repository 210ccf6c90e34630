"""Uniform draws from masks, and random numbers from words."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hiosdf_jax._src.samples.draw import (
    draw_from_mask,
    draw_from_masks,
    draw_words,
    normal,
    uniform,
)

WORDS = np.random.default_rng(0).integers(0, 2**32, 20_000, dtype=np.uint32)


@given(
    first=st.lists(st.booleans(), min_size=1, max_size=200),
    second=st.lists(st.booleans(), min_size=1, max_size=200),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=30, deadline=None)
def test_draws_are_true_elements_of_their_masks(first, second, seed):
    masks = [np.resize(first, 200), np.resize(second, 70)]  # two shapes for all examples
    words = draw_words(jax.random.key(seed), (50,), (20,))
    indices, possible = draw_from_masks([jnp.asarray(mask) for mask in masks], words)
    for mask, bits, index, any_true in zip(masks, words, indices, possible, strict=True):
        every = np.flatnonzero(mask)
        assert bool(any_true) == (len(every) > 0)
        assert index.shape == bits.shape
        if len(every):
            np.testing.assert_array_equal(index, every[np.asarray(bits) % len(every)])


def test_draws_are_uniform_and_ignore_padding():
    mask = np.zeros(40, bool)
    mask[[3, 7, 8, 20, 39]] = True
    index, possible = draw_from_mask(jnp.asarray(mask), WORDS)
    values, counts = np.unique(index, return_counts=True)
    assert values.tolist() == [3, 7, 8, 20, 39]
    assert np.sum((counts - 4000) ** 2 / 4000) < 18.5  # chi-square, 4 degrees, p = 0.001
    assert bool(possible)
    compact, _ = draw_from_mask(jnp.ones(5, bool), WORDS)
    np.testing.assert_array_equal(np.flatnonzero(mask)[np.asarray(compact)], index)
    assert not bool(draw_from_mask(jnp.zeros(5, bool), WORDS[:3])[1])


def test_words_are_those_of_one_call():
    shapes = (3,), (2, 3), (0,)
    words = draw_words(jax.random.key(7), *shapes)
    assert [part.shape for part in words] == list(shapes)
    whole = jax.random.bits(jax.random.key(7), (9,), jnp.uint32)
    np.testing.assert_array_equal(np.concatenate([np.ravel(part) for part in words]), whole)


def test_words_become_uniform_and_normal_numbers():
    assert stats.kstest(np.asarray(uniform(WORDS)), "uniform").pvalue > 0.01
    assert stats.kstest(np.asarray(normal(WORDS)), "norm").pvalue > 0.01
    ends = np.array([0, 2**32 - 1], np.uint32)
    np.testing.assert_array_equal(uniform(ends), np.float32([0, 1 - 2.0**-24]))
    low, high = np.asarray(normal(ends))
    # The distribution function there is 2^-25 and 1 - 2^-25.
    np.testing.assert_allclose([-low, high], stats.norm.isf(2.0**-25), rtol=1e-3)
