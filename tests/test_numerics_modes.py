"""A function that is applied only where it is needed, alone and for many elements at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


def test_its_result_has_no_derivatives():
    def total(value):
        return jnp.sum(value + run_if(value[0] > 0, lambda v: v * value, value, value))

    np.testing.assert_array_equal(jax.grad(total)(jnp.ones(3)), np.ones(3))
