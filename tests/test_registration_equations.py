"""The weights of returns, in a complete map and in one that grows."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import room_cloud

from hiosdf_jax._src.mapping.registration.equations import compare, make_rows
from hiosdf_jax._src.state import field_of

COUNT = 1000


@partial(jax.jit, static_argnames="scale_m")
def compared(field, cloud, pose, growing, scale_m=0.0):
    some = jnp.ones(len(cloud), bool)
    noise = jnp.float32(0.01), jnp.float32(0)
    return compare(field, make_rows(cloud, some, noise, growing), pose, scale_m)


def returns():
    """A cloud, and a pose that is 3 cm off along each axis."""
    cloud, pose = room_cloud(70, COUNT)
    pose = np.array(pose)
    pose[:3, 3] += 0.03
    return cloud, pose


@pytest.mark.parametrize(("growing", "deviations"), [(0.0, 3.0), (0.5, 2.25), (1.0, 1.5)])
def test_weights_are_those_of_geman_and_mcclure(sharp_map, growing, deviations):
    found = compared(field_of(sharp_map), *returns(), growing)
    distance, sigma = (np.asarray(part, float) for part in (found.distance, found.sigma))
    expected = 1 / (sigma * (1 + (distance / (deviations * sigma)) ** 2)) ** 2
    some = np.asarray(found.comparable)
    assert some.mean() > 0.3
    np.testing.assert_allclose(found.weight[some], expected[some], rtol=1e-4)
    np.testing.assert_array_equal(found.weight[~some], 0)


def test_fewer_returns_are_compared_in_a_map_that_grows(sharp_map):
    complete, grows = (compared(field_of(sharp_map), *returns(), each) for each in (0.0, 1.0))
    fewer = np.asarray(complete.comparable) & ~np.asarray(grows.comparable)
    assert not np.any(np.asarray(grows.comparable) & ~np.asarray(complete.comparable))
    assert np.asarray(grows.comparable).mean() > 0.3
    assert fewer.any()


def test_a_return_as_far_as_the_scale_keeps_the_same_weight(sharp_map):
    """Coarse steps tolerate what the scale says, however complete the map is."""
    complete, grows = (
        compared(field_of(sharp_map), *returns(), each, scale_m=0.5) for each in (0.0, 1.0)
    )
    both = np.asarray(complete.comparable & grows.comparable)
    ratio = [np.asarray(each.weight * each.sigma**2)[both] for each in (complete, grows)]
    np.testing.assert_allclose(ratio[0], ratio[1], rtol=0.01)
