"""Patches that lie on a sure patch of another map, against float64; what is never dropped."""

import itertools

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from voxels import CONFIG, SHAPE, empty_window

from hiosdf_jax._src.grid import evidence, patches
from hiosdf_jax._src.mapping.joining import adding, doubles

is_surface = jax.jit(doubles.is_surface, static_argnums=0)
is_feature = jax.jit(patches.is_feature, static_argnums=0)
drop = jax.jit(doubles.drop_doubles, static_argnums=0)
NAMES = ("hits", "passes", "behind", "weight", "change", "mean", "axes")


def window_of(cells, mean, axes, hits=5.0, weight=None, passes=1.0):
    """Evidence with some patches; all other voxels are free."""
    at = tuple(np.transpose(cells))
    numbers = {"hits": hits, "weight": hits if weight is None else weight, "passes": passes}
    numbers |= {"mean": mean, "axes": axes}
    window = empty_window()._replace(passes=np.full(SHAPE, 9, np.float32))
    for name, value in numbers.items():
        array = np.array(getattr(window, name), np.float32)
        array[at] = value
        window = window._replace(**{name: array})
    return window


def changed(array, at, value):
    result = np.array(array)
    result[at] = value
    return result


def random_window(seed, share):
    """Patches in a share of the voxels, of all sizes, places and directions, most of them sure."""
    rng = np.random.default_rng(seed)
    cells = np.argwhere(rng.random(SHAPE) < share)
    turns = Rotation.random(len(cells), random_state=seed).as_matrix()
    deviations = np.sort(rng.uniform(0.01, 0.4, (len(cells), 3)), axis=1)[:, ::-1]
    hits = rng.uniform(2, 30, len(cells))
    return window_of(
        cells,
        rng.uniform(-0.5, 0.5, (len(cells), 3)),
        deviations[:, :, None] * turns,
        hits,
        hits * rng.uniform(0.5, 2, len(cells)),
        rng.uniform(0, 60, len(cells)),
    )


def surfaces(window):
    return np.asarray(is_surface(CONFIG, window))


@jax.jit
def sum_of(windows, passes, coincides):
    """The sum of a map and of others that were moved, whose rays passed each voxel so often."""
    moves = [adding.Moved(coincides, lambda offset, each=each: each) for each in passes]
    return adding.sum_evidence(CONFIG, windows, [None, *moves])


def total_of(windows, coincides=False):
    passes = [np.abs(window.passes) for window in windows[1:]]
    return sum_of(list(windows), passes, np.array(coincides))


def drop_doubles(config, *pair):
    return jax.tree.map(np.asarray, drop(config, *pair))


def slow_lies_on(window, other, counts):
    """Voxel by voxel: the patches of a window on surer patches of the other one that count."""
    found = np.zeros(SHAPE, bool)
    mean, axes = (np.asarray(x, float) for x in (window.mean, window.axes))
    other_mean, other_axes = (np.asarray(x, float) for x in (other.mean, other.axes))
    weight, other_weight = np.asarray(window.weight), np.asarray(other.weight)
    for cell in np.argwhere(np.asarray(window.hits) > 0):
        for near in np.argwhere(counts):
            if np.abs(near - cell).max() > 1 or other_weight[*near] <= weight[*cell]:
                continue
            point = cell + mean[*cell] - near
            apart = point - other_mean[*near]
            for axis in other_axes[*near][:2]:
                half = 0.9 * 3**0.5 * axis
                apart = apart - np.clip(apart @ half / (half @ half), -1, 1) * half
            apart = point - np.clip(point - apart, -0.6, 0.6)
            facing = axes[*cell][2] @ other_axes[*near][2] > 0
            found[*cell] |= bool(np.linalg.norm(apart) < 0.7 and facing)
    return found


def test_dropped_patches_are_those_of_loops_and_lie_on_a_patch_that_stays():
    pair = random_window(0, 0.3), random_window(1, 0.3)
    numbers = [[np.asarray(x) for x in (w.hits, w.passes)] for w in pair]
    sure = [(hits >= 10) & (hits >= 0.5 * (hits + np.abs(passes))) for hits, passes in numbers]
    surface = [surfaces(window) for window in pair]
    after = drop_doubles(CONFIG, *pair)
    lost = [
        (np.asarray(old.hits) > 0) & (np.asarray(new.hits) == 0)
        for old, new in zip(pair, after, strict=True)
    ]
    for own, (k, j) in enumerate([(0, 1), (1, 0)]):
        on_sure = slow_lies_on(pair[k], pair[j], surface[j] & sure[j])
        expected = on_sure & ~surface[j] & ~sure[k]
        np.testing.assert_array_equal(lost[own], expected)
        assert expected.sum() > 5
        assert not (lost[own] & ~slow_lies_on(pair[k], pair[j], surface[j] & ~lost[j])).any()
        for name in NAMES:
            old, new = (np.asarray(getattr(w, name))[~lost[own]] for w in (pair[k], after[k]))
            np.testing.assert_array_equal(new, old, err_msg=name)


def flat(normal=(0.0, 0.0, 1.0)):
    """Axes of a disk that fills its voxel."""
    turn, _ = Rotation.align_vectors([normal], [(0, 0, 1)])
    return np.diag([0.3, 0.3, 0.02]) @ turn.as_matrix().T


