"""An update inside the user's own jit, scan, vmap and donation, each compiled by itself."""

import functools
import itertools
import operator

import jax
import jax.numpy as jnp
import numpy as np
from room import BOUNDS, CONFIG, arrays_equal, check_snapshot_outlives_its_map, stream

import hiosdf_jax as hio
from hiosdf_jax._src.mapping import pipeline

NEAR = np.zeros((5, 3), np.float32)


def closeness(a, b):
    """Largest difference between two maps' answers, m."""
    points = np.random.default_rng(0).uniform(BOUNDS[0], BOUNDS[1], (2000, 3)).astype(np.float32)
    return float(jnp.max(jnp.abs(hio.sdf(a, points) - hio.sdf(b, points))))


def copy_of(state):
    """A map whose memory may be taken."""
    return jax.tree.map(jnp.copy, state)


@functools.partial(jax.jit, donate_argnums=0)
def scanned(state, clouds, poses):
    """Four updates in the user's own jit, which takes the map's memory; one compilation."""

    def step(state, frame):
        state = hio.update(state, *frame)
        return state, (state.report, hio.sdf_and_grad(state, NEAR))

    return jax.lax.scan(step, state, (clouds, poses))


def test_a_scan_in_user_jit_equals_the_eager_loop(empty_map, room_map):
    clouds, poses = (np.stack(part) for part in zip(*stream(), strict=True))
    last, (reports, (values, gradients)) = scanned(copy_of(empty_map), clouds, poses)
    # The cloud is not padded inside jit (250 rows, not 300): the result must not depend on that.
    assert arrays_equal(last.grid.evidence.hits, room_map.grid.evidence.hits)
    assert closeness(last, room_map) < 1e-5
    assert int(last.updates) == 4
    assert reports.points_used.shape == (4,)
    state = empty_map
    for k, frame in enumerate(stream()):
        state = hio.update(state, *frame)
        expected = hio.sdf_and_grad(state, NEAR)
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


def test_bad_input_inside_jit_only_raises_a_sticky_flag(room_map):
    empty, bad = hio.Flag.EMPTY_CLOUD, hio.Flag.BAD_POSE
    nothing, scaled = np.full((250, 3), np.nan), np.diag([2.0, 2, 2, 1])
    clouds, poses, flags = zip(
        (nothing, np.eye(4), empty),
        (np.ones((250, 3)), np.full((4, 4), np.nan), bad),
        (np.ones((250, 3)), scaled, bad),
        (nothing, scaled, bad | empty),
        strict=True,
    )
    arrays = (np.stack(part).astype(np.float32) for part in (clouds, poses))
    after, (reports, _) = scanned(copy_of(room_map), *arrays)
    assert reports.update_flags.tolist() == list(flags)
    so_far = list(itertools.accumulate(flags, operator.or_))
    assert reports.flags.tolist() == so_far
    last = room_map.report.replace(flags=jnp.uint32(so_far[-1]), update_flags=jnp.uint32(flags[-1]))
    assert arrays_equal(after, room_map.replace(report=last))
    later = hio.update(after, *stream(1)[0])
    assert hio.Flag(later.report.flags) == so_far[-1]
    assert int(later.report.update_flags) == 0


def test_snapshot_is_independent_of_a_donated_map(empty_map):
    def donate(state, cloud, pose):
        scanned(state, np.stack([cloud] * 4), np.stack([pose] * 4))
        assert state.grid.evidence.hits.is_deleted()

    check_snapshot_outlives_its_map(empty_map, donate)


def test_a_cloud_without_rows_is_flagged_inside_jit(room_map, monkeypatch):
    """What a user's jit traces, with one small stage of fusion: a whole update takes longer."""

    def count(step):
        return step._replace(state=step.state.replace(updates=step.state.updates + 1))

    monkeypatch.setattr(pipeline, "FUSION", (count,))
    run = jax.jit(lambda *arguments: pipeline._update(*arguments, None, None, np.uint32(0)))
    fused = run(room_map, *stream(1)[0])
    assert int(fused.updates) == int(room_map.updates) + 1
    after = run(room_map, np.zeros((0, 3), np.float32), np.eye(4, dtype=np.float32))
    flag = jnp.uint32(hio.Flag.EMPTY_CLOUD)
    report = room_map.report.replace(flags=flag, update_flags=flag)
    assert arrays_equal(after, room_map.replace(report=report))
