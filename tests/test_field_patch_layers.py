"""Layers of noisy patches: one surface again, against a slow reference; other patches stay."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from hiosdf_jax._src.field.patch_layers import join, nearest_of, spread_around
from hiosdf_jax._src.field.patch_rectangles import Patches
from hiosdf_jax._src.grid.patches import EXTENT_DEVIATIONS

SHAPE = (14, 13, 12)


def patches_of(points, facing):
    """The patches of hits (N, 3), whose normals are on the side of `facing` (N, 3).

    Voxels with few hits have none, as in a map.
    """
    inside = ((points >= 0) & (points < SHAPE)).all(axis=1)
    points, facing = points[inside], facing[inside]
    index = np.floor(points).astype(int)
    voxel, group = np.unique(index, axis=0, return_inverse=True)
    count = np.bincount(group.ravel())
    center, axes, kept = [], [], []
    for row in range(len(voxel)):
        own = group.ravel() == row
        if count[row] < max(4, 0.1 * count.max()):
            continue
        size, direction = np.linalg.eigh(np.cov(points[own].T, bias=True))
        first, normal = direction[:, 2], direction[:, 0]
        normal = normal * np.sign(normal @ facing[own].mean(axis=0))
        turned = np.stack([first, np.cross(normal, first), normal])
        axes.append(EXTENT_DEVIATIONS * np.sqrt(size[::-1, None]) * turned)
        center.append(points[own].mean(axis=0))
        kept.append(row)
    center, axes = np.reshape(center, (-1, 3)), np.reshape(axes, (-1, 3, 3))
    return Patches(voxel[kept], center, axes, np.zeros(len(kept), bool))


def wall(noise, seed=0, height=6.1, up=1.0, count=40_000):
    """Hits on a level wall with noise along its normal, voxels."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0, height), (14, 13, height), (count, 3))
    points[:, 2] += rng.normal(0, noise, count)
    return points, np.tile((0, 0, up), (count, 1))


def both(one, other):
    return np.concatenate([one[0], other[0]]), np.concatenate([one[1], other[1]])


def turned(patches, order):
    """The same patches with axes in another, cyclic order."""
    voxel, center = patches.voxel[:, order], patches.center[:, order]
    return patches._replace(voxel=voxel, center=center, axes=patches.axes[..., order])


def sorted_by_voxel(joined):
    order = np.lexsort(joined.patches.voxel.T)
    return joined.patches.part(order), joined.is_joined[order], joined.spread[order]


def normal_of(axes):
    across = np.cross(axes[0], axes[1])
    return across / np.linalg.norm(across)


def slow(patches):
    """The same by loops over all pairs: voxels, with center, covariance and spread of each."""
    half = np.linalg.norm(patches.axes, axis=2)
    area, thick = half[:, 0] * half[:, 1], half[:, 2] / EXTENT_DEVIATIONS
    normal = np.array([normal_of(axes) for axes in patches.axes])
    center, count = patches.center.copy(), len(area)
    points = [  # two points per axis have its variance
        [s * 3**0.5 * axis / EXTENT_DEVIATIONS for axis in patches.axes[i] for s in (-1, 1)]
        for i in range(count)
    ]

    shift = patches.center - patches.voxel - 0.5

    def near(i, reach):
        for j in range(count):
            step = patches.voxel[j] - patches.voxel[i]
            same_side = i == j or normal[i] @ normal[j] > 0.2
            if same_side and np.abs(step).max() <= reach and step @ step < 6:
                square = np.sum((center[j] - center[i]) ** 2)
                yield j, step, np.exp(-square / (2 * 0.8**2))

    def around(i, values, power):
        rows, weights = np.transpose([(j, weight * area[j]) for j, _, weight in near(i, 1)])
        weights /= (thick[rows.astype(int)] ** 2 + 0.01) ** power
        return np.average(values[rows.astype(int)], weights=weights)

    def shares(i):
        for j, step, weight in near(i, 2):
            yield j, weight * area[j] * np.exp(np.clip(6 * (shift[i] + shift[j]) @ step, -3, 3))

    def fit(i):
        every, weights, number, facing = [], [], 0, np.zeros(3)
        for j, weight in shares(i):
            every += [center[j] + offset for offset in points[j]]
            weights += [weight] * 6
            number += 1
            facing += weight * normal[j]
        size, direction = np.linalg.eigh(np.cov(np.transpose(every), aweights=weights, ddof=0))
        up = direction[:, 0] * np.sign(direction[:, 0] @ facing)
        flat = size[0] < 0.6 * size[1] and number >= 4 and up @ facing > 0.5 * sum(weights) / 6
        return up, flat

    def height(i):
        rows = [
            ((center[j] - center[i]) @ (normal[i] + normal[j]) / 2, weight)
            for j, weight in shares(i)
        ]
        return np.average([row[0] for row in rows], weights=[row[1] for row in rows])

    thickest = np.array([around(i, thick**2, 1) > 0.15**2 for i in range(count)])
    noisy = [i for i in range(count) if thickest[i] or around(i, thickest, 0) > 0.4]
    fits = {i: fit(i) for i in noisy}
    moved = [i for i in noisy if fits[i][1]]
    for i in moved:
        normal[i] = fits[i][0]
    for _ in range(2):
        heights = {i: height(i) for i in moved}
        for i in moved:
            center[i] = center[i] + heights[i] * normal[i]
    return merged_slowly(patches, center, normal, moved, points)


