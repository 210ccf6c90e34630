"""How loops run: steps on a GPU, and all cores of a CPU."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from hiosdf_jax._src.numerics import loops
from hiosdf_jax._src.numerics.modes import varying_like


@pytest.mark.parametrize(
    ("rounds", "step"), [(30, 10), (48, 8), (20, 10), (7, 7), (3, 3), (13, 10)]
)
def test_a_step_on_a_gpu_leaves_few_rounds_over(monkeypatch, rounds, step):
    assert loops.rounds_per_step(rounds) == 1
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert loops.rounds_per_step(rounds) == step


@pytest.mark.parametrize(("size", "shared"), [(1_000_000, True), (100, False)])
def test_large_kernels_of_a_loop_are_shared_by_all_cores(size, shared):
    def double(x):
        def add(k, total):
            k = loops.on_all_cores(k, size)
            return total + (k - 1) * x

        return jax.lax.fori_loop(np.int32(1), np.int32(4), add, jnp.zeros_like(x))

    x = jnp.arange(size, dtype=jnp.float32)
    np.testing.assert_array_equal(jax.jit(double)(x), 3 * x)
    # XLA's mark of a loop that it has compiled to one function, for one core.
    on_one_core = "xla_cpu_small_call" in jax.jit(double).lower(x).compile().as_text()
    assert on_one_core != shared


def test_a_counter_that_is_shared_works_in_vmap_and_with_gradients():
    def power(x, k):
        return jax.lax.fori_loop(0, 3, lambda i, y: y * x * loops.on_all_cores(i + k, 10**6), 1.0)

    x, k = jnp.array([2.0, 3.0]), jnp.array([1, 2])
    np.testing.assert_allclose(jax.vmap(power)(x, k), [8 * 6, 27 * 24])
    np.testing.assert_allclose(jax.vmap(jax.grad(power))(x, k), [12 * 6, 27 * 24])


def test_a_counter_that_is_shared_works_in_shard_map():
    mesh = Mesh(np.array(jax.devices()[:1]), "maps")

    @functools.partial(jax.shard_map, mesh=mesh, in_specs=P("maps"), out_specs=P("maps"))
    def add(x):
        start = varying_like(jnp.zeros_like(x), x)
        return jax.lax.fori_loop(0, 4, lambda k, y: y + x * loops.on_all_cores(k, 10**6), start)

    np.testing.assert_array_equal(jax.jit(add)(jnp.arange(3.0)), [0, 6, 12])
