"""Mapping in a thread: the same map, valid fields, and a planner that never waits."""

import subprocess
import sys
import threading
import time
from pathlib import Path

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
        fused.append(float(cloud[0, 0]))
        begun.set()
        assert go.wait(10)
        return state

    monkeypatch.setattr(background, "update", slow)
    mapper = hio.BackgroundMapper(empty_map)
    pose = np.eye(4)
    mapper.put(np.zeros((1, 3)), pose)
    assert begun.wait(10)
    before = mapper.field
    start = time.perf_counter()
    for k in range(5):
        mapper.put(np.full((1, 3), k + 1), pose)
    assert mapper.field is before  # readable while an update runs
    assert time.perf_counter() - start < 1.0
    assert mapper.dropped == 4
    go.set()
    mapper.close()
    assert fused == [0, 5]
    with pytest.raises(RuntimeError, match="is closed"):
        mapper.put(np.zeros((1, 3)), pose)


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


class Unreadable:
    def __array__(self, *_, **__):
        raise RuntimeError("on another device")


BAD_CLOUDS = {
    "unreadable": Unreadable(),
    "huge numbers": [[10**400, 0, 0]],
    "complex numbers": np.ones((3, 3), complex),
    "words": [["a", "b", "c"]],
    "nothing": None,
    "an object": object(),
}


@pytest.mark.parametrize("cloud", BAD_CLOUDS.values(), ids=BAD_CLOUDS.keys())
def test_a_frame_of_a_wrong_type_is_counted_and_mapping_continues(empty_map, cloud):
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, np.eye(4))
        mapper.wait()
        mapper.put(*stream(1)[0])
    assert mapper.rejected == 1 and mapper.rejection is not None
    assert int(mapper.field.updates) == 1


@pytest.mark.parametrize("stamp", [None, "soon", np.nan, np.inf, 10**400, 1e39])
def test_a_bad_stamp_is_refused_by_put(empty_map, stamp):
    with hio.BackgroundMapper(empty_map) as mapper:
        with pytest.raises(ValueError, match=r"stamp is .*, expected a finite number of seconds"):
            mapper.put(*stream(1)[0], stamp)
        assert mapper.wait() is empty_map


def test_a_mapper_takes_maps_only(empty_map):
    with pytest.raises(ValueError, match="state is Field, expected a MapState"):
        hio.BackgroundMapper(hio.snapshot(empty_map))


ENDINGS = {"end of the script": ("", 0), "exit": ("sys.exit(7)", 7), "exception": ("1 / 0", 1)}


@pytest.mark.parametrize("ending, code", ENDINGS.values(), ids=ENDINGS.keys())
def test_a_mapper_that_is_not_closed_does_not_crash_the_interpreter(ending, code):
    """It works on a frame while the interpreter ends."""
    script = f"""
import sys, time
import jax, jax.numpy as jnp
import hiosdf_jax as hio
from room import CONFIG
from hiosdf_jax._src.mapping import background

@jax.jit
def work(x):
    return jax.lax.fori_loop(0, 300, lambda _, x: jnp.tanh(x @ x), x)

def update(state, cloud, pose):
    for _ in range(10):
        jax.block_until_ready(work(jnp.ones((200, 200))))
    return state

background.update = update
mapper = hio.BackgroundMapper(hio.init(CONFIG, jax.random.key(0)))
for _ in range(3):
    mapper.put(jnp.ones((5, 3)), jnp.eye(4))
    time.sleep(0.2)
{ending}
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=Path(__file__).parent, capture_output=True, timeout=60
    )
    assert done.returncode == code, done.stderr.decode()[-2000:]
