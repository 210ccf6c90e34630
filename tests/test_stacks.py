"""What JAX can be set to and combined with: each row works, or says what to do.

One device suffices: the types of arrays in a mesh do not depend on the number of devices.
"""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from room import arrays_equal, stream

import hiosdf_jax as hio
from hiosdf_jax import planning

POINTS = np.random.default_rng(0).uniform(-0.8, 0.8, (8, 3)).astype(np.float32)
RADII = np.full(8, 0.05, np.float32)
ROWS = PartitionSpec("rows")
KINDS = ["map", "baked"]


@pytest.fixture(scope="module")
def fields(room_map):
    return {"map": hio.snapshot(room_map), "baked": hio.bake(room_map, 0.1)}


def swept(field, points):
    return planning.swept_clearance(field, points, points + jnp.float32(0.1), RADII)


def obstacle(field, points):
    return hio.sdf(field, points, unknown="obstacle")


def everything(field, points):
    """Traces every query and clearance."""
    centers = jnp.stack([points, points])
    data = planning.BodyPoses(points, jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32), (8, 3, 3)))
    spheres = planning.RobotSpheres(jnp.arange(8, dtype=jnp.int32), points, RADII)
    return (
        hio.query(field, points, unknown="obstacle"),
        planning.swept_clearance_and_grad(field, points, points, RADII, bound="lower"),
        planning.sphere_clearance_and_grad(field, centers, RADII),
        planning.collision_cost(planning.sphere_clearance(field, centers, 0.1), margin_m=0.1),
        planning.robot_clearance(field, spheres, data),
        planning.optimize_trajectory(field, centers, radius_m=0.1, steps=2),
    )


def updated(state, cloud, pose):
    robot = jnp.zeros((2, 3), jnp.float32), jnp.full(2, 0.1, jnp.float32)
    return hio.update(state, cloud, pose, robot=robot, noise=(jnp.float32(0.01), jnp.float32(0)))


# --- Meshes of devices ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("function", [obstacle, swept], ids=["sdf", "swept"])
def test_explicit_axes_as_make_mesh_has_them(fields, kind, function):
    mesh = jax.make_mesh((1,), ("rows",))
    assert mesh.axis_types == (AxisType.Explicit,)
    placed = jax.device_put(POINTS, NamedSharding(mesh, ROWS))
    value = function(fields[kind], placed)
    assert jax.typeof(value).sharding.spec == ROWS
    np.testing.assert_allclose(value, function(fields[kind], POINTS), atol=1e-5)


def test_gradients_with_explicit_axes(fields):
    mesh = jax.make_mesh((1,), ("rows",))
    placed = jax.device_put(POINTS, NamedSharding(mesh, ROWS))
    slope = jax.jit(jax.grad(lambda points, field: obstacle(field, points).sum()))
    gradient = slope(placed, fields["baked"])
    assert jax.typeof(gradient).sharding.spec == PartitionSpec("rows", None)
    np.testing.assert_allclose(gradient, slope(POINTS, fields["baked"]), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_shard_map_with_its_checks(fields, kind):
    mesh = jax.make_mesh((1,), ("rows",), axis_types=(AxisType.Auto,))
    specs = {"in_specs": (PartitionSpec(), ROWS), "out_specs": ROWS}
    sharded = jax.jit(jax.shard_map(swept_of_points, mesh=mesh, **specs))
    np.testing.assert_allclose(
        sharded(fields[kind], POINTS), swept_of_points(fields[kind], POINTS), atol=1e-5
    )


def swept_of_points(field, points):
    return planning.swept_clearance(field, points, points + jnp.float32(0.1), 0.05)


def test_shard_map_of_an_update_and_of_a_trajectory(empty_map, fields):
    """Types alone: a compilation takes long, and has nothing to add."""
    mesh = jax.make_mesh((1,), ("maps",), axis_types=(AxisType.Auto,))
    one = PartitionSpec("maps")

    def update(maps, clouds, poses):
        state = updated(jax.tree.map(lambda leaf: leaf[0], maps), clouds[0], poses[0])
        return jax.tree.map(lambda leaf: leaf[None], state)

    maps = jax.tree.map(lambda leaf: leaf[None], empty_map)
    cloud, pose = (jnp.asarray(part)[None] for part in stream(1)[0])
    sharded = jax.shard_map(update, mesh=mesh, in_specs=(one, one, one), out_specs=one)
    after = jax.eval_shape(sharded, maps, cloud, pose)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, maps)

    def plan(field, path):
        return planning.optimize_trajectory(field, path, radius_m=0.1, steps=2).clearance

    planned = jax.shard_map(plan, mesh=mesh, in_specs=(PartitionSpec(), one), out_specs=one)
    assert jax.eval_shape(planned, fields["baked"], POINTS[None]).shape == (1,)


