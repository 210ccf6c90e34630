"""What comes in through the public functions: a documented ValueError, or finite answers."""

import datetime
import decimal
import inspect
import tempfile
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from poses import random_pose
from room import BOUNDS, CONFIG, LARGER_BOUNDS, arrays_equal, room_cloud

import hiosdf_jax as hio
from hiosdf_jax import datasets, planning
from hiosdf_jax._src.numerics.intake import as_array, as_floats, as_number, as_real


class Raises:
    """A foreign array whose conversion fails."""

    def __init__(self, error):
        self.error = error

    def __array__(self, *_, **__):
        raise self.error


TYPES = ["<f2", "<f4", ">f4", "<f8", ">f8", "g", "i1", "u1", ">i2", "<i4", "<i8", "<u8"]


def wrong(values):
    """Things that are no real numbers, of the shape of some values where they have one."""
    flat = values.tolist()
    return [
        None,
        values.astype(complex),
        values.astype(str),
        values.astype("S8"),
        values > 0,
        values.astype(object),
        np.full(values.shape, np.datetime64("2020-01-01")),
        np.full(values.shape, np.timedelta64(1, "s")),
        np.full(values.shape, 10**400),
        np.zeros(values.shape, [("x", "f4")]),
        [[1, 2, 3], [4, 5]],
        [flat, None],
        {"a": 1, 2: "b"},
        {1.5},
        "0.1",
        b"1",
        10**400,
        1j,
        True,
        decimal.Decimal("0.1"),
        datetime.date(2020, 1, 1),
        object(),
        (value for value in (1, 2)),
        jax.random.key(0),
        jnp.zeros(values.shape, complex),
        [jnp.zeros(3), jnp.zeros(2)],
        *(Raises(error("no")) for error in (RuntimeError, AttributeError, KeyError, MemoryError)),
    ]


@st.composite
def numbers(draw, values):
    """Real numbers near some good values: other types, other containers, bad elements."""
    array = np.array(values, np.float64)
    for _ in range(draw(st.integers(0, 2))):
        bad = draw(st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e38, 1e-45, -1.0, 0.0, 1e9]))
        if array.size:
            array.flat[draw(st.integers(0, array.size - 1))] = bad
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        array = array.astype(draw(st.sampled_from(TYPES)))
    kind = draw(st.integers(0, 6))
    if kind == 0:
        mask = draw(st.lists(st.booleans(), min_size=array.size, max_size=array.size))
        return np.ma.array(array, mask=np.reshape(mask, array.shape))
    if kind == 1:
        return array.tolist()
    if kind == 2:
        return jnp.asarray(np.asarray(array, np.float32))
    if kind == 3 and array.ndim:
        return [np.ma.array(row, mask=draw(st.booleans())) for row in array]
    return array


@st.composite
def argument(draw, values):
    """An argument that may be anything; half of them are good or nearly good."""
    values = np.array(values, float)
    kind = draw(st.integers(0, 7))
    if kind < 2:
        return values
    if kind < 5:
        return draw(numbers(values))
    if kind == 5:
        return draw(st.sampled_from([values[None], values[..., None], values.ravel()[:-1]]))
    return draw(st.sampled_from(wrong(values)))


UNKNOWN = st.sampled_from(["network", "obstacle", "network", "free", None, 1, np.zeros(2)])
CLOUD, POSE = room_cloud(3)
POINTS = np.random.default_rng(0).uniform(-1, 1, (5, 3))
SPHERES = planning.RobotSpheres(
    jnp.array([0, 1]), jnp.zeros((2, 3), jnp.float32), jnp.full(2, 0.1, jnp.float32)
)


def call_update(state, draw):
    # Both or none, and as many spheres as in test_mapping_robot_and_noise.py: one compilation.
    spheres, noise = ([[0.5, 0, 0], [0, 0.5, 0]], [0.1, 0.1]), [0.01, 0.001]
    robot = st.sampled_from([5, "ab", (1, 2, 3), {"a": 1, "b": 2}]) | st.tuples(
        *map(argument, spheres)
    )
    values = {"robot": robot, "noise": argument(noise), "": st.just(None)}
    name = draw(st.sampled_from(list(values)))
    extras = {"robot": spheres, "noise": noise, name: draw(values[name])} if name else {}
    cloud, pose = draw(argument(CLOUD)), draw(argument(POSE))
    if draw(st.booleans()):
        return hio.moving_rows(state, cloud, pose, **extras)
    return hio.update(state, cloud, pose, **extras)


