"""The distance transform against scipy, a k-d tree and float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from hiosdf_jax._src.grid import distance
from hiosdf_jax._src.state import Side


def nearest_sites(sites, offset, horizon, part=None):
    """Compiled for each call, so that it uses what a test has patched."""
    search = functools.partial(distance.nearest_sites, horizon=horizon, part=part)
    return jax.jit(search)(jnp.asarray(sites), jnp.asarray(offset, jnp.float32))


def test_nearest_sites_at_the_centers_of_voxels_are_exact():
    rng = np.random.default_rng(9)
    for share in (0.001, 0.02, 0.3):
        sites = rng.random((23, 17, 11)) < share
        sites[3, 4, 5] = True
        exact, index = distance_transform_edt(~sites, return_indices=True)
        nearest, squared = nearest_sites(sites, np.zeros((23, 17, 11, 3)), 40)
        np.testing.assert_allclose(np.sqrt(squared), exact, atol=1e-5)
        chosen = np.stack(np.unravel_index(np.asarray(nearest), sites.shape))
        here = np.indices(sites.shape)
        np.testing.assert_allclose(np.linalg.norm(chosen - here, axis=0), exact, atol=1e-5)
        assert sites[tuple(chosen)].all()
        assert index.shape == chosen.shape


def test_no_site_beyond_the_horizon_is_found():
    sites = np.zeros((30, 5, 4), bool)
    sites[2, 2, 2] = True
    exact = distance_transform_edt(~sites)
    nearest, _ = nearest_sites(sites, np.zeros((30, 5, 4, 3)), 9)
    np.testing.assert_array_equal(np.asarray(nearest) >= 0, exact <= 9)
    none, _ = nearest_sites(np.zeros((4, 5, 6), bool), np.zeros((4, 5, 6, 3)), 9)
    assert (np.asarray(none) == -1).all()


def numpy_transforms(sites, offset, horizon, part, order=(2, 1, 0)):
    """The axis transforms in float64: each voxel takes the least of all along the axis."""
    nearest = np.arange(sites.size).reshape(sites.shape)
    squared = np.where(sites, np.sum(offset.astype(np.float64) ** 2, axis=-1), 1e12)
    for axis in order:
        along = offset[..., axis].astype(np.float64).ravel()[nearest]
        across, rows = squared - along**2, np.arange(sites.shape[axis])
        least, chosen = [], []
        for row in range(part.start[axis], part.start[axis] + part.shape[axis]):
            shift = (rows - row).reshape([-1 if k == axis else 1 for k in range(3)])
            candidates = np.where(np.abs(shift) <= horizon + 1, across + (shift + along) ** 2, 1e12)
            best = np.expand_dims(np.argmin(candidates, axis), axis)
            least.append(np.take_along_axis(candidates, best, axis))
            chosen.append(np.take_along_axis(nearest, best, axis))
        squared, nearest = np.concatenate(least, axis), np.concatenate(chosen, axis)
    return np.where(squared <= horizon**2, nearest, -1), squared


@pytest.mark.parametrize("chunk", [1, 8, 100])
@pytest.mark.parametrize(("share", "horizon"), [(0.0005, 9), (0.0005, 16), (0.002, 25), (0.02, 40)])
def test_axis_transforms_against_numpy(monkeypatch, share, horizon, chunk):
    monkeypatch.setattr(distance, "_CHUNK", chunk)
    rng = np.random.default_rng(11)
    sites = rng.random((40, 21, 13)) < share
    offset = rng.uniform(-0.5, 0.5, (*sites.shape, 3)).astype(np.float32)
    part = distance.Part((3, 2, 0), (30, 11, 13))
    expected, exact = numpy_transforms(sites, offset, horizon, part)
    nearest, squared = nearest_sites(sites, offset, horizon, part)
    np.testing.assert_array_equal(nearest, expected)
    found = expected >= 0
    assert found.sum() > 0
    np.testing.assert_allclose(np.asarray(squared)[found], exact[found], rtol=1e-5, atol=1e-5)


def test_nearest_sites_off_the_centers_of_voxels_against_a_tree():
    """There an axis transform can prefer a site whose other coordinates are worse: bounded."""
    rng = np.random.default_rng(10)
    sites = rng.random((24, 20, 16)) < 0.02
    offset = rng.uniform(-0.5, 0.5, (*sites.shape, 3)).astype(np.float32)
    _, squared = nearest_sites(sites, offset, 40)
    cells = np.argwhere(sites)
    tree = cKDTree(cells + offset[sites])
    exact, _ = tree.query(np.indices(sites.shape).reshape(3, -1).T)
    excess = np.sqrt(np.asarray(squared)).ravel() - exact
    assert excess.min() > -1e-4
    assert np.mean(excess > 1e-4) < 0.02
    assert excess.mean() < 0.005
    assert excess.max() < 1


# The center of the one voxel lies half a voxel in front of a plane, or behind it.
SIGNS = {
    "in front, no ray": (0.5, 50, 0, 0, 1),
    "behind, no ray": (-0.5, 50, 0, 0, -1),
    "behind, some rays": (-0.5, 50, 5, 0, -1),
    "in front, some rays end before it": (0.5, 50, 1, 5, 1),
    "in front, all rays end before it": (0.5, 50, 0, 5, -1),
    "in front, near, all rays end before it": (0.1, 50, 0, 5, 1),
    "behind, few hits, rays pass": (-0.5, 5, 5, 0, 1),
    "in front, few hits, rays end before it": (0.5, 5, 0, 1, -1),
    "few hits, no ray": (-0.5, 5, 0, 0, -1),
    "far behind": (-4.0, 50, 0, 9, -1),
    "farther behind than rays mark voxels": (-7.0, 50, 0, 9, 1),
}


@pytest.mark.parametrize("name", SIGNS)
def test_the_plane_decides_near_a_sure_patch_and_the_rays_elsewhere(name):
    height, hits, passes, behind, expected = SIGNS[name]
    shape = (3, 3, 12)
    here = tuple(jnp.asarray([k]) for k in (1, 1, 8))
    axes = [jnp.asarray(axis)[:, None] for axis in ([0.4, 0, 0], [0, 0.4, 0], [0, 0, 0.05])]
    counts = [jnp.zeros(shape).at[1, 1, 8].set(count) for count in (passes, behind)]
    offset = tuple(jnp.asarray([value]) for value in (0.0, 0.0, height))
    sure = jnp.asarray([hits >= distance._SURE_HITS])
    marked = jnp.asarray([abs(height) < distance._HIDDEN_REACH_VOXELS])
    sign, side = distance._side(*counts, here, offset, *map(tuple, axes[1:]), sure, marked)
    value = float(sign[0]) or 1.0  # no side at all counts as free
    assert value == expected
    by_plane = hits >= distance._SURE_HITS and abs(height) < 1 and "all rays" not in name
    by_plane |= name == "in front, near, all rays end before it"
    assert int(side[0]) == (Side.PLANE if by_plane else int(sign[0]))


def test_a_sheet_has_free_space_on_both_sides():
    shape = (3, 3, 12)
    here = tuple(jnp.asarray([k]) for k in (1, 1, 4))
    middle, short = ([0, 0.4, 0], [0, 0, 0.05])
    middle, short = (tuple(jnp.asarray(axis)[:, None]) for axis in (middle, short))
    offset = tuple(jnp.asarray([value]) for value in (0.0, 0.0, -0.5))
    for free, expected in ((0, -1), (5, 1)):
        passes = jnp.zeros(shape).at[1, 1, 2].set(free)
        sure = jnp.asarray([True])
        sign, side = distance._side(
            passes, jnp.zeros(shape), here, offset, middle, short, sure, sure
        )
        assert float(sign[0]) == expected
        assert int(side[0]) == (Side.SHEET if free else Side.PLANE)
