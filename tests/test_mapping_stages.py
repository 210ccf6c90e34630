"""The list of stages is what `update` runs."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import pytest
from room import stream

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.stages import STAGES, begin


@pytest.fixture(scope="module")
def program(empty_map):
    """What `update` computes for a usable cloud, as a jaxpr."""
    cloud, pose = (jnp.asarray(array) for array in stream(1)[0])
    checked = jax.make_jaxpr(hio.update)(empty_map, cloud, pose)
    (choice,) = (e for e in checked.eqns if e.primitive.name == "cond")
    return max(choice.params["branches"], key=lambda branch: len(branch.eqns))


def scopes(jaxpr):
    """Yields the named scopes of a jaxpr's equations, and of the jaxprs in them, in order."""
    for equation in jaxpr.eqns:
        yield str(equation.source_info.name_stack)
        for part in jax.tree.leaves(
            list(equation.params.values()),
            is_leaf=lambda x: isinstance(x, jex.ClosedJaxpr | jex.Jaxpr),
        ):
            if isinstance(part, jex.ClosedJaxpr | jex.Jaxpr):
                yield from scopes(part)


def test_update_runs_each_stage_in_a_scope_of_its_name(program):
    names = [stage.__name__ for stage in STAGES]
    found = [scope.partition("/")[0] for scope in scopes(program)]
    assert list(dict.fromkeys(name for name in found if name in names)) == names


def test_update_is_the_stages_one_by_one(program, empty_map):
    """Both are the same program, so their maps are equal bit by bit."""

    def by_hand(state, cloud, finite, pose):
        step = begin(state, cloud, finite, pose)
        for stage in STAGES:
            step = stage(step)
        return step.state

    def text(jaxpr):  # without the mark between constants and arguments
        return " ".join(str(jaxpr).replace(";", "").split())

    cloud, pose = (jnp.asarray(array) for array in stream(1)[0])
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    assert text(program) == text(jax.make_jaxpr(by_hand)(empty_map, cloud, finite, pose))
