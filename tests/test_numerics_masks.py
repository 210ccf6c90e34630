"""True elements by their number, against numpy."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiosdf_jax._src.numerics import masks

# Compiled as wholes: one operation after another compiles each for itself.
rank_mask, indices_of_true = jax.jit(masks.rank_mask), jax.jit(masks.indices_of_true)
first_true_indices = jax.jit(masks.first_true_indices, static_argnums=1)
spread_rows = jax.jit(masks.spread_rows, static_argnums=1)


@settings(deadline=None)
@given(
    size=st.sampled_from([1, 31, 32, 33, 200]),
    share=st.sampled_from([0.0, 0.02, 0.5, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_true_elements_are_those_of_numpy(size: int, share: float, seed: int) -> None:
    mask = np.random.default_rng(seed).random(size) < share
    expected = np.flatnonzero(mask)
    ranked = rank_mask(mask)
    assert int(ranked.total) == len(expected)
    some = np.arange(min(len(expected), 5), dtype=np.int32)
    if some.size:
        found = indices_of_true(ranked, np.resize(some, 5))
        np.testing.assert_array_equal(found, expected[np.resize(some, 5)])
    count = 40  # more than some of the masks have
    padded = np.append(expected, np.full(count, size))[:count]
    np.testing.assert_array_equal(first_true_indices(mask, count), padded)


@pytest.mark.parametrize("shape", [(3, 5, 70), (1,), (4, 8)])
def test_first_true_ravels_and_batches(shape: tuple[int, ...]) -> None:
    mask = np.random.default_rng(0).random((4, *shape)) < 0.3
    count = mask[0].size
    found = jax.jit(jax.vmap(lambda one: masks.first_true_indices(one, count)))(mask)
    for row, one in zip(found, mask, strict=True):
        expected = np.flatnonzero(one)
        np.testing.assert_array_equal(row[: len(expected)], expected)
        assert (np.asarray(row[len(expected) :]) == count).all()


@pytest.mark.parametrize("device", ["cpu", "gpu"])
@pytest.mark.parametrize("size", [1, 2, 31, 1000])
@pytest.mark.parametrize("dtype", [np.int32, np.float32])
def test_running_sums_and_bisection_are_those_of_numpy(monkeypatch, device, size, dtype) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    values = np.random.default_rng(size).integers(0, 3, size).astype(dtype)
    sums = masks.running_sum(values)
    assert sums.dtype == dtype
    np.testing.assert_array_equal(sums, np.cumsum(values))
    wanted = np.arange(-1, int(values.sum()) + 2).astype(dtype)
    np.testing.assert_array_equal(
        masks.count_below(sums, wanted), np.searchsorted(np.cumsum(values), wanted)
    )


@pytest.mark.parametrize("size", [1, 33, 300])
@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_rows_spread_over_a_mask_are_every_so_many_of_those_that_hold(size, share):
    mask = np.random.default_rng(size).random(size) < share
    held, count = np.flatnonzero(mask), 40
    rows = np.asarray(spread_rows(mask, count))
    assert ((rows >= 0) & (rows < size)).all()
    if held.size:
        number = np.arange(count, dtype=np.float32) * np.float32(held.size / count)
        np.testing.assert_array_equal(rows, held[number.astype(int)])
