"""Each voxel's nearest site against scipy, a k-d tree and float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from hiosdf_jax._src.grid import nearest
from hiosdf_jax._src.numerics import loops


def nearest_sites(sites, offset, horizon, part=None):
    """Compiled for each call, so that it uses what a test has patched."""
    search = functools.partial(nearest.nearest_sites, horizon=horizon, part=part)
    index, squared = jax.jit(search)(jnp.asarray(sites)[None], jnp.asarray(offset, jnp.float32))
    return np.asarray(index[0]), np.asarray(squared[0])


def test_nearest_sites_at_the_centers_of_voxels_are_exact():
    rng = np.random.default_rng(9)
    for share in (0.001, 0.02, 0.3):
        sites = rng.random((23, 17, 11)) < share
        sites[3, 4, 5] = True
        exact, index = distance_transform_edt(~sites, return_indices=True)
        found, squared = nearest_sites(sites, np.zeros((23, 17, 11, 3)), 40)
        np.testing.assert_allclose(np.sqrt(squared), exact, atol=1e-5)
        chosen = np.stack(np.unravel_index(found, sites.shape))
        here = np.indices(sites.shape)
        np.testing.assert_allclose(np.linalg.norm(chosen - here, axis=0), exact, atol=1e-5)
        assert sites[tuple(chosen)].all()
        assert index.shape == chosen.shape


def test_no_site_beyond_the_horizon_is_found():
    sites = np.zeros((30, 5, 4), bool)
    sites[2, 2, 2] = True
    exact = distance_transform_edt(~sites)
    found, _ = nearest_sites(sites, np.zeros((30, 5, 4, 3)), 9)
    np.testing.assert_array_equal(found >= 0, exact <= 9)
    none, _ = nearest_sites(np.zeros((4, 5, 6), bool), np.zeros((4, 5, 6, 3)), 9)
    assert (none == -1).all()


def numpy_transforms(sites, offset, horizon, part, order=(2, 1, 0)):
    """The axis transforms in float64: each voxel takes the least of all along the axis."""
    index = np.arange(sites.size).reshape(sites.shape)
    squared = np.where(sites, np.sum(offset.astype(np.float64) ** 2, axis=-1), 1e12)
    for axis in order:
        along = offset[..., axis].astype(np.float64).ravel()[index]
        across, rows = squared - along**2, np.arange(sites.shape[axis])
        least, chosen = [], []
        for row in range(part.start[axis], part.start[axis] + part.shape[axis]):
            shift = (rows - row).reshape([-1 if k == axis else 1 for k in range(3)])
            candidates = np.where(np.abs(shift) <= horizon + 1, across + (shift + along) ** 2, 1e12)
            best = np.expand_dims(np.argmin(candidates, axis), axis)
            least.append(np.take_along_axis(candidates, best, axis))
            chosen.append(np.take_along_axis(index, best, axis))
        squared, index = np.concatenate(least, axis), np.concatenate(chosen, axis)
    return np.where(squared <= horizon**2, index, -1), squared


@pytest.mark.parametrize(
    ("device", "number"), [("cpu", 50), ("cpu", 10**6), ("gpu", 8), ("gpu", 3)]
)
@pytest.mark.parametrize(("share", "horizon"), [(0.0005, 9), (0.0005, 16), (0.002, 25), (0.02, 40)])
def test_axis_transforms_against_numpy(monkeypatch, share, horizon, device, number):
    """On all cores or one, and with shifts of a loop's step that do or do not divide all."""
    where, name = (nearest, "_BLOCK") if device == "cpu" else (loops, "_MOST_PER_STEP")
    monkeypatch.setattr(where, name, number)
    monkeypatch.setattr(loops, "_LEAST_TO_SHARE", number)
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    rng = np.random.default_rng(11)
    sites = rng.random((40, 21, 13)) < share
    offset = rng.uniform(-0.5, 0.5, (*sites.shape, 3)).astype(np.float32)
    part = nearest.Part((3, 2, 0), (30, 11, 13))
    expected, exact = numpy_transforms(sites, offset, horizon, part)
    index, squared = nearest_sites(sites, offset, horizon, part)
    np.testing.assert_array_equal(index, expected)
    found = expected >= 0
    assert found.sum() > 0
    # The last bits hold the shifts: 6 or 7 of 24 in each of three transforms.
    assert np.all(squared[found] <= exact[found] + 1e-5)
    assert np.all(squared[found] >= (1 - 5e-5) * exact[found] - 1e-5)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(0, 1e4, width=32), st.integers(-9, 9)), min_size=1, max_size=20),
    st.integers(9, 127),
)
def test_one_minimum_finds_the_least_distance_and_its_shift(candidates, reach):
    squared, shift = (np.array(column) for column in zip(*candidates, strict=True))
    squared = squared.astype(np.float32)
    with jax.disable_jit():
        coded = [
            nearest._with_shift(jnp.float32(s), jnp.int32(k), reach)
            for s, k in zip(squared, shift, strict=True)
        ]
        best = min(coded, key=int)
        found, least = int(nearest._shift_of(best, reach)), float(nearest._least_of(best, reach))
    lost = 2.0 ** ((2 * reach).bit_length() - 23)
    assert (1 - lost) * squared.min() - 1e-37 <= least <= squared.min()
    chosen = squared[shift == found].min()
    assert chosen <= squared.min() / (1 - lost) + 1e-37
    equal = shift[squared == squared.min()]
    assert abs(found) <= np.abs(equal).min()


def test_nearest_sites_off_the_centers_of_voxels_against_a_tree():
    """There an axis transform can prefer a site whose other coordinates are worse: bounded."""
    rng = np.random.default_rng(10)
    sites = rng.random((24, 20, 16)) < 0.02
    offset = rng.uniform(-0.5, 0.5, (*sites.shape, 3)).astype(np.float32)
    _, squared = nearest_sites(sites, offset, 40)
    cells = np.argwhere(sites)
    tree = cKDTree(cells + offset[sites])
    exact, _ = tree.query(np.indices(sites.shape).reshape(3, -1).T)
    excess = np.sqrt(squared).ravel() - exact
    assert excess.min() > -1e-4
    assert np.mean(excess > 1e-4) < 0.02
    assert excess.mean() < 0.005
    assert excess.max() < 1


def test_sets_of_sites_do_not_see_each_other():
    rng = np.random.default_rng(12)
    sites = rng.random((3, 14, 9, 11)) < np.array([0, 0.01, 0.2])[:, None, None, None]
    offset = jnp.asarray(rng.uniform(-0.5, 0.5, (14, 9, 11, 3)), jnp.float32)
    part = nearest.Part((2, 0, 1), (9, 9, 8))
    search = jax.jit(functools.partial(nearest.nearest_sites, horizon=6, part=part))
    index, squared = search(jnp.asarray(sites), offset)
    for k in range(3):
        alone, far = nearest_sites(sites[k], offset, 6, part)
        np.testing.assert_array_equal(index[k], alone)
        np.testing.assert_array_equal(squared[k], far)
