"""Windows in which a cloud can have changed distances: they hold all that changes."""

import dataclasses

import numpy as np
import pytest
from room import arrays_equal
from voxels import (
    CONFIG,
    anywhere,
    empty_window,
    fuse,
    grid_of,
    rays_to,
    trace,
    uniform,
    update_distances,
    update_frontier,
)

from hiosdf_jax._src.grid import evidence, windows
from hiosdf_jax._src.grid.rays import HIDDEN_VOXELS


@pytest.mark.parametrize(
    ("voxel", "max_range", "horizons", "box", "axis", "shapes"),
    [
        (0.1, 0.5, (0.6, 0.4), (6.0, 1.0, 1.0), 0, [41, 47]),
        # 2 + 0.8 + 0.4 + 0.2 + 0.4 m is, rounded, not more than 19 voxels of 0.2 m.
        (0.2, 2.0, (0.4, 0.4), (24.0, 4.0, 4.0), 0, [31, 41]),
        # The two long axes tie in the small window, and not in the grid.
        (0.1, 0.5, (0.6, 0.4), (6.0, 4.5, 1.0), 0, [41, 47]),
        (0.1, 0.5, (0.6, 0.4), (1.0, 6.0, 1.0), 1, [41, 47]),
    ],
)
def test_a_window_gives_the_result_of_a_full_recomputation(
    voxel, max_range, horizons, box, axis, shapes
):
    scale = max_range / 0.5
    small = dataclasses.replace(
        CONFIG,
        voxel_size=voxel,
        bounds=((0.0, 0.0, 0.0), box),
        max_range=max_range,
        distance_horizon=horizons[0],
        frontier_horizon=horizons[1],
    )
    large = dataclasses.replace(small, max_range=100.0)
    # The first two recompute all that any cloud can have changed, the last what this one has.
    configs, fits = (small, large, small), set()
    seen, derived = empty_window(small), [evidence.empty_grid(small).derived] * 3
    for x, spread in ((0.5, 0.2), (2.0, 0.25), (3.3, 0.35), (2.2, 0.1), (0.9, 0.15)):
        sensor = np.array(box) / 2
        sensor[axis] = scale * x
        ends = sensor + scale * uniform(int(10 * x), 60, (-spread,) * 3, (spread,) * 3)
        # Some look one way; none reaches farther than the range.
        ends[:, axis] += scale * (spread + 0.05 if spread <= 0.2 else 0.1)
        ends = ends.astype(np.float32)
        box_of_cloud = windows.box_of_rays(rays_to(ends, sensor))
        half, whole, fit = windows.place_windows(small, box_of_cloud, horizons[0])
        assert [half.shape[axis], whole.shape[axis]] == shapes
        fits.add(bool(fit))
        boxes = (anywhere(sensor), anywhere(sensor), box_of_cloud)
        seen = trace(fuse(seen, ends, sensor, config=small), ends, sensor, config=small)
        for k, config in enumerate(configs):
            grid = update_distances(config, grid_of(seen, derived[k]), boxes[k])
            derived[k] = update_frontier(config, grid, boxes[k]).derived
    assert fits == {True, False}
    assert max(shapes) < small.grid_shape[axis]
    assert arrays_equal(derived[0], derived[1])
    assert arrays_equal(derived[2], derived[1])


def test_the_small_window_is_for_rays_that_reach_half_the_range_along_no_axis():
    sensor = np.array([0.23, 0.51, 0.62])
    config = dataclasses.replace(CONFIG, bounds=((-3,) * 3, (3,) * 3), max_range=1.0)
    for axis in range(3):
        for reach, fits in ((0.9, True), (1.1, False)):
            ends = np.tile(sensor, (5, 1)) + 0.01
            ends[:, axis] += np.linspace(0.5, reach, 5)  # the sensor is outside the ends' box
            box = windows.box_of_rays(rays_to(ends, sensor))
            np.testing.assert_allclose(box.low_world, sensor, atol=1e-6)
            small, large, fit = windows.place_windows(config, box, 0.3)
            assert bool(fit) is fits
            window = small if fits else large
            first, size = np.array(window.inner_start), np.array(window.inner_shape)
            # All that lies within the horizon of the rays and of what they hide can change.
            reach = 0.3 + 0.1 * HIDDEN_VOXELS
            assert (3 + box.low_world - reach >= 0.1 * first - 1e-6).all()
            assert (3 + box.high_world + reach <= 0.1 * (first + size) + 1e-6).all()
            assert (np.array(window.within) >= 3).all()
            assert (np.add(window.within, size) + 3 <= window.shape).all()
