"""The evidence of two grids added up, against the moments in float64; what stays solid."""

import jax
import numpy as np
import pytest
from voxels import CONFIG, SHAPE, empty_window, fuse, trace, uniform

from hiosdf_jax._src.grid import patches
from hiosdf_jax._src.mapping.joining import adding

sum_evidence = jax.jit(adding.sum_evidence, static_argnums=0)
is_feature = jax.jit(patches.is_feature, static_argnums=0)
SENSOR = np.array([0.31, 0.52, 0.63])


def wide(window, **changed):
    """The window, all but its start and change in float32; some parts may be others."""
    parts = {name: np.asarray(part) for name, part in window._asdict().items()} | changed
    kept = "start", "change"
    return type(window)(
        **{k: part if k in kept else np.asarray(part, np.float32) for k, part in parts.items()}
    )


def view(seeds, low=(0.0, 0.1, 0.3), high=(0.5, 0.8, 0.8)):
    """Evidence of clouds of random points; few enough that nothing fades."""
    window = empty_window()
    for seed in seeds:
        points = uniform(seed, 900, low, high)
        window = trace(fuse(window, points, SENSOR), points, SENSOR)
    return wide(window)


def is_surface(window):
    return np.asarray(is_feature(CONFIG, window.hits, window.passes, window.weight, window.axes))


def spread_of(window):
    return np.einsum("...ki,...kj->...ij", *[np.asarray(window.axes, float)] * 2)


def test_two_views_add_up_to_one_of_all_rays():
    wall = (0.52, 0.1, 0.3), (0.56, 0.8, 0.8)
    total = sum_evidence(CONFIG, [view([0], *wall), view([1], *wall)])
    both = view([0, 1], *wall)
    low = both.hits + both.passes < CONFIG.evidence_limit  # nothing has faded there
    assert low.mean() > 0.9
    for name in ("hits", "behind", "weight"):
        new, expected = (np.asarray(getattr(window, name))[low] for window in (total, both))
        np.testing.assert_allclose(new, expected, rtol=1e-4, atol=1e-6)
    carved = (np.asarray(total.passes) != both.passes) & low  # surfaces of one of them, see below
    assert carved.sum() < 0.02 * low.sum()
    patch = low & (np.asarray(both.hits) > 0)
    np.testing.assert_allclose(np.asarray(total.mean)[patch], both.mean[patch], atol=2e-3)
    np.testing.assert_allclose(spread_of(total)[patch], spread_of(both)[patch], atol=2e-3)
    normal, expected = (np.asarray(window.axes)[patch][:, 2] for window in (total, both))
    assert np.all(np.sum(normal * expected, axis=1) > 0)


def test_nothing_adds_nothing():
    window, nothing = view([2]), wide(empty_window())
    alone = sum_evidence(CONFIG, [window])
    for pair in ([window, nothing], [nothing, window]):
        total = sum_evidence(CONFIG, pair)
        for name in ("hits", "passes", "behind", "weight", "change", "mean", "axes"):
            np.testing.assert_array_equal(getattr(total, name), getattr(alone, name), err_msg=name)


def test_the_order_of_two_does_not_matter():
    a, b = view([3]), view([4], (0.2, 0.1, 0.3), (0.8, 0.8, 0.8))
    one, other = sum_evidence(CONFIG, [a, b]), sum_evidence(CONFIG, [b, a])
    for name in ("hits", "passes", "behind", "weight", "change", "mean"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-4)
    np.testing.assert_allclose(spread_of(one), spread_of(other), atol=1e-4)


def box_of(shape, low, high):
    mask = np.zeros(shape, bool)
    mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return mask


@pytest.mark.parametrize("hits", [2.0, 5.0, 40.0])
@pytest.mark.parametrize("free_first", [True, False])
def test_a_thing_that_one_map_has_met_stays_solid(hits, free_first):
    """However many rays of the other one have passed there, and in however many maps."""
    thing = box_of(SHAPE, (4, 4, 3), (7, 6, 5))
    free = wide(empty_window(), passes=np.full(SHAPE, 100))
    axes = np.where(thing[..., None, None], 0.3 * np.eye(3), 0)
    met = wide(empty_window(), hits=hits * thing, weight=hits * thing, axes=axes)
    assert is_surface(met).sum() == thing.sum()
    order = [free, free, met, free] if free_first else [met, free, free, free]
    total = sum_evidence(CONFIG, order)
    np.testing.assert_array_equal(is_surface(total), thing)
    np.testing.assert_array_equal(np.asarray(total.passes)[~thing], free.passes[~thing])


def test_a_sure_patch_stays_beside_a_surface_of_the_other_map_and_a_few_hits_do_not():
    wall, beside = box_of(SHAPE, (6, 0, 0), (7, 10, 8)), box_of(SHAPE, (5, 0, 0), (6, 10, 8))
    axes = np.broadcast_to(0.3 * np.eye(3), (*SHAPE, 3, 3))
    other = wide(empty_window(), hits=50 * wall, passes=80 * ~wall, axes=axes)

    def surface_beside(hits):
        window = wide(empty_window(), hits=hits * beside, axes=axes)
        total = is_surface(sum_evidence(CONFIG, [window, other]))
        assert total[wall].all()
        return total[beside]

    assert surface_beside(12.0).all()
    assert not surface_beside(4.0).any()


def test_what_one_map_takes_for_hidden_stays_hidden():
    free = wide(empty_window(), passes=np.full(SHAPE, 5))
    hidden = wide(free, passes=np.full(SHAPE, -2))
    for pair in ([free, hidden], [hidden, free]):
        np.testing.assert_array_equal(sum_evidence(CONFIG, pair).passes, -7.0)
