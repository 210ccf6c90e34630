"""Stand-ins for jaxls, pyroki and hydrax, which PyPI does not have: what the adapters call.

They keep the properties that the adapters rely on: jaxls treats functions as static and evaluates a
batch of costs with vmap, pyroki fills up links with spheres without size, and hydrax passes the
controller itself through vmap.
"""

import dataclasses
import functools
import inspect
import sys
import textwrap
from importlib.machinery import ModuleSpec
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.flatten_util import ravel_pytree
from mujoco import mjx

static = functools.partial(struct.field, pytree_node=False)


def install(monkeypatch, *names):
    """Makes the stand-ins importable for one test, and their adapters import them anew."""
    for name in names:
        adapter = f"hiosdf_jax._src.planning.adapters.{name}"
        monkeypatch.setitem(sys.modules, adapter, None)  # forgotten again after the test
        del sys.modules[adapter]
        for path, content in PACKAGES[name].items():
            module = ModuleType(path)
            module.__spec__ = ModuleSpec(path, None, is_package=True)
            module.__path__ = []
            vars(module).update(content)
            monkeypatch.setitem(sys.modules, path, module)
            parent, _, child = path.rpartition(".")
            if parent:
                setattr(sys.modules[parent], child, module)


def example_of(function):
    """The code of the example in a docstring."""
    return textwrap.dedent(inspect.getdoc(function).split("Example:\n")[1].split("\nArgs:")[0])


# --- jaxls ---


class Var:
    """A variable (id ()) or several (id (T,)); a subclass says what their values are."""

    def __class_getitem__(cls, _):
        return cls

    def __init_subclass__(cls, *, default_factory, retract_fn=None, tangent_dim=None):
        size = ravel_pytree(default_factory())[0].size
        cls.tangent_dim = size if tangent_dim is None else tangent_dim
        cls.retract_fn = retract_fn or (lambda value, tangent: value + tangent)
        jax.tree_util.register_dataclass(cls, data_fields=["id"], meta_fields=[])

    def __init__(self, id):
        self.id = id

    def with_value(self, value):
        return self, value


class VarValues(struct.PyTreeNode):
    """The values (T, ...) of the variables 0 to T - 1, all of one kind."""

    kind: type = static()
    stacked: jax.Array

    @staticmethod
    def make(pairs):
        ((variable, value),) = pairs
        return VarValues(type(variable), jnp.asarray(value))

    def __getitem__(self, variable):
        if isinstance(variable, type):
            return self.stacked
        assert isinstance(variable, self.kind)
        return self.stacked[variable.id]


class Cost(struct.PyTreeNode):
    args: tuple
    compute: object = static()
    kind: str = static()
    jacobian: object = static()
    name: str = static()

    @staticmethod
    def factory(compute=None, *, kind="l2_squared", jac_custom_with_cache_fn=None, name=None):
        def decorator(compute):
            return lambda *args: Cost(args, compute, kind, jac_custom_with_cache_fn, name)

        return decorator if compute is None else decorator(compute)


@jax.jit
def evaluate(cost, values):
    """Residuals (T, S) and Jacobians (T, S, tangents) of a batch of costs, None without."""

    def one(args):
        result = cost.compute(values, *args)
        if cost.jacobian is None:
            return result, None
        residual, cache = result
        return residual, cost.jacobian(values, cache, *args)

    return jax.vmap(one)(cost.args)


@dataclasses.dataclass
class LeastSquaresProblem:
    costs: list
    variables: list

    def analyze(self):
        return self

    def solve(self, initial_vals):
        """Gauss-Newton, with a stiff penalty for constraints that are violated."""
        shape = initial_vals.stacked.shape

        def rows(cost, values):
            residual, jacobian = evaluate(cost, values)
            if jacobian is None:
                slope = jax.jacfwd(lambda x: evaluate(cost, values.replace(stacked=x))[0])
                return residual.ravel(), slope(values.stacked).reshape(residual.size, -1)
            (variable,) = cost.args
            own = jax.nn.one_hot(variable.id, shape[0])
            jacobian = jnp.einsum("tsn,tu->tsun", jacobian, own)
            violated = (residual < 0) | (cost.kind == "l2_squared")
            weight = jnp.where(violated, 1.0 if cost.kind == "l2_squared" else 30.0, 0.0)
            jacobian = weight[..., None, None] * jacobian
            return (weight * residual).ravel(), jacobian.reshape(residual.size, -1)

        def step(_, values):
            parts = [rows(cost, values) for cost in self.costs]
            residual, jacobian = (jnp.concatenate(part) for part in zip(*parts, strict=True))
            normal = jacobian.T @ jacobian + 1e-3 * jnp.eye(jacobian.shape[1])
            move = jnp.linalg.solve(normal, -jacobian.T @ residual).reshape(shape)
            return values.replace(stacked=values.stacked + 0.5 * move)

        return jax.lax.fori_loop(0, 60, step, initial_vals)