def merged_slowly(patches, center, normal, moved, points):
    """One patch per voxel; those that disagree with the first one of their voxel go back."""
    half = np.linalg.norm(patches.axes, axis=2)
    area, thick = half[:, 0] * half[:, 1], half[:, 2] / EXTENT_DEVIATIONS
    own, moved = [normal_of(axes) for axes in patches.axes], set(moved)
    while True:
        voxels = {}
        for i in range(len(area)):
            voxel = np.floor(center[i]).astype(int) if i in moved else patches.voxel[i]
            voxels.setdefault(tuple(voxel.tolist()), []).append(i)
        back = set()
        for members in voxels.values():
            leader = min(members, key=lambda i: (i in moved, -area[i]))
            for i in members:
                distance = abs((center[i] - center[leader]) @ normal[leader])
                if normal[i] @ normal[leader] <= 0.8 or distance >= 0.35:
                    back.add(i)
        for i in back:
            moved.remove(i)
            center[i], normal[i] = patches.center[i], own[i]
        if not back:
            break
    result = {}
    for key, members in voxels.items():
        if not set(members) & moved:
            axes = patches.axes[members[0]] / EXTENT_DEVIATIONS
            result[key] = center[members[0]], axes.T @ axes, thick[members[0]], False
            continue
        every = np.concatenate([center[i] + np.array(points[i]) for i in members])
        weights = np.repeat(area[members], 6)
        spread = np.cov(every.T, aweights=weights, ddof=0)
        up = np.average(normal[members], axis=0, weights=area[members])
        up /= np.linalg.norm(up)
        across = np.sqrt(up @ spread @ up)
        moves = [(center[i] - patches.center[i]) @ normal[i] for i in members]
        wide = np.hypot(across, np.sqrt(np.average(np.square(moves), weights=area[members])))
        level = np.eye(3) - np.outer(up, up)
        covariance = level @ spread @ level + min(across, 0.15) ** 2 * np.outer(up, up)
        result[key] = np.average(every, axis=0, weights=weights), covariance, wide, True
    return result


def test_the_slow_reference():
    """A noisy wall that meets a sharp one, and a second, noisy side that faces away."""
    sharp, facing = wall(0.02, 1)
    rows = [
        both(wall(0.5, 0), wall(0.3, 2, 2.0, -1.0)),
        (sharp[:, [2, 0, 1]], facing[:, [2, 0, 1]]),
    ]
    points, facing = (array[::12] for array in both(*rows))
    half = points[:, 1] < 7
    patches = patches_of(points[half], facing[half])
    found, moved, spread = sorted_by_voxel(join(patches, SHAPE))
    expected = slow(patches)
    assert len(found.voxel) == len(expected)
    assert 20 < moved.sum() < len(moved) - 20
    for row, voxel in enumerate(found.voxel.tolist()):
        center, covariance, across, is_joined = expected[tuple(voxel)]
        axes = found.axes[row] / EXTENT_DEVIATIONS
        assert moved[row] == is_joined
        np.testing.assert_allclose(found.center[row], center, atol=1e-8)
        np.testing.assert_allclose(axes.T @ axes, covariance, atol=1e-8)
        assert spread[row] == pytest.approx(across, abs=1e-8)


