"""What JAX can be set to and combined with: each row works, or says what to do.

One device suffices: the types of arrays in a mesh do not depend on the number of devices.

What has failed in users' stacks, and the test of it. Those without a file are in this one.

- jax.grad by MapState, Field or Baked
    test_gradients_by_the_float_leaves_of_a_map
    test_gradients_by_a_whole_map_need_allow_int
- derivatives through update
    test_mapping_gradients.test_the_gradient_equals_finite_differences
    test_mapping_gradients.test_forward_mode_and_scans_are_traced
- jax.make_mesh with Explicit axes
    test_explicit_axes_as_make_mesh_has_them
    test_gradients_with_explicit_axes
- shard_map of swept_clearance, update
    test_shard_map_with_its_checks
    test_shard_map_of_an_update_and_of_a_trajectory
- jax.export, symbolic batch, AOT
    test_export_with_an_open_number_of_points
    test_export_of_a_whole_map_and_of_named_results
    test_an_exported_update_maps_what_update_maps
    test_lowered_and_compiled_ahead_of_time
- rank and dtype promotion, transfer guard
    test_strict_promotion
    test_the_transfer_guard_sees_no_implicit_transfer
- JAX_ENABLE_X64
    test_answers_are_float32_with_x64
- a stacked map without vmap
    test_a_stack_of_maps_is_refused_with_a_word_on_vmap
    test_a_stack_of_maps_is_refused_by_what_takes_one_map
    test_a_stack_of_maps_is_refused_by_what_takes_one_field
    test_the_calls_that_the_messages_name_work
- clouds of many sizes in jit(update)
    test_mapping_input.test_a_padded_cloud_is_what_update_maps
    test_mapping_input.test_pad_cloud_refuses_what_update_refuses
- flax to_bytes, ravel_pytree
    test_flax_writes_and_reads_a_map
    test_ravel_takes_the_float_leaves
- points beyond a baked window
    test_planning_bound.test_outside_a_window_nothing_is_farther_than_the_window_implies
- the lower bound in planning
    test_planning_bound.test_every_clearance_takes_the_bound
    test_planning_bound.test_lower_grad_equals_finite_differences_where_it_is_smooth
- BackgroundMapper: bad frames, exceptions, age
    test_mapping_background.test_a_frame_of_a_wrong_type_is_counted_and_mapping_continues
    test_mapping_background.test_a_bad_stamp_is_refused_by_put
    test_mapping_background.test_an_exception_of_the_controller_is_kept
    test_mapping_background.test_a_failure_can_be_read_without_an_exception
    test_mapping_background.test_the_age_of_the_field_keeps_its_digits
- spheres_from_model: time, bare and static bodies
    test_planning_robot.test_the_time_for_covers_is_limited
    test_planning_robot.test_a_cache_serves_the_same_geoms_and_tolerance_alone
    test_planning_robot.test_moving_bodies_of_models_specifications_and_files
- the wrong kind of map, MjSpec, "1cm"
    test_the_wrong_kind_of_map_is_named
    test_planning_robot.test_a_tolerance_that_is_no_length_is_refused
- planning.mppi, .trajectory
    test_planning_face.test_adapters_are_attributes_and_can_be_imported_by_name
- kinematics not run; radii inside jit
    test_planning_robot.test_poses_before_kinematics_are_refused_and_inside_jit_in_collision
    test_planning_bound.test_inside_jit_a_radius_that_is_none_is_in_collision
- MuJoCo 3
    test_demo_apartment.test_rays_stop_at_the_first_surface
"""

import functools
import re

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from room import CONFIG, arrays_equal, room_cloud, stream

import hiosdf_jax as hio
from hiosdf_jax import exports, planning

COUNT = 2000  # as many as in other tests: one compilation
POINTS = np.random.default_rng(0).uniform(-0.8, 0.8, (COUNT, 3)).astype(np.float32)
RADII = np.full(COUNT, 0.05, np.float32)
ROWS = PartitionSpec("rows")
KINDS = ["map", "baked"]
ONE_OF_THEM = re.escape("for one of them use jax.tree.map(lambda x: x[i], maps)")


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
    turns = jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32), (COUNT, 3, 3))
    data = planning.BodyPoses(points, turns)
    spheres = planning.RobotSpheres(jnp.arange(COUNT, dtype=jnp.int32), points, RADII)
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
    sharded = jax.jit(jax.shard_map(swept, mesh=mesh, **specs))
    np.testing.assert_allclose(
        sharded(fields[kind], POINTS), swept(fields[kind], POINTS), atol=1e-5
    )


def test_shard_map_of_an_update_and_of_a_trajectory(empty_map, fields):
    """Types alone: a compilation takes long, and has nothing to add."""
    mesh = jax.make_mesh((1,), ("maps",), axis_types=(AxisType.Auto,))
    one = PartitionSpec("maps")

    def update(maps, clouds, poses):
        state = updated(jax.tree.map(lambda leaf: leaf[0], maps), clouds[0], poses[0])
        return jax.tree.map(lambda leaf: leaf[None], state)

    maps = jax.tree.map(lambda leaf: leaf[None], empty_map)
    cloud, pose = (jnp.asarray(part)[None] for part in stream(1)[0])
    for theirs in (one, PartitionSpec()):  # a cloud for each map, or one for all
        sharded = jax.shard_map(update, mesh=mesh, in_specs=(one, theirs, theirs), out_specs=one)
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


