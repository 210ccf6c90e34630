"""Smoothed patches against a slow reference, and on planes, spheres and creases."""

import numpy as np
import pytest

from hiosdf_jax._src.field.patch_rectangles import Patches
from hiosdf_jax._src.field.patch_smoothing import smooth

SHAPE = (12, 11, 10)


def patches_of(center, normal, rng=None, half=0.4, thickness=(0.01, 0.1)):
    """Patches around centers (M, 3) with normals (M, 3), their first axes at random."""
    rng = rng or np.random.default_rng(0)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    along = np.cross(normal, rng.normal(size=normal.shape))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    size = np.broadcast_arrays(half, 0.8 * half, rng.uniform(*thickness, len(center)))
    axes = np.stack(size, axis=1)[:, :, None] * np.stack(
        [along, np.cross(normal, along), normal], axis=1
    )
    return Patches(np.floor(center).astype(int), center, axes, np.zeros(len(center), bool))


def normals(patches):
    across = np.cross(patches.axes[:, 0], patches.axes[:, 1])
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def plane(noise, seed=0):
    """Patches in a layer of voxels, with normals and heights that have noise."""
    rng = np.random.default_rng(seed)
    voxel = np.array([(x, y, 4) for x in range(12) for y in range(11)])
    center = voxel + np.array([0.5, 0.5, 0.6])
    center += rng.uniform(-0.2, 0.2, center.shape) * (1, 1, 0)
    center[:, 2] += rng.normal(0, noise, len(center))
    return patches_of(center, np.add((0, 0, 1), rng.normal(0, noise, center.shape)), rng)


def slow(patches):
    """The same by loops over all pairs, with the moments of points instead of axes."""
    own = normals(patches)
    half = np.linalg.norm(patches.axes, axis=2)
    wide = half[:, 1] > 0.1
    area = half[:, 0] * half[:, 1]

    def continuing(i):
        for j in range(len(own)):
            offset = patches.center[j] - patches.center[i]
            if not (wide[i] and wide[j]):
                continue
            if np.abs(patches.voxel[j] - patches.voxel[i]).max() > 1 or abs(own[i] @ own[j]) <= 0.9:
                continue
            thickness = (half[i, 2] + half[j, 2]) / (0.9 * 3**0.5)
            farthest = 0.2 + (thickness if own[i] @ own[j] > 0 else 0)
            if max(abs(offset @ own[i]), abs(offset @ own[j])) < farthest:
                yield j, area[j] * np.exp(-(offset @ offset) / (2 * 0.6**2))

    normal = own.copy()
    for i in range(len(own)):
        points, weights = [], []
        for j, weight in continuing(i):
            for axis in patches.axes[j] / (0.9 * 3**0.5):
                for sign in (-1, 1):  # two points per axis have its variance
                    points.append(patches.center[j] + sign * 3**0.5 * axis)
                    weights.append(weight)
        if points:
            found = np.linalg.eigh(np.cov(np.transpose(points), aweights=weights))[1][:, 0]
            if abs(found @ own[i]) > 0.9:
                normal[i] = found * np.sign(found @ own[i])
    center, axes = patches.center.copy(), patches.axes.copy()
    for i in np.flatnonzero(wide):
        heights, weights = [], []
        for j, weight in continuing(i):
            other = normal[j] * (1 if normal[j] @ normal[i] > 0 else -1)
            heights.append((patches.center[j] - patches.center[i]) @ (normal[i] + other) / 2)
            weights.append(weight)
        center[i] += np.average(heights, weights=weights) * normal[i]
        along = axes[i, 0] - (axes[i, 0] @ normal[i]) * normal[i]
        along /= np.linalg.norm(along)
        axes[i] = half[i][:, None] * [along, np.cross(normal[i], along), normal[i]]
    return center, axes


def turned(patches, order):
    """The same patches with axes in another, cyclic order."""
    voxel, center = patches.voxel[:, order], patches.center[:, order]
    return patches._replace(voxel=voxel, center=center, axes=patches.axes[..., order])


def joined(one, other):
    """The patches of two, of which the first's come first; one per voxel."""
    taken = (other.voxel[:, None] == one.voxel).all(axis=2).any(axis=1)
    pairs = zip(one, other.part(~taken), strict=True)
    return Patches(*(np.concatenate(pair) for pair in pairs))


