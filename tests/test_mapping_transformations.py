"""An update inside the user's own jit, scan, vmap and donation, each compiled by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, CONFIG, arrays_equal, check_snapshot_outlives_its_map, stream

import hiosdf_jax as hio
from hiosdf_jax._src.mapping import pipeline


def closeness(a, b):
    """Largest difference between two maps' answers, m."""
    points = np.random.default_rng(0).uniform(BOUNDS[0], BOUNDS[1], (500, 3)).astype(np.float32)
    return float(jnp.max(jnp.abs(hio.sdf(a, points) - hio.sdf(b, points))))


# Compiled once, for all tests of an update in the user's own jit.
donating = jax.jit(hio.update, donate_argnums=0)


def test_a_scan_in_user_jit_equals_the_eager_loop(empty_map, room_map):
    clouds, poses = (jnp.stack(part) for part in zip(*stream(), strict=True))
    points = jnp.zeros((5, 3))

    @jax.jit
    def scanned(state, clouds, poses):
        def step(state, frame):
            state = hio.update(state, *frame)
            return state, (state.report, hio.sdf_and_grad(state, points))

        return jax.lax.scan(step, state, (clouds, poses))

    last, (reports, (values, gradients)) = scanned(empty_map, clouds, poses)
    # The cloud is not padded inside jit (250 rows, not 300): the result must not depend on that.
    assert arrays_equal(last.grid.evidence.hits, room_map.grid.evidence.hits)
    assert closeness(last, room_map) < 1e-5
    assert int(last.updates) == 4
    assert reports.points_used.shape == (4,)
    state = empty_map
    for k, frame in enumerate(stream()):
        state = hio.update(state, *frame)
        expected = hio.sdf_and_grad(state, points)
        np.testing.assert_allclose(values[k], expected[0], atol=1e-5)
        np.testing.assert_allclose(gradients[k], expected[1], atol=1e-4)


def test_vmap_over_two_maps_equals_each(empty_map):
    other = hio.init(CONFIG, jax.random.key(1))
    frames = stream(2)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), empty_map, other)
    clouds, poses = (jnp.stack(part) for part in zip(*frames, strict=True))
    together = jax.jit(jax.vmap(hio.update))(both, clouds, poses)
    for k, state in enumerate((empty_map, other)):
        alone = hio.update(state, *frames[k])
        part = jax.tree.map(lambda leaf, k=k: leaf[k], together)
        assert arrays_equal(part.grid.evidence.hits, alone.grid.evidence.hits)
        assert arrays_equal(part.grid.evidence.passes, alone.grid.evidence.passes)
        assert closeness(part, alone) < 1e-4


@pytest.mark.parametrize(
    "cloud, pose, flag",
    [
        (np.full((250, 3), np.nan), np.eye(4), hio.Flag.EMPTY_CLOUD),
        (np.ones((250, 3)), np.full((4, 4), np.nan), hio.Flag.BAD_POSE),
        (np.ones((250, 3)), np.diag([2.0, 2, 2, 1]), hio.Flag.BAD_POSE),
        (
            np.full((250, 3), np.nan),
            np.diag([2.0, 2, 2, 1]),
            hio.Flag.BAD_POSE | hio.Flag.EMPTY_CLOUD,
        ),
    ],
)
def test_bad_input_inside_jit_only_raises_a_sticky_flag(room_map, cloud, pose, flag):
    copy = jax.tree.map(jnp.copy, room_map)
    after = donating(copy, jnp.asarray(cloud, jnp.float32), jnp.asarray(pose, jnp.float32))
    assert hio.Flag(int(after.report.flags)) == flag
    flagged = room_map.report.replace(flags=jnp.uint32(flag), update_flags=jnp.uint32(flag))
    assert arrays_equal(after, room_map.replace(report=flagged))
    later = hio.update(after, *stream(1)[0])
    assert hio.Flag(int(later.report.flags)) == flag
    assert int(later.report.update_flags) == 0


def test_snapshot_is_independent_of_a_donated_map(empty_map):
    check_snapshot_outlives_its_map(empty_map, donating)


def test_a_cloud_without_rows_is_flagged_inside_jit(room_map):
    # What a user's jit traces, run operation by operation: to compile a whole update takes longer.
    with jax.disable_jit():
        after = pipeline._update(room_map, jnp.zeros((0, 3)), jnp.eye(4), None, None, np.uint32(0))
    assert int(after.report.flags) & hio.Flag.EMPTY_CLOUD
    assert arrays_equal(after.grid, room_map.grid)
