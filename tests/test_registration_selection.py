"""Which returns are selected."""

import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.mapping.registration.selection import (
    are_returns,
    draw_evenly,
    draw_informative,
    pad_to_few_sizes,
    square_ranges_on_host,
    take_evenly_on_device,
    take_evenly_on_host,
)


def test_rows_are_drawn_evenly_and_without_those_that_are_no_returns():
    cloud = np.arange(300, dtype=np.float32).reshape(100, 3)
    cloud[::2] = np.nan
    points, some = draw_evenly(cloud, 10)
    assert some.all()
    np.testing.assert_array_equal(points, cloud[1::2][::5])


def test_a_small_cloud_is_drawn_whole():
    cloud = np.arange(30, dtype=np.float32).reshape(10, 3)
    cloud[3] = np.inf
    points, some = draw_evenly(cloud, 64)
    assert points.shape == (10, 3)
    np.testing.assert_array_equal(points[some], np.delete(cloud, 3, axis=0))
    assert not points[~some].any()


def test_rows_without_returns_change_nothing():
    cloud = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    padded = np.full((900, 3), np.nan, np.float32)
    padded[np.sort(np.random.default_rng(1).permutation(900)[:500])] = cloud
    np.testing.assert_array_equal(draw_evenly(cloud, 100)[0], draw_evenly(padded, 100)[0])


def test_an_empty_cloud_gives_no_rows():
    points, some = draw_evenly(np.full((20, 3), np.nan, np.float32), 8)
    assert not some.any()
    assert np.isfinite(points).all()


def test_the_rows_that_tell_of_a_rare_direction_are_drawn():
    rng = np.random.default_rng(0)
    jacobian = np.zeros((2000, 6), np.float32)
    jacobian[:, 0] = 1
    jacobian[:, 2:] = rng.normal(size=(2000, 4))
    rare = rng.permutation(2000)[:20]
    jacobian[rare, 1] = 1
    weight = np.ones(2000, np.float32)
    weight[::3] = 0
    information = (jacobian * weight[:, None]).T @ jacobian
    row = np.asarray(draw_informative(jacobian, weight, information, 200))
    assert (weight[row] > 0).all()
    assert (np.diff(row) >= 0).all()
    # A sixth of the leverage lies in them, and a hundredth of the rows.
    share = np.isin(row, rare).mean()
    leverage = weight * np.einsum("ni,ij,nj->n", jacobian, np.linalg.inv(information), jacobian)
    expected = 0.2 * (weight[rare] > 0).sum() / (weight > 0).sum()
    expected += 0.8 * leverage[rare].sum() / leverage.sum()
    assert abs(share - expected) < 0.02
    assert share > 0.1


@pytest.mark.parametrize("count", [1, 50, 300, 1000])
@pytest.mark.parametrize("finite", [0.0, 0.4, 1.0])
def test_the_host_draws_the_rows_that_the_device_draws(count, finite):
    rng = np.random.default_rng(count)
    cloud = rng.normal(size=(300, 3)).astype(np.float32)
    some = rng.uniform(size=300) < finite
    cloud[~some] = np.nan
    expected, is_row = draw_evenly(cloud, count)
    found = take_evenly_on_host(cloud, some, count)
    drawn = np.asarray(expected)[np.asarray(is_row)]
    np.testing.assert_array_equal(found[: len(drawn)], drawn)
    assert np.isnan(found[len(drawn) :]).all()


@pytest.mark.parametrize("finite", [0.0, 0.1, 0.7, 1.0])
def test_a_padded_cloud_gives_the_same_candidates_on_a_device(finite):
    rng = np.random.default_rng(2)
    cloud = rng.normal(size=(777, 3)).astype(np.float32)
    cloud[rng.uniform(size=777) >= finite] = np.nan
    cloud[::50] = 0.01  # too near
    some = are_returns(square_ranges_on_host(cloud), 0.1)
    expected = take_evenly_on_host(cloud, some, 128)
    np.testing.assert_array_equal(
        take_evenly_on_device(pad_to_few_sizes(cloud), 0.1, 128), expected
    )


@pytest.mark.parametrize("rows, padded", [(1, 1), (7, 7), (777, 832), (76_800, 81_920)])
def test_padded_clouds_have_few_sizes(rows, padded):
    cloud = np.ones((rows, 3), np.float32)
    found = pad_to_few_sizes(cloud)
    assert len(found) == padded
    assert (found[:rows] == 1).all()
    assert np.isnan(found[rows:]).all()
    assert len({len(pad_to_few_sizes(np.ones((n, 3), np.float32))) for n in range(513, 1025)}) == 8


@pytest.mark.parametrize("least_range_m", [0.0, 0.1])
def test_returns_are_finite_and_in_range(least_range_m):
    inf, nan = np.inf, np.nan
    rows = [
        ((0, 0, 0), least_range_m == 0),
        ((0, 0.0999, 0), least_range_m == 0),
        ((0, 0, -0.1001), True),
        ((-9e4, 0, 0), True),
        ((0, 2e5, 0), False),
        ((1e20, 0, 0), False),
        ((0, nan, 1), False),
        ((nan, inf, 1), False),
        ((1, 1, -inf), False),
    ]
    cloud = np.array([row for row, _ in rows], np.float32)
    expected = [is_return for _, is_return in rows]
    square = square_ranges_on_host(cloud)
    np.testing.assert_array_equal(are_returns(square, least_range_m), expected)
    on_device = are_returns(jnp.sum(jnp.asarray(cloud) ** 2, axis=-1), least_range_m)
    np.testing.assert_array_equal(on_device, expected)
