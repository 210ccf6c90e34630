"""A small grid, and the stages that fill it, for tests that compare them with slow references.

The evidence is one float32 window over the whole grid, so that no rounding to float16 and no
placement of windows comes between a stage and its reference.
"""

import jax
import jax.numpy as jnp
import numpy as np

import hiosdf_jax as hio
from hiosdf_jax._src.grid import carving, distance, evidence, frontier, lookup, patches
from hiosdf_jax._src.grid.evidence import EvidenceWindow
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.grid.windows import RayBox
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.state.pytrees import Evidence, Grid

BOUNDS = ((-0.3, 0.0, 0.2), (0.9, 1.0, 1.0))
CONFIG = hio.Config.light(
    BOUNDS, max_range=3.0, distance_horizon=1.5, near_samples=300, far_samples=500, min_hits=1
)
SHAPE = (12, 10, 8)

# One compilation per stage and configuration, as in an update.
fuse_hits = jax.jit(patches.fuse_hits, static_argnums=0)
trace_rays = jax.jit(carving.trace_rays, static_argnums=0)
fade_evidence = jax.jit(evidence.fade_evidence, static_argnums=0)
update_distances = jax.jit(distance.update_distances, static_argnums=0)
update_frontier = jax.jit(frontier.update_frontier, static_argnums=0)


@jax.jit
def grid_sdf_and_grad(surface, points):
    return value_and_gradient(lambda each: lookup.grid_sdf(CONFIG, surface, each), points)


def whole_window(stored):
    """The window over the whole of a grid's evidence."""
    return EvidenceWindow(
        start=jnp.zeros(3, jnp.int32),
        hits=stored.hits.astype(jnp.float32),
        passes=stored.passes.astype(jnp.float32),
        behind=stored.behind.astype(jnp.float32),
        weight=stored.root_weight.astype(jnp.float32) ** 2,
        mean=stored.mean,
        axes=stored.axes,
        change=stored.change,
    )


def empty_window(config=CONFIG):
    return whole_window(evidence.empty_grid(config).evidence)


def grid_of(window, derived):
    """A grid with the evidence of a whole window, not rounded."""
    stored = Evidence(
        hits=window.hits,
        passes=window.passes,
        behind=window.behind,
        root_weight=jnp.sqrt(window.weight),
        mean=window.mean,
        axes=window.axes,
        change=window.change,
    )
    return Grid(evidence=stored, derived=derived)


def uniform(seed, count, low=BOUNDS[0], high=BOUNDS[1]):
    return np.random.default_rng(seed).uniform(low, high, (count, 3)).astype(np.float32)


def rays_to(ends, sensor, hit=True, noise=CONFIG.range_noise):
    """Rays from the sensor to all ends; `hit` says which of them end on a surface."""
    ends, sensor = np.asarray(ends, np.float32), np.asarray(sensor, np.float32)
    ranges = np.linalg.norm(ends - sensor, axis=1)
    every = np.ones(len(ends), bool)
    return Rays(
        points_world=jnp.asarray(ends),
        directions_world=jnp.asarray((ends - sensor) / ranges[:, None]),
        free_ranges=jnp.asarray(ranges),
        in_range=every,
        ends=every & hit,
        inside=every,
        sigma=jnp.asarray(noise[0] + noise[1] * ranges**2, jnp.float32),
        sensor_world=jnp.asarray(sensor),
    )


def fuse(window, points, sensor=(0.3, 0.5, 0.6), hit=True, config=CONFIG):
    return fuse_hits(config, window, rays_to(points, sensor, hit))


def trace(window, ends, sensor, hit=True, config=CONFIG):
    return trace_rays(config, window, rays_to(ends, sensor, hit))


def anywhere(sensor):
    """The box of rays that may have gone anywhere within range."""
    sensor = jnp.asarray(sensor, jnp.float32)
    return RayBox(sensor, sensor - 100, sensor + 100)


def distance_at(surface, points):
    """The grid's distance and gradient at up to 2,000 points, by one compilation for all tests."""
    padded = np.resize(np.asarray(points, np.float32), (2000, 3))
    value, gradient = grid_sdf_and_grad(surface, padded)
    return np.asarray(value)[: len(points)], np.asarray(gradient)[: len(points)]


def grid_of_room(seeds, half=(0.47, 0.38, 0.29), center=(0.3, 0.5, 0.6)):
    """The grid after exact views of a box room from inside, one for each seed."""
    window = empty_window()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        sensor = np.array(center) + rng.uniform(-0.1, 0.1, 3)
        directions = rng.normal(size=(4000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        reach = (np.array(half) * np.sign(directions) - (sensor - center)) / directions
        ends = sensor + directions * reach.min(axis=1, keepdims=True)
        window = trace(fuse(window, ends.astype(np.float32), sensor), ends, sensor)
    grid = grid_of(window, evidence.empty_grid(CONFIG).derived)
    return update_distances(CONFIG, grid, anywhere(center))
