"""Whether a cloud agrees with the map, by a slow reference. Wrong poses: `mapping_moving_world`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from voxels import CONFIG, anywhere, grid_of_room, rays_to, uniform, update_frontier

from hiosdf_jax._src.change import consistency, directions, novelty
from hiosdf_jax._src.change.piercing import find_piercing

HALF, CENTER = np.array([0.47, 0.38, 0.29]), np.array([0.3, 0.5, 0.6])
SENSOR = np.array([0.33, 0.48, 0.61])
LATER = jnp.int32(5)  # the map can judge a cloud from then on
COUNT = 1500

compare = jax.jit(novelty.compare_cloud, static_argnums=0)
piercing_of = jax.jit(find_piercing, static_argnums=0)
smoothness = jax.jit(directions.smoothness)


@pytest.fixture(scope="module")
def grid():
    """Four exact views of a box room."""
    return update_frontier(CONFIG, grid_of_room(range(4)), anywhere(CENTER))


def view(seed, wide=0.9):
    """Ends of rays in a cone toward the wall at +x, exact, float64, and their ranges."""
    ahead = np.random.default_rng(seed).uniform(-wide, wide, (COUNT, 3))
    ahead[:, 0] = 1
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    ranges = ((HALF * np.sign(ahead) - (SENSOR - CENTER)) / ahead).min(axis=1)
    return SENSOR + ranges[:, None] * ahead, ranges


def seen_from(step, points, turn=0.0):
    """The same cloud, if the pose is off by a step, m, and a turn about z, rad."""
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return rays_to((points - SENSOR) @ rotation.T + SENSOR + step, SENSOR + step)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_a_thing_that_came_near_is_news_and_not_a_wrong_pose(grid, share):
    """As many rays are wrong as at a wrong pose, but the others hold the pose in all directions."""
    points, ranges = view(2)
    near = np.argsort(np.linalg.norm(points - points[7], axis=1))[: round(share * COUNT)]
    points[near] = SENSOR + (points[near] - SENSOR) * (0.12 / ranges[near])[:, None]
    found = compare(CONFIG, grid, rays_to(points, SENSOR), LATER)
    assert np.asarray(found.novel).mean() > 0.9 * share
    assert bool(found.consistent)


def judged_slowly(grid, rays, compared):
    """The definition in float64, with NumPy's eigenvalues; whether it is within 2 % of a bound."""
    size = CONFIG.voxel_size
    known, novel, distance = (np.asarray(part) for part in compared[:3])
    piercing = np.asarray(piercing_of(CONFIG, grid, rays))
    known = known & ~piercing
    usual = known & ~novel
    near = usual & (distance < size)
    normals, heights = np.zeros((COUNT, 3)), np.full(COUNT, np.inf)
    mean, axes = (np.asarray(part, float) for part in (grid.evidence.mean, grid.evidence.axes))
    for k, point in enumerate(np.asarray(rays.points_world, float)):
        index = np.unravel_index(int(compared.patch[k]), CONFIG.grid_shape)
        normals[k] = axes[index][2] / max(np.linalg.norm(axes[index][2]), 1e-6)
        center = (np.array(index) + CONFIG.corner_index + 0.5) * size
        heights[k] = abs(np.dot(normals[k], point - center - size * mean[index]))
    on_planes = np.sum(usual & (heights < 0.3 * size + 2 * np.asarray(rays.sigma)))
    values = np.linalg.eigvalsh(normals[near].T @ normals[near] / max(near.sum(), 1))
    variety = 1 - np.sqrt(np.sum(values**2)) if near.any() else 1.0
    hold = 1 / np.sum(1 / np.maximum(values, 1e-12))

    total, new, gone = rays.in_range.sum(), np.sum(known & novel), piercing.sum()
    comparable, wrong = known.sum() + gone, new + gone
    support = variety * near.sum() + 0.02 * total
    against = new + 0.5 * gone + 3 * np.sqrt(new * gone)
    smooth = float(smoothness(rays, rays.in_range))
    smooth_novel = float(smoothness(rays, compared.novel))
    noisy = [
        (wrong, 0.07 * total),
        (wrong, 0.2 * comparable),
        (wrong, 0.1 * total),
        (0.4, smooth),
        (smooth, -0.5),
    ]
    unchanged = [(near.sum(), 0.5 * comparable), (on_planes, 0.95 * usual.sum()), (hold, 0.05)]
    fills = [
        (smooth_novel, 0.4),
        (0.02 * comparable, gone),
        (near.sum(), 0.1 * comparable),
        (near.sum(), 0.9 * (comparable - new)),
    ]
    bad = [(wrong, 0.07 * total), (0.45 * (support + against), support)]

    def holds(pairs):
        return all(a >= b for a, b in pairs)

    close = any(
        abs(a - b) <= 0.02 * max(abs(a), abs(b)) + 1e-6 for a, b in noisy + unchanged + fills + bad
    )
    contradicts = holds(bad) and not holds(unchanged) and not holds(fills)
    return not (contradicts or holds(noisy)), close


def test_the_verdict_is_that_of_a_slow_reference(grid, monkeypatch):
    """Views that are moved, turned, partly replaced by near things, and partly random."""
    seen = []

    def keep(config, grid, rays, updates, compared):
        seen.append(compared)
        return real(config, grid, rays, updates, compared)

    real = consistency.judge
    monkeypatch.setattr(novelty, "judge", keep)
    parts = jax.jit(
        lambda grid, rays: (novelty.compare_cloud(CONFIG, grid, rays, LATER), seen.pop())
    )
    rng = np.random.default_rng(3)
    verdicts = []
    for seed in range(60):
        points, ranges = view(seed, wide=rng.choice([0.3, 0.9]))
        share, step = rng.choice([0, 0.1, 0.3, 0.6]), rng.choice([0, 0.1, 0.3])
        near = np.abs(points[:, 1] - CENTER[1]) < share * HALF[1]
        points[near] = SENSOR + (points[near] - SENSOR) * (0.15 / ranges[near])[:, None]
        if seed % 5 == 0:
            points[:300] = uniform(seed, 300, CENTER - HALF, CENTER + HALF)
        rays = seen_from(step * rng.uniform(-1, 1, 3), points, rng.choice([0, 0, 0.4]))
        found, compared = parts(grid, rays)
        expected, close = judged_slowly(grid, rays, compared)
        if not close:
            assert bool(found.consistent) == expected, seed
            verdicts.append(expected)
    assert 10 < sum(verdicts) < len(verdicts) - 10
