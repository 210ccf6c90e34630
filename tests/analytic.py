"""Maps of scenes whose distances are known in closed form."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.state.pytrees import Baked


def baked(exact_sdf, low, high, resolution, frontier=None):
    """Samples distances to surfaces and to unseen space on a lattice, functions (..., 3) -> (...).

    Without `frontier` everything is observed.
    """
    axes = [
        a + resolution * np.arange(round((b - a) / resolution) + 1)
        for a, b in zip(low, high, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = jnp.array(exact_sdf(points), jnp.float32)
    unseen = np.full(points.shape[:-1], 100) if frontier is None else frontier(points)
    return Baked(
        corner_world=jnp.array(low, jnp.float32),
        resolution=jnp.array(resolution, jnp.float32),
        sdf=values,
        frontier=jnp.array(unseen, jnp.float32),
        lower=values,
        updates=jnp.array(1, jnp.int32),
        stamp=jnp.array(0, jnp.float32),
    )


def half_space(normal, offset, reach=8.0):
    """The map of a solid half space, sdf = normal . p + offset, exact in eight samples."""
    return baked(
        lambda p: p @ np.asarray(normal, float) + offset, [-reach] * 3, [reach] * 3, 2 * reach
    )


def half_spaces(count, seed=0, reach=2.0):
    """Random half spaces: normals (count, 3), offsets (count,) and maps."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = rng.uniform(-reach, reach, count)
    fields = [half_space(n, o) for n, o in zip(normals, offsets, strict=True)]
    return normals, offsets, fields


def count_traces(function):
    """Returns the function, and a list that grows whenever it is traced."""
    traces = []

    def counted(*args, **kwargs):
        traces.append(1)
        return function(*args, **kwargs)

    return counted, traces


def _equations(jaxpr):
    """Yields all equations of a jaxpr, nested ones too, with the equations of their variables."""
    made = {}
    for equation in jaxpr.eqns:
        yield equation, made
        made |= dict.fromkeys(map(id, equation.outvars), equation)
        for part in jax.tree.leaves(
            list(equation.params.values()),
            is_leaf=lambda x: isinstance(x, jex.ClosedJaxpr | jex.Jaxpr),
        ):
            if isinstance(part, jex.ClosedJaxpr | jex.Jaxpr):
                yield from _equations(part.jaxpr if isinstance(part, jex.ClosedJaxpr) else part)


def _source(variable, made):
    """Returns the name of the primitive that computed a variable, apart from its shape."""
    equation = made.get(id(variable))
    while equation is not None and equation.primitive.name in ("broadcast_in_dim", "reshape"):
        equation = made.get(id(equation.invars[0]))
    return equation.primitive.name if equation is not None else ""


def equalities_with_least(function, *arguments):
    """Counts the comparisons of floats with their minimum or maximum in a function's derivative.

    A compiler may compute both sides with different rounding. Then no float is equal: on an H100,
    a tenth of one map's points had the gradient 0.
    """

    def derivative(*arguments):
        value, pull = jax.vjp(function, *arguments)
        return pull(jnp.ones_like(value))

    return sum(
        equation.primitive.name == "eq"
        and jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating)
        and any(_source(v, made) in ("reduce_min", "reduce_max") for v in equation.invars)
        for equation, made in _equations(jax.make_jaxpr(derivative)(*arguments).jaxpr)
    )