def test_an_exported_update_maps_what_update_maps(room_map):
    pytest.importorskip("flatbuffers", reason="jax.export writes with it")
    cloud, pose = room_cloud(5)
    cloud, pose = hio.pad_cloud(CONFIG, cloud, pose), np.asarray(pose, np.float32)
    written = jax.export.export(jax.jit(hio.update))(room_map, cloud, pose).serialize()
    update = jax.jit(jax.export.deserialize(bytearray(written)).call)
    assert arrays_equal(update(room_map, cloud, pose), hio.update(room_map, cloud, pose))


def test_lowered_and_compiled_ahead_of_time(fields):
    compiled = jax.jit(obstacle).lower(fields["baked"], POINTS).compile()
    np.testing.assert_allclose(
        compiled(fields["baked"], POINTS), obstacle(fields["baked"], POINTS), atol=1e-6
    )


# --- Modes ---


@pytest.mark.parametrize("kind", KINDS)
def test_strict_promotion(fields, kind, empty_map):
    cloud, pose = stream(1)[0]
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        jax.eval_shape(everything, fields[kind], POINTS)
        jax.eval_shape(jax.grad(lambda points: obstacle(fields[kind], points).sum()), POINTS)
        planning.sphere_clearance(fields[kind], POINTS[None], RADII)
        for one in (hio.query, jax.grad(hio.sdf, 1), jax.jacfwd(jax.grad(obstacle, 1), 1)):
            jax.eval_shape(jax.vmap(one, (None, 0)), fields[kind], POINTS)
            jax.eval_shape(jax.vmap(one), jax.tree.map(lambda x: x[None], fields[kind]), POINTS[:1])
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
        return jnp.sum(hio.sdf(rest.combine(floats), POINTS[:8]) ** 2)

    value, gradient = loss(floats, field)
    assert jax.tree.structure(gradient) == jax.tree.structure(floats)
    # To first order, this step takes away a tenth of the loss.
    leaves = [g.astype(jnp.float32) for g in jax.tree.leaves(gradient)]
    square = sum(float(jnp.sum(g**2)) for g in leaves)
    rate = 0.1 * float(value) / square
    step = jax.tree.map(lambda x, g: x - (rate * g).astype(x.dtype), floats, gradient)
    assert 0.85 * value < loss(step, field)[0] < 0.95 * value


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
    assert isinstance(read.grid.evidence.hits, np.ndarray)
    frame = room_cloud(5)
    assert arrays_equal(hio.update(read, *frame), hio.update(room_map, *frame))


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


def test_a_stack_of_maps_is_refused_by_what_takes_one_map(empty_map, tmp_path):
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), empty_map)
    for function in (hio.update, hio.track, hio.moving_rows):
        call = re.escape(f"2 maps at once use jax.vmap(hio.{function.__name__})(maps, clouds, ")
        with pytest.raises(ValueError, match=f"state .* {call}"):
            function(stack, *stream(1)[0])
    for call in (
        lambda: hio.save(tmp_path / "maps.npz", stack),
        lambda: hio.grow(stack, empty_map.config.bounds),
        lambda: hio.forget(stack, empty_map.config.bounds),
    ):
        with pytest.raises(ValueError, match=rf"state .* {ONE_OF_THEM}"):
            call()
    with pytest.raises(ValueError, match=r"state .* jax\.vmap\(hio\.transform\)\(maps, poses\)"):
        hio.transform(stack, np.eye(4))
    with pytest.raises(ValueError, match=r"^b .* jax\.vmap\(hio\.merge\)\(maps_a, maps_b, poses"):
        hio.merge(empty_map, stack, np.eye(4))


def test_a_stack_of_maps_is_refused_by_what_takes_one_field(empty_map, tmp_path):
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), empty_map)
    exported = functools.partial(exports.export_map, tmp_path / "map.npz")
    costmap = functools.partial(exports.costmap, floor_m=-0.8, height_m=1.0, radius_m=0.2)
    for function in (hio.bake, hio.extract_mesh, hio.view, exported, costmap, exports.voxel_grid):
        call = r"jax\.vmap\(lambda field: hio\.bake" if function == hio.bake else ONE_OF_THEM
        for field in (stack, hio.snapshot(stack)):
            with pytest.raises(ValueError, match=f"field .* {call}"):
                function(field)
        with pytest.raises(ValueError, match="field is dict, expected a MapState or a Field"):
            function({})


def test_the_calls_that_the_messages_name_work(empty_map):
    maps = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), empty_map)
    fields = hio.snapshot(maps)
    assert arrays_equal(jax.tree.map(lambda x: x[1], maps), empty_map)
    clouds, poses = map(jnp.stack, zip(*stream(2), strict=True))
    for function in (hio.update, hio.track, hio.moving_rows):
        jax.eval_shape(jax.vmap(function), maps, clouds, poses)
    jax.eval_shape(jax.vmap(hio.transform), maps, poses)
    jax.eval_shape(jax.vmap(hio.merge), maps, maps, poses)
    jax.eval_shape(jax.vmap(lambda field: hio.bake(field, 0.2)), fields)
    keys = jax.random.split(jax.random.key(0), 2)
    with pytest.raises(ValueError, match=r"key .* 2 of them use jax\.vmap\(functools\.partial"):
        hio.init(empty_map.config, keys)
    made = jax.eval_shape(jax.vmap(functools.partial(hio.init, empty_map.config)), keys)
    assert jax.tree.map(jnp.shape, made) == jax.tree.map(jnp.shape, maps)


@pytest.mark.parametrize("key", [0, np.zeros(3), "0", None])
def test_what_is_no_key_is_refused_with_a_key_that_is(empty_map, key):
    with pytest.raises(ValueError, match=r"key .*expected one key, such as jax\.random\.key\(0\)"):
        hio.init(empty_map.config, key)


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
