"""Controllers on maps that grow scan by scan: compiled once, and right where the map has seen."""

import itertools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import panda_clearance
import pytest
import safety_filter
import scene
import trajectory
from analytic import count_traces

import hiosdf_jax as hio
from hiosdf_jax._src.demo.sensing import map_config

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import frax


@pytest.fixture(scope="module")
def fields():
    """Snapshots after each of the scans."""
    # The room fits into the exploring robot's map, whose update other tests compile too.
    state, rng = hio.init(map_config(), jax.random.key(0)), np.random.default_rng(0)
    snapshots = []
    for position in scene.VIEWPOINTS:
        state = hio.update(state, *scene.scan(np.array(position), 8000, rng))
        snapshots.append(hio.snapshot(state))
    return snapshots


def test_clearance_of_the_panda(fields):
    panda = frax.load_panda()
    q = panda_clearance.draw(panda, 500, np.random.default_rng(0))
    values = [panda_clearance.clearance_and_grad(f, panda, q, panda_clearance.BASE) for f in fields]
    exact = panda_clearance.exact_clearance(panda, q)
    assert ((np.asarray(values[-1][0]) < 0) == (exact < 0)).mean() > 0.97
    assert np.median(np.abs(values[-1][0] - exact)[exact > 0]) < 0.01
    assert np.isfinite(values[-1][1]).all()


def test_the_filter_stops_the_reckless_robot(fields):
    simulate = safety_filter.make_simulator(steps=40)
    rng = np.random.default_rng(0)
    collisions = []
    for field in fields[3:]:
        starts, goals = safety_filter.draw(12, rng, field)
        reckless, filtered = simulate(field, starts, goals)
        assert safety_filter.least_clearance(np.asarray(filtered, float)).min() > 0
        collisions.append(safety_filter.least_clearance(np.asarray(reckless, float)) < 0)
    assert simulate._cache_size() == 1
    assert np.mean(collisions) > 0.5


def test_trajectories_improve_as_the_map_grows(fields):
    start, goal = (jnp.array(p) for p in trajectory.QUERIES[1])
    key, before = jax.random.key(0), trajectory.plan._cache_size()
    paths = [trajectory.plan(f, start, goal, key, count=8) for f in (fields[0], fields[-1])]
    assert trajectory.plan._cache_size() == before + 1
    assert paths[-1].clearance > 0.05
    assert paths[0].clearance < 0  # The goal is unseen.
    assert trajectory.exact_clearance(paths[-1].waypoints_world) > 0.02


def test_a_jitted_function_of_the_map_traces_once(fields):
    counted, traces = count_traces(hio.sdf)
    cost = jax.jit(counted)
    points = np.random.default_rng(0).uniform(*scene.ROOM, (100, 3)).astype(np.float32)
    answers = [np.asarray(cost(field, points)) for field in fields]
    assert len(traces) == 1
    assert all(np.abs(a - b).max() > 0.01 for a, b in itertools.pairwise(answers))