def call_query(state, draw):
    function = draw(st.sampled_from([hio.query, hio.sdf, hio.sdf_and_grad]))
    points = draw(
        argument(POINTS) | argument(POINTS[0]) | argument(np.reshape(POINTS[:4], (2, 2, 3)))
    )
    return function(draw(_fields(state)), points, draw(UNKNOWN))


def call_bake(state, draw):
    center = draw(st.none() | argument([0.1, 0, 0]))
    size = draw(st.none() | argument([0.5, 0.5, 0.5]))
    resolution = draw(argument(0.25) | st.sampled_from([0.0, -1.0, 1e-300, 1e-12, np.inf]))
    return hio.bake(draw(_fields(state)), resolution, center, size)


def call_grow(state, draw):
    return hio.grow(draw(_fields(state)), draw(argument(BOUNDS) | argument(LARGER_BOUNDS)))


def call_snapshot(state, draw):
    return hio.snapshot(draw(_fields(state)), draw(argument(1.5)))


def call_mesh(state, draw):
    resolution = draw(argument(0.1) | st.sampled_from([1e-9, 1e-320, 1e300]))
    return np.asarray(hio.extract_mesh(draw(_fields(state)), resolution).vertices)


def call_forget(state, draw):
    return hio.forget(draw(_fields(state)), draw(argument([[0, 0, 0], [0.5, 0.5, 0.5]])))


def call_init(state, draw):
    key = draw(st.sampled_from([jax.random.key(1), jax.random.PRNGKey(1), 1.5, [0, 1], None, "a"]))
    return hio.init(draw(st.sampled_from([CONFIG, None, {}, "light"])), key)


def call_config(state, draw):
    name = draw(st.sampled_from(sorted(set(hio.Config.__dataclass_fields__) - {"bounds"})))
    value = getattr(CONFIG, name)
    config = hio.Config.light(draw(argument(BOUNDS)), **{name: draw(argument(value))})
    hash(config)
    return np.array([*np.ravel(config.bounds), np.ravel(getattr(config, name))[0]], float)


def call_file(state, draw):
    path = draw(st.sampled_from([None, 5, 1.5, b"none", "none.npz", "a\0b", "/dev/zero", ".", []]))
    return hio.load(path)


def call_save(state, draw):
    places = [
        "map.npz",
        "map.npz",
        ".",
        "none/map.npz",
        "a\0b",
        "/dev/full",
        "x" * 300,
        "",
        None,
        5,
    ]
    chosen = draw(_fields(state))
    with tempfile.TemporaryDirectory() as folder:
        place = draw(st.sampled_from(places))
        path = f"{folder}/{place}" if place in places[:4] else place
        hio.save(path, chosen)
        assert arrays_equal(hio.load(path), state)
    assert path == f"{folder}/map.npz" and chosen is state


def call_clearance(state, draw):
    function = draw(
        st.sampled_from([planning.sphere_clearance, planning.sphere_clearance_and_grad])
    )
    radii = draw(argument(0.1) | argument(np.full(5, 0.1)))
    return function(draw(_fields(state)), draw(argument(POINTS)), radii, draw(UNKNOWN))


def call_sweep(state, draw):
    start, end = draw(argument(POINTS)), draw(argument(POINTS + 0.1))
    slope, evaluations = draw(argument(1.1)), draw(st.sampled_from([9, 9, 1, 2.0, None, "9"]))
    return planning.swept_clearance(
        draw(_fields(state)), start, end, 0.1, slope=slope, evaluations=evaluations
    )


def call_waves(state, draw):
    count, waypoints = draw(st.sampled_from([2, 0, 2.5, None])), draw(st.sampled_from([4, 1, "4"]))
    ends = draw(argument(POINTS[0])), draw(argument(POINTS[1]))
    spread = draw(argument(0.2))
    paths = planning.waves(jax.random.key(0), *ends, count, waypoints, spread)
    return None if not all(np.isfinite(as_floats("end", end)).all() for end in ends) else paths


def call_robot(state, draw):
    poses = planning.BodyPoses(
        draw(argument(np.zeros((2, 3)))), draw(argument(np.tile(np.eye(3), (2, 1, 1))))
    )
    data = draw(st.sampled_from([poses, poses, None, 5]))
    spheres = draw(st.sampled_from([SPHERES, SPHERES, None, (1, 2)]))
    return planning.robot_clearance(draw(_fields(state)), spheres, data)


