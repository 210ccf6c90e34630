"""Functions of points and tables: XLA, and the kernel for GPUs interpreted on a CPU."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import clear, interpret_point_kernels, lowered
from voxels import uniform

from hiosdf_jax._src.numerics import devices, point_kernel
from hiosdf_jax._src.numerics.point_kernel import by_points, sum_by_points
from hiosdf_jax._src.numerics.vectors import take

TABLES = {
    "height": jnp.sin(jnp.arange(40.0)).astype(jnp.float16).reshape(5, 8),
    "slope": jnp.cos(jnp.arange(120.0)).reshape(40, 3),
    "kind": (jnp.arange(40) % 3).astype(jnp.int8),
}
COUNT = 300  # no multiple of a block


def looked_up(scale, tables, point):
    """A function with all that lookups have: tables of several types, masks, sums over eight."""
    number = jax.lax.broadcasted_iota(jnp.int32, (8, *[1] * point[0].ndim), 0)
    cell = jnp.floor(scale * point[0] + 20).astype(jnp.int32) + number
    height = tables["height"].ravel()[cell].astype(jnp.float32)
    x, y, z = take(tables["slope"], cell)
    part = jnp.where(tables["kind"][cell] == 1, 0, height + x * point[0] + y * point[1] ** 2 * z)
    return {"mean": jnp.mean(part, axis=0), "least": jnp.min(part, axis=0)}


def turned(static, tables, numbers, point, mask):
    """A function with numbers and masks, and vectors as results."""
    x, y, z = point
    return (numbers[0] * x - numbers[1] * y, numbers[1] * x + numbers[0] * y, z), mask[0] & (x > 0)


@pytest.fixture
def interpreted(monkeypatch):
    """Runs the kernels on the CPU."""
    yield interpret_point_kernels(monkeypatch)
    clear()


def points_of(*axes):
    return jnp.asarray(uniform(0, int(np.prod(axes)))).reshape(*axes, 3)


def exact(points):
    """The function, and its gradients, one point after another."""
    one = functools.partial(looked_up, 7.0, TABLES)
    flat = points.reshape(-1, 3)
    values = [one(tuple(point)) for point in flat]
    gradients = [jax.jacrev(lambda point: one(tuple(point)))(point) for point in flat]

    def stack(trees):
        return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)

    return stack(values), stack(gradients)


def assert_close(found, expected, atol=1e-6):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=atol), found, expected
    )


def test_values_and_gradients_are_those_point_by_point(interpreted):
    points = points_of(20)
    values, gradients = exact(points)
    evaluate = functools.partial(by_points, looked_up, 7.0, TABLES)
    assert_close(jax.jit(evaluate)(points), values)
    one_by_one = jax.jit(jax.vmap(jax.jacrev(evaluate)))
    assert_close(one_by_one(points), gradients, atol=1e-5)
    _, tangents = jax.jvp(evaluate, (points,), (jnp.ones_like(points),))
    assert_close(tangents, jax.tree.map(lambda leaf: leaf.sum(-1), gradients), atol=1e-5)


def by_both(monkeypatch, evaluate, *arguments):
    """A result by the kernel, and by XLA."""
    by_kernel = jax.jit(lambda *arguments: evaluate(*arguments))(*arguments)
    monkeypatch.setattr(devices, "has_kernels", lambda: False)
    return by_kernel, jax.jit(lambda *arguments: evaluate(*arguments))(*arguments)


def test_few_points_run_the_kernel_in_these_tests(interpreted):
    evaluate = functools.partial(by_points, looked_up, 7.0, TABLES)
    assert "pallas_call" in str(jax.make_jaxpr(evaluate)(points_of(3)))


@pytest.mark.parametrize("axes", [(COUNT,), (3, 50), (2, 3, 25)])
def test_points_may_have_any_axes(monkeypatch, interpreted, axes):
    found, expected = by_both(
        monkeypatch, functools.partial(by_points, looked_up, 7.0, TABLES), points_of(*axes)
    )
    assert found["mean"].shape == axes
    assert_close(found, expected)


@pytest.mark.parametrize("each", ["numbers", "points", "both", "nested"])
def test_groups_of_points_have_numbers_of_their_own(monkeypatch, interpreted, each):
    masks = jnp.arange(50) % 4 > 0
    groups = {"numbers": (0, None), "points": (None, 0), "both": (0, 0), "nested": (0, 0)}[each]
    numbers = jnp.asarray(uniform(1, 3))[:, :2] if groups[0] == 0 else jnp.float32([0.6, 0.8])
    points = points_of(3, 50) if groups[1] == 0 else points_of(50)

    def turn(numbers, points):
        return by_points(turned, None, TABLES, points, masks[:, None], numbers=numbers)

    evaluate = jax.vmap(turn, groups)
    if each == "nested":
        evaluate = jax.vmap(evaluate)
        numbers, points = (jnp.stack([array, 2 * array]) for array in (numbers, points))
    found, expected = by_both(monkeypatch, evaluate, numbers, points)
    assert found[0].shape == points.shape[: -2 if groups[1] == 0 else 0] + (
        (50, 3) if groups[1] == 0 else (3, 50, 3)
    )
    assert found[1].dtype == bool
    assert_close(found, expected)


def test_several_sets_of_tables_are_left_to_xla(monkeypatch, interpreted):
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), TABLES)
    evaluate = jax.vmap(functools.partial(by_points, looked_up, 7.0), (0, None))
    found, expected = by_both(monkeypatch, evaluate, both, points_of(COUNT))
    assert_close(found, expected)


def test_derivatives_by_tables_and_numbers(monkeypatch, interpreted):
    points = points_of(40)

    def total(slope, numbers):
        tables = TABLES | {"slope": slope}
        looked = by_points(looked_up, 7.0, tables, points)
        vectors, _ = by_points(
            turned, None, tables, points, jnp.ones((40, 1), bool), numbers=numbers
        )
        return looked["mean"].sum() + (vectors**2).sum()

    derive = jax.grad(total, (0, 1))
    found, expected = by_both(monkeypatch, derive, TABLES["slope"], jnp.float32([0.6, 0.8]))
    assert float(jnp.abs(expected[0]).max()) > 0
    assert_close(found, expected, atol=1e-4)


def summed(static, tables, numbers, point):
    """A function whose sums are wanted."""
    height = tables["height"].ravel()[jnp.floor(8 * point[0] + 20).astype(jnp.int32)]
    return numbers[0] * point[0] + height, point[1] * point[2], jnp.ones_like(point[0])


@pytest.mark.parametrize("few", [0, 10**6])
@pytest.mark.parametrize("groups", [None, 3])
def test_sums_are_those_of_all_points(monkeypatch, interpreted, groups, few):
    monkeypatch.setattr(point_kernel, "_FEW", few)
    points = points_of(1100)  # more than the threads of a block add up
    numbers = jnp.float32([0.5]) if groups is None else jnp.float32([[0.5], [1.0], [-1.5]])

    def total(numbers):
        return sum_by_points(summed, None, TABLES, points, numbers=numbers)

    found = jax.jit(total if groups is None else jax.vmap(total))(numbers)
    exact = np.asarray(points, float)
    cell = np.floor(8 * exact[:, 0] + 20).astype(int)
    height = np.asarray(TABLES["height"], float).ravel()[cell]
    for one, number in zip(np.atleast_2d(found), np.atleast_2d(numbers), strict=True):
        expected = [(number * exact[:, 0] + height).sum(), (exact[:, 1] * exact[:, 2]).sum(), 1100]
        np.testing.assert_allclose(one, expected, rtol=1e-5, atol=1e-3)
    slope = jax.jacfwd(lambda number: total(number[None]))(jnp.float32(0.5))
    np.testing.assert_allclose(slope, [exact[:, 0].sum(), 0, 0], rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("dtype", [jnp.int8, jnp.float16, jnp.float32, jnp.int32])
@pytest.mark.parametrize("size", [(41, 3), (40, 5), (16, 9), (13, 9)])
def test_vectors_are_gathered_from_any_table(interpreted, dtype, size):
    rng = np.random.default_rng(0)
    table = jnp.asarray(rng.integers(-127, 128, size) / 1, dtype)
    first = size[1] - 3

    def gather(static, table, row):
        return take(table, row[0].astype(jnp.int32), first)

    rows = jnp.arange(size[0], dtype=jnp.float32)[:, None]
    np.testing.assert_array_equal(
        by_points(gather, None, table, rows), table[:, first:].astype(jnp.float32)
    )


def test_shards_are_left_to_xla(monkeypatch, interpreted):
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Auto,))
    spec = jax.sharding.PartitionSpec("x")
    evaluate = jax.shard_map(
        functools.partial(by_points, looked_up, 7.0, TABLES),
        mesh=mesh,
        in_specs=spec,
        out_specs=spec,
    )
    found, expected = by_both(monkeypatch, evaluate, points_of(COUNT))
    assert_close(found, expected)


def test_second_derivatives(monkeypatch, interpreted):
    def mean(point):
        return by_points(looked_up, 7.0, TABLES, point)["mean"]

    found, expected = by_both(monkeypatch, jax.vmap(jax.hessian(mean)), points_of(5))
    assert float(jnp.abs(expected).max()) > 0
    assert_close(found, expected, atol=1e-5)


def test_no_index_reads_beyond_a_table(monkeypatch, interpreted):
    far = points_of(COUNT).at[::2].multiply(1e6).at[::3].set(jnp.nan)
    found = jax.jit(functools.partial(by_points, looked_up, 7.0, TABLES))(far)
    assert found["mean"].shape == (COUNT,)


def test_the_device_is_chosen_when_the_program_is_compiled(monkeypatch):
    def evaluate(points):
        return by_points(looked_up, 7.0, TABLES, points)["mean"]

    points = points_of(COUNT)
    assert "gpu.triton" not in lowered(evaluate, points)
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    assert lowered(lambda points: evaluate(points), points).count("xla.gpu.triton") == 1
    gradient = jax.grad(lambda points: evaluate(points).sum())
    assert lowered(gradient, points).count("xla.gpu.triton") == 1
    assert "gpu.triton" not in lowered(lambda points: evaluate(points), points, platform="cpu")
    assert "gpu.triton" not in lowered(lambda points: evaluate(points), points[:100])