@pytest.mark.parametrize(
    ("change", "stays"),
    [
        ({}, False),
        ({"mean": (0, 0, -0.4)}, True),  # 0.9 voxels before the other patch
        ({"axes": flat((0, 0, -1))}, True),  # seen from the other side
        ({"hits": 12.0, "passes": 3.0, "weight": 1.0}, True),  # sure
        ({"weight": 90.0}, True),  # surer than the other
    ],
)
def test_what_lies_on_a_surer_patch_of_its_side_is_dropped_and_nothing_else(change, stays):
    wall = window_of([(5, 5, 4)], (0, 0, -0.5), flat(), hits=40.0)
    thin = window_of([(5, 5, 3)], **({"mean": (0, 0, 0.3), "axes": flat(), "hits": 3.0} | change))
    for order in ((wall, thin), (thin, wall)):
        after = drop_doubles(CONFIG, *order)
        kept = after[0] if order[0] is thin else after[1]
        assert bool(kept.hits[5, 5, 3] > 0) == stays
        assert float(kept.passes[5, 5, 3]) > 0  # observed, in any case
        assert not stays or kept.behind[5, 5, 3] == thin.behind[5, 5, 3]
        assert sum(float(window.hits[5, 5, 4]) for window in after) == 40


def test_a_dropped_patch_leaves_no_free_voxel_where_no_ray_passed():
    wall = window_of([(5, 5, 4)], (0, 0, -0.5), flat(), hits=40.0)
    thin = window_of([(5, 5, 3)], (0, 0, 0.3), flat(), hits=3.0, passes=0.0)
    after = drop_doubles(CONFIG, wall, thin)[1]
    assert after.hits[5, 5, 3] == 0 and after.passes[5, 5, 3] > 0
    assert not evidence.is_free(after.passes, after.behind)[5, 5, 3]


def test_what_a_patch_was_dropped_for_stays_in_the_sum():
    """Its own map may have looked through the place of the surer patch many times."""
    thin = window_of([(5, 5, 3)], (0, 0, 0.3), flat(), hits=8.0, passes=2.0)
    thin = thin._replace(passes=changed(thin.passes, (5, 5, 4), 60))
    for hits in (8.5, 12.0, 40.0):  # too few hits to be sure, and more
        wall = window_of([(5, 5, 4)], (0, 0, -0.5), flat(), hits=hits, passes=hits)
        for pair in ((thin, wall), (wall, thin)):
            assert surfaces(total_of(pair))[5, 5, 3:5].any()


def test_a_chain_of_patches_keeps_one_within_reach_of_each():
    """P lies on Q of a second map, and Q on R of a third one; R is far from P."""
    p = window_of([(5, 5, 2)], (0, 0, 0.45), flat(), hits=4.0)
    q = window_of([(5, 5, 3)], (0, 0, 0.1), flat(), hits=8.0)
    r = window_of([(5, 5, 4)], (0, 0, -0.3), flat(), hits=40.0)
    few = [w._replace(passes=np.minimum(w.passes, 1)) for w in (p, q, r)]
    for order in itertools.permutations(few):
        total = total_of(order)
        there = np.argwhere(surfaces(total))
        mean = np.asarray(total.mean)
        heights = [cell[2] + mean[*cell][2] for cell in there]
        for height in (2.45, 3.1, 3.7):
            assert min(abs(height - h) for h in heights) < 0.75


def test_a_surface_of_both_maps_in_one_voxel_is_no_double():
    """There the moments add up."""
    pair = [window_of([(5, 5, 4)], (0, 0, z), flat(), hits=h) for z, h in ((-0.4, 40), (0.1, 4))]
    for window, after in zip(pair, drop_doubles(CONFIG, *pair), strict=True):
        np.testing.assert_array_equal(after.hits, window.hits)


def test_maps_whose_voxels_coincide_keep_all_their_hits():
    ones = np.ones(SHAPE, np.float32)
    pair = [random_window(seed, 0.1)._replace(passes=ones) for seed in (2, 3)]
    hits = sum(float(np.sum(window.hits)) for window in pair)

    def total(coincides):
        return float(np.sum(total_of(pair, coincides).hits))

    assert total(True) == pytest.approx(hits, rel=1e-5)
    assert total(False) < 0.995 * hits


def test_rays_of_a_moved_map_carve_stray_hits_where_its_voxels_overlap_unseen_ones():
    stray = window_of([(5, 5, 3)], (0, 0, 0.2), np.diag([0.1, 0.05, 0.01]), hits=2.0)
    wall = window_of([(5, 5, 5)], (0, 0, -0.4), flat(), hits=50.0)
    wall = wall._replace(passes=changed(wall.passes, (5, 5, 3), 0))  # rebinning took them

    def is_there(passed):
        through = np.full(SHAPE, passed, np.float32)
        total = sum_of([stray, wall], [through], np.array(False))
        known = map(np.asarray, (total.hits, total.passes, total.weight, total.axes))
        return bool(is_feature(CONFIG, *known)[5, 5, 3])

    assert is_there(3.0)
    assert not is_there(100.0)