def call_image(state, draw):
    if draw(st.booleans()):
        cloud = datasets.depth_to_cloud(draw(argument(np.ones((3, 4)))), draw(argument(np.eye(3))))
    else:
        rays = draw(argument(np.ones(5))), draw(argument(np.tile([1.0, 0, 0], (5, 1))))
        cloud = datasets.ranges_to_cloud(*rays)
    return None if cloud is not None else cloud  # rows that are not returns are NaN


def _fields(state):
    """The map, mostly; or what is none."""
    return st.sampled_from([0, 0, 0, 0, 0, None, CONFIG, 5]).map(lambda x: state if x == 0 else x)


CALLS = [value for name, value in sorted(globals().items()) if name.startswith("call_")]


class Known:
    """A map and its copy, which hypothesis does not print."""

    def __init__(self, state):
        self.state, self.before = state, jax.tree.map(jnp.copy, state)


@pytest.fixture(scope="module")
def known(room_map):
    return Known(room_map)


def check_call(known, data):
    """Makes one call; it must give finite answers, or a ValueError, and keep the map."""
    state = known.state
    call = data.draw(st.sampled_from(CALLS))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            answer = call(state, data.draw)
        except ValueError as error:
            assert str(error)
            answer = None
        except OSError as error:
            assert call in (call_file, call_save) and error.filename is not None
            answer = None
    if isinstance(answer, hio.MapState):
        answer = answer.replace(report=None, key=None)
    for leaf in jax.tree.leaves(answer):
        assert np.isfinite(np.asarray(leaf)).all(), call
    assert arrays_equal(state, known.before)


HEALTH = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]


@settings(max_examples=150, deadline=None, suppress_health_check=HEALTH)
@given(st.data())
def test_any_call_gives_finite_answers_or_a_value_error(known, data):
    check_call(known, data)


@pytest.mark.long
@pytest.mark.parametrize("part", range(10))
@settings(max_examples=400, deadline=None, suppress_health_check=HEALTH)
@given(data=st.data())
def test_thousands_of_calls_give_finite_answers_or_a_value_error(known, part, data):
    check_call(known, data)


