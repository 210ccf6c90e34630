"""The sign of voxels, and distances that are computed where they can change."""

import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.grid import distance
from hiosdf_jax._src.state.pytrees import Side

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
    "near, few of many rays pass": (-0.5, 5, 1, 20, -1),
    "less far, some of many rays pass": (-1.25, 50, 1, 15, 1),
    "less far, few of many rays pass": (-1.25, 50, 1, 20, -1),
    "far, few of many rays pass": (-1.6, 50, 1, 20, 1),
    "far, fewer of many rays pass": (-1.6, 50, 1, 60, -1),
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
    sign, side = distance._side(
        *counts, here, offset, *map(tuple, axes[1:]), sure, jnp.zeros(1, bool), marked
    )
    value = float(sign[0]) or 1.0  # no side at all counts as free
    assert value == expected
    by_plane = hits >= distance._SURE_HITS and abs(height) < 1 and "all rays" not in name
    by_plane |= name == "in front, near, all rays end before it"
    assert int(side[0]) == (Side.PLANE if by_plane else int(sign[0]))


@pytest.mark.parametrize(("height", "sign"), [(-0.9, -1), (-1.1, 0), (-2.9, 0), (1.1, 0), (0.9, 1)])
def test_the_plane_of_a_new_surface_decides_less_of_unmet_space(height, sign):
    """That of an old one decides up to three voxels, and not only up to one."""
    shape = (3, 3, 12)
    here = tuple(jnp.asarray([k]) for k in (1, 1, 8))
    middle, short = ([0, 0.4, 0], [0, 0, 0.05])
    middle, short = (tuple(jnp.asarray(axis)[:, None]) for axis in (middle, short))
    offset = tuple(jnp.asarray([value]) for value in (0.0, 0.0, height))
    none, yes = jnp.zeros(shape), jnp.asarray([True])
    for new, expected in ((yes, sign), (~yes, np.sign(height))):
        found, side = distance._side(none, none, here, offset, middle, short, yes, new, yes)
        assert float(found[0]) == expected
        if abs(height) > 1:
            assert int(side[0]) == expected
    # Rays that ended before the voxel decide as ever.
    behind = none.at[1, 1, 8].set(2)
    found, _ = distance._side(none, behind, here, offset, middle, short, yes, yes, yes)
    assert float(found[0]) == (-1 if abs(height) > 1 else np.sign(height))


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
            passes, jnp.zeros(shape), here, offset, middle, short, sure, ~sure, sure
        )
        assert float(sign[0]) == expected
        assert int(side[0]) == (Side.SHEET if free else Side.PLANE)


def test_distances_and_sides_that_are_computed_together_keep_all_bits():
    bits = np.arange(2**16, dtype=np.uint16)
    bits = np.append(bits, bits)
    side = np.arange(bits.size).astype(np.int8)[::-1]
    sdf, found = distance._compute_together(jnp.asarray(bits.view(np.float16)), jnp.asarray(side))
    np.testing.assert_array_equal(np.asarray(sdf).view(np.uint16), bits)
    np.testing.assert_array_equal(found, side)