def test_the_slow_reference():
    """Two planes with much noise that cross; seen from both sides; some hits on lines."""
    found = joined(plane(0.1), turned(plane(0.1, seed=1), [1, 2, 0]))
    rng = np.random.default_rng(2)
    found.axes[rng.random(len(found.axes)) < 0.5, 1:] *= -1
    found.axes[::7, 1:] *= 0.1
    expected_center, expected_axes = slow(found)
    result = smooth(found, (12, 12, 12))
    assert np.median(np.abs(result.center - found.center).max(axis=1)) > 0.003
    np.testing.assert_allclose(result.center, expected_center, atol=1e-9)
    np.testing.assert_allclose(result.axes, expected_axes, atol=1e-7)
    np.testing.assert_array_equal(result.center[::7], found.center[::7])


def test_a_plane_stays_and_its_noise_falls():
    exact = plane(0.0)
    result = smooth(exact, SHAPE)
    np.testing.assert_allclose(result.center, exact.center, atol=1e-12)
    np.testing.assert_allclose(result.axes, exact.axes, atol=1e-9)
    noisy = plane(0.05)
    result = smooth(noisy, SHAPE)
    tilt = [np.arccos(np.abs(normals(p)[:, 2])).mean() for p in (noisy, result)]
    height = [np.abs(p.center[:, 2] - 4.6).mean() for p in (noisy, result)]
    assert tilt[1] < 0.6 * tilt[0]
    assert height[1] < 0.75 * height[0]


def test_layers_of_voxels_join_where_their_patches_are_thick():
    voxel = np.array([(x, y, z) for x in range(12) for y in range(11) for z in (4, 5)])
    center = voxel + (0.5, 0.5, 0.5) + np.where(voxel[:, 2:] == 4, 0.35, -0.35) * (0, 0, 1)
    for thickness, joins in ((0.05, False), (0.3, True)):
        found = patches_of(
            center, np.tile((0, 0, 1.0), (len(center), 1)), thickness=[thickness] * 2
        )
        spread = np.std(smooth(found, SHAPE).center[:, 2])
        assert (spread < 0.05) if joins else (spread > 0.149)


@pytest.mark.parametrize("radius", [4.0, 7.0])
def test_a_sphere_keeps_its_radius(radius):
    """Not so by the mean of neighbors, which lies inside."""
    rays = np.random.default_rng(0).normal(size=(4_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    center = radius * rays + 8
    center = center[np.unique(np.floor(center).astype(int), axis=0, return_index=True)[1]]
    result = smooth(patches_of(center, 8 - center), (17, 17, 17))
    offset = result.center - 8
    depth = np.linalg.norm(offset, axis=1)
    assert np.abs(depth - radius).mean() < 0.01
    inward = -np.sum(normals(result) * offset, axis=1) / depth
    assert np.median(inward) > 0.995


def test_a_column_of_narrow_patches_does_not_turn_across():
    """The hits of a leg vary less across it than along the noise of its normals."""
    voxel = np.array([(4, 4, z) for z in range(9)])
    center = voxel + 0.5 + np.where(voxel[:, 2:] % 2, 0.13, -0.13) * (1, 0, 0)
    normal = np.tile((-1.0, 0, 0), (9, 1))
    along = np.tile((0, 0, 0.45), (9, 1))
    axes = np.stack([along, 0.12 * np.cross(normal, along / 0.45), 0.02 * normal], axis=1)
    result = smooth(Patches(voxel, center, axes, np.ones(9, bool)), SHAPE)
    assert (normals(result)[:, 0] < -0.9).all()


def test_a_crease_is_left_alone():
    both = joined(plane(0.0), turned(plane(0.0, seed=1), [1, 2, 0]))
    result = smooth(both, (12, 12, 12))
    np.testing.assert_allclose(result.center, both.center, atol=1e-12)
    np.testing.assert_allclose(result.axes, both.axes, atol=1e-9)


def test_patches_turn_with_the_axes_and_do_not_depend_on_their_order():
    found, order = plane(0.05), [2, 0, 1]
    result = smooth(found, SHAPE)
    other = smooth(turned(found, order), tuple(np.take(SHAPE, order)))
    np.testing.assert_allclose(other.center, result.center[:, order], atol=1e-12)
    np.testing.assert_allclose(other.axes, result.axes[..., order], atol=1e-9)
    backwards = smooth(Patches(*(values[::-1] for values in found)), SHAPE)
    np.testing.assert_allclose(backwards.center[::-1], result.center, atol=1e-12)


def test_one_patch_or_none():
    one = plane(0.05).part(np.arange(132) == 7)
    result = smooth(one, SHAPE)
    np.testing.assert_allclose(result.center, one.center, atol=1e-12)
    np.testing.assert_allclose(result.axes, one.axes, atol=1e-9)
    assert len(smooth(one.part(np.zeros(1, bool)), SHAPE).center) == 0
