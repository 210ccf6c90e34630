"""The choice of returns on thin parts."""

import numpy as np

from hiosdf_jax._src.datasets.truth import choose_thin


def test_thin_parts_with_ten_returns_are_chosen():
    part = np.repeat([7, -1, 3, 5, 7], [30, 400, 9, 10, 40])
    chosen = choose_thin(part, np.random.default_rng(0))
    assert len(set(chosen)) == len(chosen)
    assert {*part[chosen]} == {5, 7}
    assert np.bincount(part[chosen])[[5, 7]].tolist() == [10, 50]
    assert len(choose_thin(np.full(50, -1), np.random.default_rng(0))) == 0