# --- Ahead of time ---


@pytest.mark.parametrize("kind", KINDS)
def test_export_with_an_open_number_of_points(fields, kind):
    pytest.importorskip("flatbuffers", reason="jax.export writes with it")
    field = fields[kind]
    (rows,) = jax.export.symbolic_shape("rows")
    points = jax.ShapeDtypeStruct((rows, 3), jnp.float32)
    written = jax.export.export(jax.jit(obstacle))(field, points).serialize()
    called = jax.export.deserialize(written).call
    np.testing.assert_allclose(called(field, POINTS), obstacle(field, POINTS), atol=1e-5)
    other = jax.tree.map(lambda leaf: leaf, field)
    np.testing.assert_allclose(called(other, POINTS[:3]), obstacle(other, POINTS[:3]), atol=1e-5)


def test_export_of_a_whole_map_and_of_named_results(room_map, fields):
    pytest.importorskip("flatbuffers", reason="jax.export writes with it")
    written = jax.export.export(jax.jit(lambda state: state))(room_map).serialize()
    state = jax.export.deserialize(bytearray(written)).call(room_map)
    assert state.config == room_map.config and arrays_equal(state, room_map)
    query = jax.jit(lambda field: hio.query(field, POINTS))
    written = jax.export.export(query)(fields["baked"]).serialize()
    answer = jax.export.deserialize(bytearray(written)).call(fields["baked"])
    assert isinstance(answer, hio.Query)


def test_lowered_and_compiled_ahead_of_time(fields):
    compiled = jax.jit(obstacle).lower(fields["baked"], POINTS).compile()
    np.testing.assert_allclose(
        compiled(fields["baked"], POINTS), obstacle(fields["baked"], POINTS), atol=1e-6
    )


# --- Modes ---


@pytest.mark.parametrize("mode", ["rank", "dtype"])
@pytest.mark.parametrize("kind", KINDS)
def test_strict_promotion(fields, kind, mode, empty_map):
    contexts = {
        "rank": jax.numpy_rank_promotion("raise"),
        "dtype": jax.numpy_dtype_promotion("strict"),
    }
    cloud, pose = stream(1)[0]
    with contexts[mode]:
        jax.eval_shape(everything, fields[kind], POINTS)
        jax.eval_shape(jax.grad(lambda points: obstacle(fields[kind], points).sum()), POINTS)
        planning.sphere_clearance(fields[kind], POINTS[None], RADII)
        if kind == "map":
            jax.eval_shape(lambda field: hio.bake(field, 0.1), fields[kind])
            jax.eval_shape(updated, empty_map, cloud, pose)
            jax.eval_shape(hio.moving_rows, empty_map, cloud, pose)


@pytest.mark.parametrize("kind", KINDS)
def test_the_transfer_guard_sees_no_implicit_transfer(fields, kind, empty_map):
    def run():
        hio.sdf(fields[kind], POINTS)
        hio.query(fields[kind], jnp_points)
        planning.sphere_clearance(fields[kind], POINTS, 0.1)
        planning.collision_cost(RADII, margin_m=0.2)
        hio.snapshot(empty_map, stamp=1.0)
        return hio.update(empty_map, *stream(1)[0])

    jnp_points = jnp.asarray(POINTS)
    run()
    with jax.transfer_guard("disallow"):
        run()


