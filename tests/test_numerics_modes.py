"""A function that is applied only where it is needed, alone and for many elements at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from hiosdf_jax._src.numerics.modes import run_if


def double_if(pred, value, made):
    def double(value):
        jax.debug.callback(lambda: made.append(1))
        return 2 * value

    return run_if(pred, double, value, value)


@pytest.mark.parametrize("needed", [False, True])
def test_alone_it_runs_if_needed(needed):
    made = []
    result = jax.jit(lambda pred, value: double_if(pred, value, made))(needed, jnp.arange(3.0))
    jax.effects_barrier()
    np.testing.assert_array_equal(result, (1 + needed) * np.arange(3.0))
    assert len(made) == needed


def test_under_vmap_it_runs_only_if_any_element_needs_it():
    values = jnp.arange(12.0).reshape(4, 3)
    for needed in (np.zeros(4, bool), np.array([False, True, False, True])):
        made = []
        run = jax.jit(jax.vmap(lambda pred, value, made=made: double_if(pred, value, made)))
        np.testing.assert_array_equal(run(needed, values), (1 + needed[:, None]) * values)
        jax.effects_barrier()
        assert bool(made) == needed.any()


def test_trees_of_other_types_in_a_scan():
    def step(carry, needed):
        flags, count = carry
        carry = run_if(needed, lambda c: (~c[0], c[1] + 1), (flags, count), needed)
        return carry, carry[1]

    start = jnp.array([True, False]), jnp.int32(0)
    (flags, count), counts = jax.lax.scan(step, start, jnp.array([True, False, True, True]))
    np.testing.assert_array_equal(flags, [False, True])
    assert count == 3 and count.dtype == jnp.int32
    np.testing.assert_array_equal(counts, [1, 1, 2, 3])


def test_what_it_reads_may_vary_less_than_its_value_in_shard_map():
    mesh = jax.make_mesh((1,), ("maps",), axis_types=(AxisType.Auto,))
    one, none = PartitionSpec("maps"), PartitionSpec()

    def double(pred, value, factor):
        return run_if(pred[0], lambda _: factor * jnp.ones(1), value, factor)

    sharded = jax.shard_map(double, mesh=mesh, in_specs=(one, one, none), out_specs=one)
    for needed in (True, False):
        result = jax.jit(sharded)(jnp.array([needed]), jnp.zeros(1), jnp.float32(2))
        np.testing.assert_array_equal(result, [2 * needed])


def test_its_result_has_no_derivatives():
    def total(value):
        return jnp.sum(value + run_if(value[0] > 0, lambda v: v * value, value, value))

    np.testing.assert_array_equal(jax.grad(total)(jnp.ones(3)), np.ones(3))