@pytest.mark.parametrize("dtype", [*TYPES, jnp.bfloat16])
def test_real_types_of_any_byte_order_come_in(dtype):
    values = np.arange(6).reshape(2, 3).astype(dtype)
    floats = as_floats("points", values)
    assert floats.dtype == np.float32 and floats.dtype.isnative
    np.testing.assert_array_equal(floats, np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(as_array("points", values.tolist()), floats)


@pytest.mark.parametrize("index", range(len(wrong(np.ones((2, 3))))))
def test_other_things_do_not(index):
    values = wrong(np.ones((2, 3)))[index]
    for function in (as_real, as_floats, as_array, as_number):
        with pytest.raises(ValueError, match=r"^points "):
            function("points", values)


def test_masked_elements_are_nan():
    whole = np.ma.array([[1, 2, 3], [4, 5, 6]], mask=[[0, 0, 0], [0, 1, 0]])
    rows = [np.ma.array([1.0, 2, 3]), np.ma.array([4.0, 5, 6], mask=[0, 1, 0])]
    for values in (whole, whole.astype(np.float32), rows):
        np.testing.assert_array_equal(as_floats("cloud", values), [[1, 2, 3], [4, np.nan, 6]])


def test_masked_returns_are_none_and_masked_poses_are_refused(room_map):
    hidden = CLOUD.copy()
    hidden[::2] = 0.1 * hidden[::2]  # what a mask hides must not count
    mask = np.zeros(CLOUD.shape, bool)
    mask[::2, 1] = True
    absent = np.where(mask, np.nan, CLOUD)
    masked = hio.update(room_map, np.ma.array(hidden, mask=mask), POSE)
    assert arrays_equal(masked.grid, hio.update(room_map, absent, POSE).grid)
    with pytest.raises(ValueError, match="pose has values that are not finite"):
        hio.update(room_map, CLOUD, np.ma.array(POSE, mask=POSE == 1))


def test_numbers_that_are_traced_stay_traced(room_map):
    """In arrays, and in lists beside plain numbers."""

    @jax.jit
    def answer(x):
        baked = hio.bake(room_map, 0.25, center=[x, 0.0, 0.0], size=(0.5, 0.5, 0.5))
        swept = planning.swept_clearance(baked, [[x, 0, 0]], [[0, x, 0]], x, slope=1 + x)
        return hio.sdf(baked, (x, x, x)) + planning.collision_cost(swept, margin_m=x).sum()

    eager = hio.sdf(hio.bake(room_map, 0.25, [0.1, 0, 0], (0.5, 0.5, 0.5)), [0.1, 0.1, 0.1])
    assert np.isfinite(answer(0.1))
    assert np.isfinite(eager)
    with pytest.raises(ValueError, match="points has dtype complex64"):
        jax.jit(lambda points: hio.sdf(room_map, points))(jnp.zeros(3, jnp.complex64))
    for argument, function in (
        ("size", lambda x: hio.bake(room_map, 0.25, (0.0, 0, 0), (x, x, x))),
        ("resolution", lambda x: hio.bake(room_map, x)),
        ("box", lambda x: hio.forget(room_map, ((0, 0, 0), (x, x, x)))),
        ("Config.bounds", lambda x: hio.grow(room_map, ((x, x, x), (1, 1, 1)))),
    ):
        with pytest.raises(ValueError, match=f"{argument} is traced, expected concrete"):
            jax.jit(function)(1.0)


def test_a_pose_of_any_type_is_the_same_pose(room_map):
    pose = random_pose(np.random.default_rng(0), 0.1)
    cloud = np.asarray(CLOUD, np.float64)
    first = hio.moving_rows(room_map, cloud, pose)
    for dtype in (">f4", ">f8", "g"):
        again = hio.moving_rows(room_map, cloud.astype(dtype), pose.astype(dtype))
        np.testing.assert_array_equal(again, first)


def test_a_config_that_could_never_map_is_refused():
    for noise in ((1e-300, 0), (1e308, 1e308), (0.01, -1)):
        with pytest.raises(ValueError, match="range_noise"):
            hio.Config.light(BOUNDS, range_noise=noise)
    with pytest.raises(ValueError, match=r"bounds has x .*expected at most 100 km from the origin"):
        hio.Config.light(((1e9, 0, 0), (1e9 + 1, 1, 1)))
    with pytest.raises(ValueError, match="min_hits is 60, expected at most evidence_limit, 50"):
        hio.Config.light(BOUNDS, min_hits=60, evidence_limit=50)


def nested(depth):
    values = [0.0]
    for _ in range(depth):
        values = [values]
    return values


def endless():
    values = [0.0]
    values.append(values)
    return values


@pytest.mark.parametrize(
    "points",
    [
        nested(3000),
        endless(),
        [jnp.float32(0), 10**400, 0],
        [jnp.float32(0), np.ma.masked, 0],
        [jnp.float32(0), True, 0],
        [jnp.zeros(3), Raises(KeyError("foreign"))],
    ],
    ids=["deep", "endless", "huge", "masked", "boolean", "foreign"],
)
def test_lists_that_are_no_arrays_are_refused_and_leave_nothing_behind(empty_map, points):
    with pytest.raises(ValueError, match=r"points|lists are nested"):
        hio.sdf(empty_map, points)
    assert np.isfinite(hio.sdf(empty_map, [0.0, 0.0, 0.0]))


def test_memory_that_is_gone_is_named(empty_map):
    array = jnp.zeros(3)
    array.delete()
    with pytest.raises(ValueError, match="points was donated or deleted"):
        hio.sdf(empty_map, array)
    gone = jax.tree.map(jnp.copy, empty_map)
    for leaf in jax.tree.leaves(gone):
        leaf.delete()
    for call in (lambda: hio.sdf(gone, [0.0, 0, 0]), lambda: hio.snapshot(gone)):
        with pytest.raises(ValueError, match="was donated to an update"):
            call()


def test_a_window_far_away_is_refused(empty_map):
    with pytest.raises(ValueError, match=r"center is .* expected finite coordinates of at most"):
        hio.bake(empty_map, 0.3, [3.4e38, 0, 0], [1, 1, 1])
    far = jax.jit(lambda center: hio.bake(empty_map, 0.3, center, [1, 1, 1]))([3.4e38, 0.0, 0.0])
    assert hio.sdf(far, [0.0, 0, 0]) < 0


@pytest.mark.parametrize("wrong", [-1.0, 0.0, np.nan, np.inf])
def test_traced_margins_and_slopes_that_are_none_never_make_a_collision_free(empty_map, wrong):
    cost = jax.jit(planning.collision_cost)
    assert cost(-0.5, wrong) >= 0.5 and cost(0.05, wrong) > 0
    start, end = jnp.zeros((1, 3)), jnp.full((1, 3), 0.1)
    swept = jax.jit(lambda slope: planning.swept_clearance(empty_map, start, end, 0.1, slope=slope))
    default = inspect.signature(planning.swept_clearance).parameters["slope"].default
    assert (swept(wrong) <= swept(default)).all()
