"""Mapping in a thread: the same map, valid fields, and a planner that never waits."""

import threading
import time

import numpy as np
import pytest
from room import stream

import hiosdf_jax as hio
from hiosdf_jax._src.mapping import background

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)).astype(np.float32)


def test_the_map_is_that_of_a_plain_loop(empty_map):
    expected = empty_map
    with hio.BackgroundMapper(empty_map) as mapper:
        for k, (cloud, pose) in enumerate(stream(3)):
            mapper.put(cloud, pose, stamp=0.5 * k)
            state = mapper.wait()
            expected = hio.update(expected, cloud, pose)
            assert float(mapper.field.stamp) == 0.5 * k
            assert int(mapper.field.updates) == k + 1
            np.testing.assert_array_equal(hio.sdf(mapper.field, POINTS), hio.sdf(expected, POINTS))
    assert mapper.dropped == 0
    np.testing.assert_array_equal(state.grid.evidence.hits, expected.grid.evidence.hits)


def test_the_newest_frame_replaces_the_waiting_one(empty_map, monkeypatch):
    begun, go = threading.Event(), threading.Event()
    fused = []

    def slow(state, cloud, pose):
        fused.append(cloud)
        begun.set()
        assert go.wait(10)
        return state

    monkeypatch.setattr(background, "update", slow)
    mapper = hio.BackgroundMapper(empty_map)
    mapper.put("first", None)
    assert begun.wait(10)
    before = mapper.field
    start = time.perf_counter()
    for k in range(5):
        mapper.put(k, None)
    assert mapper.field is before  # readable while an update runs
    assert time.perf_counter() - start < 1.0
    assert mapper.dropped == 4
    go.set()
    mapper.close()
    assert fused == ["first", 4]
    with pytest.raises(RuntimeError, match="is closed"):
        mapper.put(5, None)


def test_a_bad_frame_is_counted_and_mapping_continues(empty_map):
    cloud, pose = stream(1)[0]
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, np.full((4, 4), np.nan))
        mapper.wait()
        mapper.put(cloud, pose)
    assert mapper.rejected == 1
    assert "pose has values that are not finite" in str(mapper.rejection)
    assert int(mapper.field.updates) == 1


def test_a_failure_of_the_thread_is_raised_in_the_caller(empty_map, monkeypatch):
    def broken(*_):
        raise OSError("no device")

    monkeypatch.setattr(background, "update", broken)
    mapper = hio.BackgroundMapper(empty_map)
    mapper.put(*stream(1)[0])
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.wait()
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.put(*stream(1)[0])
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.close()