# --- pyroki ---


class Pose(struct.PyTreeNode):
    matrix: jax.Array  # (..., 4, 4)

    def translation(self):
        return self.matrix[..., :3, 3]


class Sphere(struct.PyTreeNode):
    pose: Pose
    size: jax.Array  # (..., 1)


class Capsule(struct.PyTreeNode):
    pose: Pose
    size: jax.Array  # (..., 2)

    @property
    def height(self):
        return self.size[..., 1]

    @property
    def axis(self):
        return self.pose.matrix[..., :3, 2]


class Box(struct.PyTreeNode):
    pose: Pose
    size: jax.Array


class Robot(struct.PyTreeNode):
    """Links in a row, each turned by one joint about y; the first link does not move."""

    lengths: jax.Array  # (links,)

    def forward_kinematics(self, q):
        """(..., links - 1) -> (..., links, 4, 4)."""
        angles = jnp.cumsum(jnp.concatenate([jnp.zeros((*q.shape[:-1], 1)), q], axis=-1), axis=-1)
        c, s, zero = jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles)
        turn = jnp.stack([c, zero, s, zero, zero + 1, zero, -s, zero, c], axis=-1)
        turn = turn.reshape(*angles.shape, 3, 3)
        ends = jnp.cumsum(self.lengths[:, None] * turn[..., 0], axis=-2)
        starts = jnp.concatenate([jnp.zeros_like(ends[..., :1, :]), ends[..., :-1, :]], axis=-2)
        top = jnp.concatenate([turn, starts[..., None]], axis=-1)
        bottom = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), (*angles.shape, 1, 4))
        return jnp.concatenate([top, bottom], axis=-2)


class RobotCollision(struct.PyTreeNode):
    coll: object
    link_names: tuple = static()

    def at_config(self, robot, q):
        links = robot.forward_kinematics(q)
        own = self.coll.pose.matrix
        if own.ndim == 4:  # several spheres for each link
            links = links[..., None, :, :]
        placed = links @ own
        batch = placed.shape[:-2]
        size = jnp.broadcast_to(self.coll.size, (*batch, self.coll.size.shape[-1]))
        return type(self.coll)(Pose(placed), size)


def at(*centers):
    """Poses with the given positions (..., 3)."""
    poses = np.tile(np.eye(4), (*np.shape(centers)[:-1], 1, 1))
    poses[..., :3, 3] = centers
    return Pose(jnp.asarray(poses, jnp.float32))


# --- hydrax ---


class Trajectory(struct.PyTreeNode):
    costs: jax.Array


class Task:
    def __init__(self, model):
        self.model = mjx.put_model(model)


class SamplingBasedController:
    def __init__(self, task):
        self.task = task

    def optimize(self, state, params):
        key, knots = self.sample(params)
        costs = self.rollouts(state, knots)
        weights = jax.nn.softmax(-costs.sum(axis=1) / self.temperature)
        return (key, weights @ knots), Trajectory(costs)

    @functools.partial(jax.vmap, in_axes=(None, None, 0))
    def rollouts(self, state, knot):
        moved = mjx.kinematics(self.task.model, state.replace(qpos=state.qpos + knot))
        running = self.task.running_cost(moved, knot)
        return jnp.stack([running, self.task.terminal_cost(moved)])


class MPPI(SamplingBasedController):
    def __init__(self, task, num_samples, noise_level, temperature):
        super().__init__(task)
        self.num_samples, self.noise_level = num_samples, noise_level
        self.temperature = temperature

    def init_params(self):
        return jax.random.key(0), jnp.zeros(self.task.model.nq)

    def sample(self, params):
        key, mean = params
        key, own = jax.random.split(key)
        noise = jax.random.normal(own, (self.num_samples, mean.size))
        return key, mean + self.noise_level * noise


PACKAGES = {
    "jaxls": {
        "jaxls": {
            "Cost": Cost,
            "LeastSquaresProblem": LeastSquaresProblem,
            "Var": Var,
            "VarValues": VarValues,
        }
    },
    "pyroki": {
        "pyroki": {"Robot": Robot},
        "pyroki.collision": {
            "Capsule": Capsule,
            "RobotCollision": RobotCollision,
            "Sphere": Sphere,
        },
    },
    "hydrax": {
        "hydrax": {},
        "hydrax.alg_base": {
            "SamplingBasedController": SamplingBasedController,
            "Trajectory": Trajectory,
        },
        "hydrax.algs": {"MPPI": MPPI},
        "hydrax.task_base": {"Task": Task},
    },
}
"""Package -> its modules -> their contents."""
