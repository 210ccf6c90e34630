"""A small function whose programs tests store."""

import typing

import jax
import jax.export
import jax.numpy as jnp

OFFSET = 2.0
TRACES = []


class Pair(typing.NamedTuple):
    first: jax.Array
    second: jax.Array


jax.export.register_namedtuple_serialization(Pair, serialized_name="hiosdf_jax_tests.Pair")
GIVEN = Pair(jnp.arange(3.0), jnp.arange(4))


def scale(x):
    return 3 * x


def example(pair):
    """Adds one to `TRACES` whenever it is traced."""
    TRACES.append(1)
    return Pair(scale(pair.first) + OFFSET, jnp.sum(pair.second))
