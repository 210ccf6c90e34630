"""True elements by their number, against numpy."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiosdf_jax._src.numerics import masks


@settings(deadline=None)
@given(
    size=st.sampled_from([1, 31, 32, 33, 200]),
    share=st.sampled_from([0.0, 0.02, 0.5, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_true_elements_are_those_of_numpy(size: int, share: float, seed: int) -> None:
    mask = np.random.default_rng(seed).random(size) < share
    expected = np.flatnonzero(mask)
    ranked = masks.rank_mask(mask)
    assert int(ranked.total) == len(expected)
    some = np.arange(min(len(expected), 5), dtype=np.int32)
    if some.size:
        found = masks.indices_of_true(ranked, some)
        np.testing.assert_array_equal(found, expected[some])
    count = 40  # more than some of the masks have
    padded = np.append(expected, np.full(count, size))[:count]
    np.testing.assert_array_equal(masks.first_true_indices(mask, count), padded)


@pytest.mark.parametrize("shape", [(3, 5, 70), (1,), (4, 8)])
def test_first_true_ravels_and_batches(shape: tuple[int, ...]) -> None:
    mask = np.random.default_rng(0).random((4, *shape)) < 0.3
    count = mask[0].size
    found = jax.jit(jax.vmap(lambda one: masks.first_true_indices(one, count)))(mask)
    for row, one in zip(found, mask, strict=True):
        expected = np.flatnonzero(one)
        np.testing.assert_array_equal(row[: len(expected)], expected)
        assert (np.asarray(row[len(expected) :]) == count).all()
