"""The list of stages is what `update` runs: the checks, and the rest if a cloud passes them."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import pytest
from room import stream

import hiosdf_jax as hio
from hiosdf_jax._src.change import vanishing
from hiosdf_jax._src.mapping.stages import (
    CHECKS,
    FUSION,
    STAGES,
    begin,
    is_accepted,
    refuse,
    run_stages,
)
from hiosdf_jax._src.network import training
from hiosdf_jax._src.numerics.robot_and_noise import check_extras


@pytest.fixture(scope="module")
def frame():
    noise = (jnp.float32(0.01), jnp.float32(0.002))  # without it, a stage has nothing to do
    return (*(jnp.asarray(array) for array in stream(1)[0]), *noise)


@pytest.fixture(scope="module")
def program(empty_map, frame):
    """What `update` computes, as a jaxpr: that of the one function that it calls."""

    def update(state, cloud, pose, *noise):
        return hio.update(state, cloud, pose, noise=noise)

    calls = jax.make_jaxpr(update)(empty_map, *frame).eqns
    called = [call.params["jaxpr"] for call in calls if call.params.get("name") == "_update"]
    assert called == [calls[-1].params["jaxpr"]]
    return called[0]


def scopes(equations):
    """Yields the named scopes of equations, and of those in the jaxprs in them, in order."""
    for equation in equations:
        yield str(equation.source_info.name_stack)
        for part in jax.tree.leaves(
            list(equation.params.values()),
            is_leaf=lambda x: isinstance(x, jex.ClosedJaxpr | jex.Jaxpr),
        ):
            if isinstance(part, jex.ClosedJaxpr | jex.Jaxpr):
                yield from scopes(part.eqns)


def stages_in(equations):
    """The stages whose scopes these equations have, in order."""
    names = [stage.__name__ for stage in STAGES]
    found = [scope.partition("/")[0] for scope in scopes(equations)]
    return list(dict.fromkeys(name for name in found if name in names))


def test_update_runs_each_stage_in_a_scope_of_its_name(program):
    assert STAGES == CHECKS + FUSION
    equations = program.eqns
    # The checks have conditions of their own.
    at = max(k for k, e in enumerate(equations) if e.primitive.name == "cond")
    assert stages_in(equations[:at]) == [stage.__name__ for stage in CHECKS]
    assert stages_in(equations[at + 1 :]) == []
    refused, accepted = equations[at].params["branches"]
    assert stages_in(accepted.eqns) == [stage.__name__ for stage in FUSION]
    assert stages_in(refused.eqns) == []


def test_update_is_the_stages_one_by_one(program, empty_map, frame):
    """Both are the same program, so their maps are equal bit for bit."""

    def fused(_, step):
        for stage in FUSION:
            step = stage(step)
        return step.state

    def by_hand(state, cloud, pose, noise, flags_so_far):
        finite = jnp.all(jnp.isfinite(cloud), axis=-1)
        step = begin(state, cloud, finite, pose, noise=noise, flags_so_far=flags_so_far)
        for stage in CHECKS:
            step = stage(step)
        return jax.lax.cond(is_accepted(step), fused, refuse, state, step)

    def text(jaxpr):  # without the mark between constants and arguments
        return " ".join(str(jaxpr).replace(";", "").split())

    cloud, pose, *noise = frame
    _, noise = check_extras(None, noise)
    expected = jax.make_jaxpr(by_hand)(empty_map, cloud, pose, noise, np.uint32(0))
    assert text(program) == text(expected)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_weights_are_averaged_by_the_change_that_the_cloud_saw(
    monkeypatch, empty_map, frame, share
):
    """Marks of changes elsewhere in the map say nothing: they stay until rays pass them."""
    seen = []

    def schedule(config, updates, changed):
        seen.append(changed)
        return jnp.int32(0), jnp.float32(0)

    monkeypatch.setattr(training, "schedule", schedule)
    monkeypatch.setattr(vanishing, "share_of_changes", lambda *_: jnp.float32(share))
    evidence = empty_map.grid.evidence
    marked = jnp.full_like(evidence.change, -72)
    grid = empty_map.grid.replace(evidence=evidence.replace(change=marked))
    state = empty_map.replace(grid=grid)

    def changed(state, cloud, pose):
        seen.clear()
        finite = jnp.ones(len(cloud), bool)
        run_stages(begin(state, cloud, finite, pose), STAGES)
        return seen[0]

    cloud, pose = frame[:2]
    assert float(jax.jit(changed)(state, cloud, pose)) == pytest.approx(share)
