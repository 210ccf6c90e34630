"""The grid's distance at points: exact for a room, and for a sheet seen from both sides."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import clear, interpret_point_kernels, lowered
from voxels import (
    BOUNDS,
    CONFIG,
    anywhere,
    distance_at,
    empty_window,
    fuse,
    grid_of,
    grid_of_room,
    trace,
    uniform,
    update_distances,
    update_frontier,
)

from hiosdf_jax._src.grid import distance, evidence, interpolation, lookup
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.vectors import split
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Side, surface_of


@pytest.fixture(scope="module")
def room():
    """Few views: walls have gaps between their patches."""
    return grid_of_room(range(2))


def test_distance_in_a_room_is_exact_in_value_sign_and_gradient():
    half, center = np.array([0.47, 0.38, 0.29]), np.array([0.3, 0.5, 0.6])
    surface = surface_of(grid_of_room(range(4)))
    points = uniform(11, 2000)
    gaps = half - np.abs(points - center)
    exact = np.where(
        (gaps > 0).all(axis=1), gaps.min(axis=1), -np.linalg.norm(np.minimum(gaps, 0), axis=1)
    )
    value, gradient = distance_at(surface, points)
    inside = exact > 0
    error = value - exact
    assert np.abs(error[inside]).mean() < 0.002
    # In the voxels of the room's edges a patch has no side; 2 cm away the sign is certain.
    assert (value[exact > 0.02] > 0).all()
    assert np.mean(value[inside] > 0) > 0.95
    shallow = (exact < -0.005) & (exact > -0.1)
    assert shallow.sum() > 50
    assert np.mean(value[shallow] < 0) > 0.95
    assert np.abs(error[shallow]).mean() < 0.01
    ordered = np.sort(gaps, axis=1)
    plain = inside & (exact > 0.01) & (ordered[:, 1] - ordered[:, 0] > 0.08)
    axis = np.argmin(gaps[plain], axis=1)
    normal = -np.sign(points - center)[plain] * (np.arange(3) == axis[:, None])
    assert np.mean(np.sum(gradient[plain] * normal, axis=1)) > 0.99
    assert np.isfinite(gradient).all()
    one_by_one = jax.jit(lookup.grid_sdf, static_argnums=0)
    single = [one_by_one(CONFIG, surface, point) for point in points[:20]]
    np.testing.assert_allclose(value[:20], single, atol=1e-6)


def test_the_gradient_is_that_of_the_value_between_patches_too(room):
    surface, step = surface_of(room), 1e-3
    points = uniform(13, 2000)
    _, gradient = distance_at(surface, points)
    ahead, behind = (
        np.stack([distance_at(surface, points + s * step * axis)[0] for axis in np.eye(3)], axis=1)
        for s in (1, -1)
    )
    error = np.linalg.norm((ahead - behind) / (2 * step) - gradient, axis=1)
    assert np.median(error) < 1e-3  # 1e-2 with half the slope of the weights
    assert np.mean(error > 0.02) < 0.08  # where the value jumps or bends


def seen_room(room):
    """The room with its frontier: its inside is observed."""
    return update_frontier(CONFIG, room, anywhere((0.3, 0.5, 0.6)))


def any_sides(room):
    """The room with a side and a state of observation drawn at random for each voxel."""
    rng = np.random.default_rng(31)
    side = rng.integers(-1, 4, CONFIG.grid_shape).astype(np.int8)
    steps = rng.choice([-5, 5], CONFIG.grid_shape).astype(np.int8)
    derived = room.derived.replace(side=jnp.asarray(side), frontier_steps=jnp.asarray(steps))
    return room.replace(derived=derived)


def patch_at(grid, cell, point):
    """Distance of a point from the patch of a voxel, and height above its plane, float64 voxels."""
    mean = np.asarray(grid.evidence.mean[tuple(cell)], np.float64) + cell + 0.5
    axes = np.asarray(grid.evidence.axes[tuple(cell)], np.float64)
    offset = point - mean
    height = offset @ axes[2] / np.linalg.norm(axes[2])
    # Smaller by up to 14 % between 2 and 5 voxels from its center.
    shrinking = 0.14 * np.clip((offset @ offset - 2**2) / (5**2 - 2**2), 0, 1)
    for axis in axes[:2]:
        half = 0.9 * 3**0.5 * (1 - shrinking) * axis
        offset = offset - np.clip(offset @ half / (half @ half), -1, 1) * half
    inside = np.clip(point - offset, np.array(cell) - 0.1, np.array(cell) + 1.1)
    return np.linalg.norm(point - inside), height


def space_around(derived, corners, own):
    """Shares of the space around a point by side, from (weight, voxel) of the eight around it.

    In unseen space its own voxel decides alone.
    """
    seen = [(weight**2, cell) for weight, cell in corners if derived.frontier_steps[cell] > 0]
    deciding = seen if derived.frontier_steps[own] > 0 else [(1.0, own)]
    shares = {Side.FREE: 0.0, Side.BEHIND: 0.0, "other": 0.0}
    for weight, cell in deciding:
        side = int(derived.side[cell])
        shares[side if side in (Side.FREE, Side.BEHIND) else "other"] += weight
    return {key: share / sum(shares.values()) for key, share in shares.items()}


def slow_distance(grid, point_world):
    """The signed distance at one point, m, one voxel after the other in float64."""
    point = point_world / 0.1 - CONFIG.corner_index
    base, derived, corners = np.floor(point - 0.5).astype(int), grid.derived, []
    for corner in itertools.product((0, 1), repeat=3):
        cell = tuple(base + corner)
        weight = np.prod(np.where(corner, point - 0.5 - base, 1 - (point - 0.5 - base)))
        if all(0 <= c < n for c, n in zip(cell, CONFIG.grid_shape, strict=True)):
            corners.append((weight, cell))
    own = tuple(np.clip(np.floor(point).astype(int), 0, np.array(CONFIG.grid_shape) - 1))
    shares, found = space_around(derived, corners, own), []
    for weight, cell in corners:
        jump = np.asarray(derived.nearest[cell], int)
        if jump[0] == NO_FEATURE:
            continue
        distance, height = patch_at(grid, np.array(cell) + jump, point)
        side = int(derived.side[cell])
        if side in (Side.FREE, Side.UNKNOWN):
            value = distance
        elif side == Side.SHEET:
            value = abs(height)
        else:
            value = max(1.5 * height, -distance) if height < 0 else height
        limit = max(min(distance, 0.4 - 1.4 * (distance - 0.4)), -distance)
        free, behind = shares[Side.FREE], shares[Side.BEHIND]
        value = free * max(value, -limit) + behind * min(value, limit) + shares["other"] * value
        found.append((max(weight, 1e-6), distance, value))
    weights, distances, values = map(np.array, zip(*found, strict=True))
    near = weights * np.exp(-distances / 0.14)
    away = np.dot(near, distances) / near.sum()
    power = np.interp(away, [0.1, 0.3], [1, 0.3])
    even = weights * np.exp(-power * distances / 0.14)
    size = np.dot(near, np.abs(values)) / near.sum()
    return 0.1 * size * np.dot(even, values) / np.dot(even, np.abs(values))


@pytest.mark.parametrize("seen", ["nothing", "room", "anything"])
def test_distance_against_a_slow_reference(room, seen):
    change = {"nothing": lambda room: room, "room": seen_room, "anything": any_sides}
    grid, points = change[seen](room), uniform(12, 300)
    value, _ = distance_at(surface_of(grid), points)
    known = jax.tree.map(np.asarray, grid)
    expected = [slow_distance(known, point) for point in points.astype(np.float64)]
    np.testing.assert_allclose(value, expected, atol=1e-4)  # the axes are float16


def test_the_distance_to_the_nearest_patch_has_no_sign(room):
    points = uniform(36, 300)
    grid = jax.tree.map(np.asarray, any_sides(room))
    nearest = jax.jit(lookup.nearest_patch, static_argnums=0)(CONFIG, surface_of(grid), points)
    expected = []
    for point in points.astype(np.float64) / 0.1 - CONFIG.corner_index:
        cells = np.floor(point - 0.5).astype(int) + list(itertools.product((0, 1), repeat=3))
        cells = cells[np.all((cells >= 0) & (cells < CONFIG.grid_shape), axis=-1)]
        jumps = grid.derived.nearest[tuple(cells.T)].astype(int)
        sites = (cells + jumps)[jumps[:, 0] != NO_FEATURE]
        expected.append(0.1 * min(patch_at(grid, site, point)[0] for site in sites))
    np.testing.assert_allclose(nearest.distance, expected, atol=1e-4)


def test_distance_is_about_that_to_the_nearest_of_all_patches(room):
    """The mean of the patches around a point is near the least distance, also where walls have
    gaps, and never much farther."""
    kept = room.evidence
    arrays = (kept.hits, kept.passes, kept.behind, kept.root_weight, kept.axes)
    arrays = (jnp.asarray(array, jnp.float32) for array in arrays)
    cells = np.argwhere(distance.find_sites(CONFIG, *arrays)[0])
    points, known = uniform(12, 100), jax.tree.map(np.asarray, room)
    exact = np.array(
        [
            0.1 * min(patch_at(known, cell, point / 0.1 - CONFIG.corner_index)[0] for cell in cells)
            for point in points.astype(np.float64)
        ]
    )
    value = np.abs(distance_at(surface_of(room), points)[0])
    assert np.abs(value - exact).mean() < 0.005
    assert (value - exact).max() < 0.01


def test_distance_changes_little_between_near_points(room):
    """Also where the eight voxels around the point change."""
    points = uniform(21, 4000, (-0.1, 0.2, 0.35), (0.7, 0.8, 0.85))
    value, _ = distance_at(surface_of(room), points)
    step = 0.0025 * uniform(22, 4000, (-0.5,) * 3, (0.5,) * 3)
    moved, _ = distance_at(surface_of(room), points + step)
    change = np.abs(np.asarray(moved) - value)
    assert change.max() < 0.005


def test_distance_does_not_jump_where_free_voxels_meet_voxels_behind_a_surface(room):
    """In observed space, whatever the sides of voxels are and whichever were observed."""
    rng = np.random.default_rng(32)
    side = rng.integers(Side.BEHIND, Side.FREE, CONFIG.grid_shape, np.int8, endpoint=True)
    steps = rng.choice([-5, 5], CONFIG.grid_shape, p=[0.2, 0.8]).astype(np.int8)
    derived = room.derived.replace(side=jnp.asarray(side), frontier_steps=jnp.asarray(steps))
    surface = surface_of(room.replace(derived=derived))
    points, other = uniform(33, 20_000), uniform(34, 20_000)
    # One coordinate lies on a plane through centers of voxels, or on a border between them.
    axis = np.arange(len(points)) % 3
    plane = np.round(points[np.arange(len(points)), axis] / 0.05) * 0.05
    ends = []
    for step in (-1e-6, 1e-6):
        points[np.arange(len(points)), axis] = plane + step
        ends.append(np.clip(points + step * (other - 0.3), *np.asarray(BOUNDS, np.float32)))
    voxels = [np.floor(each / 0.1).astype(int) - CONFIG.corner_index for each in ends]
    voxels = [np.clip(each, 0, np.array(CONFIG.grid_shape) - 1) for each in voxels]
    observed = np.all([steps[tuple(each.T)] > 0 for each in voxels], axis=0)
    before, after = (
        np.concatenate([distance_at(surface, part)[0] for part in np.split(each, 10)])
        for each in ends
    )
    assert np.mean(np.abs(before) > 0.1) > 0.05  # where a jump would be 20 cm
    assert observed.sum() > 10_000
    assert np.abs(after - before)[observed].max() < 1e-3


def test_a_gradient_can_hold_the_sides_of_space_fixed(room):
    """Registration does, since the slope of the sides is no normal of a surface."""
    surface = surface_of(any_sides(room))
    points = uniform(37, 500)

    @jax.jit
    def held(points, side_points):
        return lookup.nearest_patch_at(CONFIG, surface, split(points), split(side_points)).sdf

    gradient = jax.jit(jax.grad(lambda points, fixed: jnp.sum(held(points, fixed))))(points, points)
    value, whole = distance_at(surface, points)
    np.testing.assert_allclose(held(points, points), value, atol=1e-6)

    step = 1e-3
    ahead, behind = (
        np.stack([held(points + s * step * axis, points) for axis in np.eye(3)], axis=1)
        for s in (1, -1)
    )
    error = np.linalg.norm((ahead - behind) / (2 * step) - gradient, axis=1)
    assert np.median(error) < 1e-3
    assert np.mean(error > 0.02) < 0.15  # where the eight voxels change or the value bends
    assert np.mean(np.linalg.norm(whole - gradient, axis=1) > 0.02) > 0.1


def test_a_sheet_seen_from_both_sides_is_free_on_both():
    window = empty_window()
    for side in (-1, 1):
        sensor = np.array([0.3 + side * 0.4, 0.5, 0.6])
        ends = uniform(13, 3000, (0.36, 0.1, 0.3), (0.36001, 0.9, 0.9))
        window = trace(fuse(window, ends, sensor), ends, sensor)
    grid = grid_of(window, evidence.empty_grid(CONFIG).derived)
    grid = update_distances(CONFIG, grid, anywhere((0.3, 0.5, 0.6)))
    points = uniform(14, 300, (0.2, 0.3, 0.45), (0.52, 0.7, 0.75))
    value, _ = distance_at(surface_of(grid), points)
    assert np.mean(value >= 0) > 0.99
    # Patches leave narrow gaps between each other: exact in the mean, within 1 cm everywhere.
    error = value - np.abs(points[:, 0] - 0.36)
    assert np.abs(error).mean() < 5e-4
    assert np.abs(error).max() < 0.01


def test_an_empty_grid_answers_the_horizon():
    surface = surface_of(evidence.empty_grid(CONFIG))
    value, gradient = distance_at(surface, uniform(15, 20))
    np.testing.assert_array_equal(value, np.full(20, 1.5, np.float32))
    assert np.isfinite(gradient).all()


def answers(surface, points):
    """All that the grid answers, and its gradients."""

    def distances(point):
        nearest = lookup.nearest_patch(CONFIG, surface, point)
        doubt = interpolation.doubt_distance(CONFIG, surface, point)
        frontier = interpolation.frontier_distance(CONFIG, surface, point)
        return nearest.sdf, nearest.spread, doubt, frontier

    return jax.jit(lambda: (distances(points), jax.vmap(jax.jacrev(distances))(points)))()


def test_the_kernel_of_a_gpu_answers_as_xla_does(room, monkeypatch):
    """The kernel is interpreted, at points in the grid and on its border."""
    surface = surface_of(room)
    points = jnp.clip(1.2 * uniform(5, 400), *jnp.asarray(BOUNDS, jnp.float32))
    expected = answers(surface, points)
    interpret_point_kernels(monkeypatch)
    found = answers(surface, points)
    clear()
    for value, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(value, other, atol=1e-4)


def test_all_lookups_can_be_lowered_for_a_gpu(room, monkeypatch):
    """Triton has fewer operations than the interpreter."""
    surface, points = surface_of(room), jnp.asarray(uniform(5, 4096))
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    clear()
    for find in (lookup.grid_sdf, interpolation.doubt_distance, interpolation.frontier_distance):

        def value(points, find=find):
            return find(CONFIG, surface, points)

        assert "gpu.triton" in lowered(value, points)
        assert "gpu.triton" in lowered(jax.grad(lambda points, f=value: f(points).sum()), points)
    clear()


def test_several_maps_of_a_gpu_are_looked_up_under_a_condition(room, monkeypatch):
    """Batched conditions batch the constants, too; jax refuses that where a kernel is chosen."""
    expected = lookup.grid_sdf(CONFIG, surface_of(room), uniform(5, 300))
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    clear()
    maps = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), surface_of(room))

    def look(surface, chosen):
        def answer():
            return lookup.grid_sdf(CONFIG, surface, uniform(5, 300))

        return jax.lax.cond(chosen, answer, lambda: jnp.zeros(300))

    found = jax.jit(jax.vmap(look))(maps, jnp.array([True, False]))
    clear()
    np.testing.assert_allclose(found[0], expected, atol=1e-5)
    np.testing.assert_array_equal(found[1], 0)
