"""Sampling-based control by hydrax on maps that change at every step."""

import git_packages
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from analytic import count_traces, half_space, half_spaces
from mujoco import mjx

from hiosdf_jax import planning

BALL = """
<mujoco>
  <worldbody>
    <body>
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(autouse=True)
def hydrax(monkeypatch):
    git_packages.install(monkeypatch, "hydrax")
    import hydrax

    return hydrax


def test_50_maps_compile_once_and_each_takes_effect_at_once(hydrax):
    model = mujoco.MjModel.from_xml_string(BALL)

    def cost(task, state, control):
        return 100 * planning.sphere_clearance(task.field, state.geom_xpos[0], 0.1)

    counted, traces = count_traces(cost)

    class Sink(hydrax.task_base.Task):
        def running_cost(self, state, control):
            return counted(self, state, control)

        def terminal_cost(self, state):
            return 0.0

    task = Sink(model)
    controller = hydrax.algs.MPPI(task, 64, noise_level=0.5, temperature=1.0)
    optimize = planning.hydrax.optimizer(controller)
    state, params = mjx.make_data(model), controller.init_params()
    for normal, offset, field in zip(*half_spaces(50), strict=True):
        (_, mean), rollouts = optimize(state, params, field)
        # Downhill of this map, and the cost is that of its distances.
        assert mean @ normal < -0.2 * np.linalg.norm(mean)
        _, knots = controller.sample(params)
        expected = 100 * (np.asarray(knots, float) @ normal + offset - 0.1)
        np.testing.assert_allclose(rollouts.costs[:, 0], expected, atol=1e-2)
    assert len(traces) == 1
    assert controller.task is task and not hasattr(task, "field")


def test_what_is_no_controller_is_refused():
    with pytest.raises(ValueError, match="controller is a dict, expected a Sampling"):
        planning.hydrax.optimizer({})


def test_the_example_of_the_docstring_runs(hydrax):
    model = mujoco.MjModel.from_xml_string(BALL)
    scope = {"hydrax": hydrax, "jnp": jnp, "mjx": mjx, "model": model, "planning": planning}
    scope["field"] = half_space([0.0, 0.0, 1.0], 1.0)
    exec(git_packages.example_of(planning.hydrax.optimizer), scope)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(scope["rollouts"]))