@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_float32_with_x64(fields, kind, empty_map):
    with jax.enable_x64(True):
        shapes = jax.eval_shape(everything, fields[kind], jnp.asarray(POINTS, jnp.float64))
        kinds = {leaf.dtype.name for leaf in jax.tree.leaves(shapes)}
        assert kinds == {"float32", "bool"}
        after = jax.eval_shape(hio.update, empty_map, *map(jnp.asarray, stream(1)[0]))
    same = jax.tree.map(lambda a, b: a.dtype == b.dtype, after, empty_map)
    assert all(jax.tree.leaves(same))


# --- Derivatives by the map, and other libraries' files ---


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_by_the_float_leaves_of_a_map(fields, kind):
    field = fields[kind]
    floats = field.differentiable()
    assert {leaf.dtype.kind for leaf in jax.tree.leaves(floats)} == {"f"}
    assert arrays_equal(field.combine(floats), field)

    @jax.jit
    @jax.value_and_grad
    def loss(floats, rest):
        return jnp.sum(hio.sdf(rest.combine(floats), POINTS) ** 2)

    value, gradient = loss(floats, field)
    assert jax.tree.structure(gradient) == jax.tree.structure(floats)
    step = jax.tree.map(lambda x, g: x - (1e-3 * g).astype(x.dtype), floats, gradient)
    assert loss(step, field)[0] < value


def test_gradients_by_a_whole_map_need_allow_int(fields):
    def total(field):
        return hio.sdf(field, POINTS).sum()

    with pytest.raises(TypeError, match="allow_int"):
        jax.grad(total)(fields["baked"])
    gradient = jax.grad(total, allow_int=True)(fields["baked"])
    assert np.abs(gradient.sdf).max() > 0 and gradient.updates.dtype == jax.dtypes.float0


def test_flax_writes_and_reads_a_map(room_map, empty_map):
    read = serialization.from_bytes(empty_map, serialization.to_bytes(room_map))
    assert arrays_equal(read, room_map)
    assert jax.random.key_impl(read.key) == jax.random.key_impl(room_map.key)


def test_ravel_takes_the_float_leaves(fields):
    flat, back = jax.flatten_util.ravel_pytree(fields["baked"].differentiable())
    assert flat.ndim == 1
    assert arrays_equal(fields["baked"].combine(back(flat)), fields["baked"])


# --- Stacks of maps ---


@pytest.mark.parametrize("kind", KINDS)
def test_a_stack_of_maps_is_refused_with_a_word_on_vmap(fields, kind):
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), fields[kind])
    for function in (hio.sdf, hio.query, hio.sdf_and_grad, swept):
        with pytest.raises(ValueError, match=r"expected those of one map.* jax\.vmap"):
            function(stack, POINTS)
    both = jax.vmap(hio.sdf, in_axes=(0, None))(stack, POINTS)
    np.testing.assert_allclose(both[1], hio.sdf(fields[kind], POINTS), atol=1e-5)


def test_a_stack_of_maps_is_refused_by_update_and_bake(empty_map):
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), empty_map)
    with pytest.raises(ValueError, match=r"state .* jax\.vmap"):
        hio.update(stack, *stream(1)[0])
    with pytest.raises(ValueError, match=r"field .* jax\.vmap"):
        hio.bake(hio.snapshot(stack))


@pytest.mark.parametrize(
    "call, name",
    [
        (lambda field: hio.snapshot(field), "state is Baked"),
        (lambda field: hio.grow(field, ((0, 0, 0), (1, 1, 1))), "state is Baked"),
        (lambda field: hio.extract_mesh(field), "field is Baked"),
        (lambda field: hio.bake(field), "field is Baked"),
        (lambda field: hio.sdf(3, POINTS), "field is int"),
    ],
)
def test_the_wrong_kind_of_map_is_named(fields, call, name):
    with pytest.raises(ValueError, match=name):
        call(fields["baked"])
