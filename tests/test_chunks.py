"""Evaluation in chunks against one evaluation of all rows."""

import numpy as np
import pytest

from hiosdf_jax._src.numerics.chunks import fill_in_chunks


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 24])
@pytest.mark.parametrize("pad", [True, False])
def test_chunks_fill_all_rows_in_order(count, pad):
    points = np.random.default_rng(0).normal(size=(count, 3))
    lengths, signs, calls = np.empty(count), np.empty((count, 3), bool), []

    def evaluate(rows):
        calls.append(rows)
        return np.linalg.norm(points[rows], axis=1), points[rows] > 0

    fill_in_chunks(evaluate, {"lengths": lengths, "signs": signs}, 8, pad=pad)
    np.testing.assert_array_equal(lengths, np.linalg.norm(points, axis=1))
    np.testing.assert_array_equal(signs, points > 0)
    assert [len(rows) for rows in calls[:-1]] == [8] * (len(calls) - 1)
    if count:
        assert len(calls[-1]) == (8 if pad else (count - 1) % 8 + 1)
        assert set(np.concatenate(calls)) == set(range(count))


def test_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"sdf has shape \(8, 1\) for 8 points, expected \(8,\)"):
        fill_in_chunks(lambda rows: (np.zeros((8, 1)),), {"sdf": np.empty(3)}, 8)