@pytest.mark.parametrize("noise", [0.3, 0.4, 0.5, 0.6])
def test_a_noisy_wall_is_one_layer(noise):
    patches = patches_of(*wall(noise))
    assert np.std(patches.center[:, 2]) > 0.7 * noise
    joined = join(patches, SHAPE)
    inner = (joined.patches.voxel[:, :2] > 1).all(axis=1) & joined.is_joined
    inner &= (joined.patches.voxel[:, :2] < np.subtract(SHAPE[:2], 2)).all(axis=1)
    middle = joined.patches.part(inner)
    assert len(np.unique(middle.voxel[:, :2], axis=0)) >= 89  # of 90 places
    assert len(middle.voxel) < 100
    assert np.percentile(np.abs(middle.center[:, 2] - 6.1), 90) < 0.1  # layers are 0.7 apart
    assert (middle.normal[:, 2] > 0.98).all()
    assert (middle.thickness <= 0.15 + 1e-9).all()
    # Layers count alike, though few hits are far from the wall.
    assert 0.8 * noise < np.median(joined.spread[inner]) < 1.3 * noise


@pytest.mark.parametrize("shape", ["wall", "crease", "sphere"])
def test_sharp_patches_stay(shape):
    points, facing = wall(0.05)
    if shape == "crease":
        points, facing = both((points, facing), (points[:, [2, 0, 1]], facing[:, [2, 0, 1]]))
    if shape == "sphere":
        rays = np.random.default_rng(0).normal(size=(40_000, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        points, facing = 6 + 5 * rays, -rays
    found = patches_of(points, facing)
    joined = join(found, SHAPE)
    assert joined.is_joined.mean() < 0.01
    assert len(joined.patches.voxel) >= 0.99 * len(found.voxel)


def test_the_two_sides_of_a_solid_stay_apart():
    """2.5 voxels thick, with noise of .35 voxels on either side."""
    patches = patches_of(*both(wall(0.35, 0, 7.2), wall(0.35, 1, 4.7, -1.0)))
    found = join(patches, SHAPE)
    inner = found.is_joined & (np.abs(found.patches.voxel[:, :2] - 6) < 4).all(axis=1)
    height, up = found.patches.center[inner, 2], found.patches.normal[inner, 2]
    assert np.abs(height[up > 0.5] - 7.2).max() < 0.35
    assert np.abs(height[up < -0.5] - 4.7).max() < 0.35
    assert (up > 0.5).sum() > 40 < (up < -0.5).sum()


@pytest.mark.parametrize("radius", [3.0, 5.0])
def test_a_noisy_sphere_keeps_its_radius(radius):
    """Not so by planes through the patches around, which lie inside of it."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(40_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = 6 + (radius + rng.normal(0, 0.35, (len(rays), 1))) * rays
    joined = join(patches_of(points, rays), SHAPE)
    center = joined.patches.center[joined.is_joined]
    depth = np.linalg.norm(center - 6, axis=1)
    assert joined.is_joined.mean() > 0.8
    assert np.mean(depth) == pytest.approx(radius, abs=0.15)
    assert np.std(depth) < 0.2


@pytest.mark.parametrize("top", [6.1, 6.3, 6.5, 6.7, 6.9])
@pytest.mark.parametrize("thickness", [1.0, 1.5])
def test_a_thin_wall_keeps_both_of_its_sides(top, thickness):
    patches = patches_of(*both(wall(0.3, 0, top), wall(0.3, 1, top - thickness, -1.0)))
    found = join(patches, SHAPE).patches
    for height, up in ((top, 1), (top - thickness, -1)):
        side = (up * found.normal[:, 2] > 0.7) & (np.abs(found.center[:, 2] - height) < 0.4)
        places = np.unique(found.voxel[side, :2], axis=0)
        inner = ((places > 1) & (places < np.subtract(SHAPE[:2], 2))).all(axis=1)
        assert inner.sum() >= 80  # of 90 places; meshes close narrow gaps


def test_joining_does_not_depend_on_axes_or_order():
    patches, order = patches_of(*wall(0.5)), [2, 0, 1]
    one = sorted_by_voxel(join(patches, SHAPE))
    backwards = sorted_by_voxel(join(patches.part(np.arange(len(patches.voxel))[::-1]), SHAPE))
    for a, b in zip(one[0][:2], backwards[0][:2], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(one[2], backwards[2], atol=1e-9)
    other = join(turned(patches, order), tuple(np.take(SHAPE, order)))
    back = sorted_by_voxel(other._replace(patches=turned(other.patches, [1, 2, 0])))
    np.testing.assert_allclose(one[0].center, back[0].center, atol=1e-9)
    np.testing.assert_allclose(one[2], back[2], atol=1e-9)


def test_no_patch_and_a_single_one():
    none = patches_of(*wall(0.5)).part(np.zeros(0, int))
    assert len(join(none, SHAPE).is_joined) == 0
    one = patches_of(*wall(0.5)).part(np.array([7]))
    joined = join(one, SHAPE)
    assert not joined.is_joined.any()
    np.testing.assert_array_equal(joined.patches.center, one.center)


def test_nearest_patches_against_a_loop():
    patches = patches_of(*both(wall(0.5, 0, 3.0), wall(0.02, 1, 9.5)))
    joined = join(patches, SHAPE)
    every = np.indices(SHAPE).reshape(3, -1).T
    row = KDTree(patches.center).query(every + 0.5)[1]
    nearest = (patches.voxel[row] - every).reshape(*SHAPE, 3).astype(np.int8)
    result = nearest_of(nearest, patches, joined)
    after = joined.patches
    changed = {tuple(row) for row in patches.voxel} - {tuple(row) for row in after.voxel}
    changed |= {tuple(row) for row in after.voxel[joined.is_joined]}
    rows = {tuple(row): i for i, row in enumerate(after.voxel.tolist())}
    line = np.linspace(-0.8, 0.8, 3)
    marks = np.array(  # (16, M, 3)
        [after.center + a * after.axes[:, 0] + b * after.axes[:, 1] for a in line for b in line]
    )
    checked, changed = 0, np.array(sorted(changed))
    for voxel in np.ndindex(SHAPE):
        if np.abs(changed - voxel).max(axis=1).min() > 2:
            np.testing.assert_array_equal(result[voxel], nearest[voxel])
            continue
        distance = np.linalg.norm(marks - np.add(voxel, 0.5), axis=-1).min(axis=0)
        found = distance[rows[tuple(np.add(voxel, result[voxel]).tolist())]]
        assert (
            found <= distance.min() + 1e-9 or distance.min() > 2
        )  # farther ones are not looked for
        checked += 1
    assert checked > 300
    unmoved = joined._replace(is_joined=np.zeros_like(joined.is_joined))
    np.testing.assert_array_equal(nearest_of(nearest, patches, unmoved), nearest)


def test_spread_around():
    joined = join(patches_of(*wall(0.5)), SHAPE)
    position = np.random.default_rng(3).uniform(-0.5, 14, (500, 3))
    found = spread_around(joined, SHAPE, position)
    for where, value in zip(position, found, strict=True):
        voxel = np.clip(np.floor(where), 0, np.subtract(SHAPE, 1))
        near = (np.abs(joined.patches.voxel - voxel).max(axis=1) <= 1) & joined.is_joined
        assert value == pytest.approx(max(joined.spread[near], default=0), rel=1e-6)
    still = joined._replace(is_joined=np.zeros_like(joined.is_joined))
    assert not spread_around(still, SHAPE, position).any()
