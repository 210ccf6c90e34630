"""Distances to primitives, against dense surface samples and MuJoCo's own solver."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

mujoco = pytest.importorskip("mujoco")

from hiosdf_jax._src.demo import primitives
from hiosdf_jax._src.demo.primitives import signed_distance

POSITION = np.array([0.3, -0.2, 0.5])
ROTATION = Rotation.from_euler("xyz", [40, -25, 70], degrees=True)
SIZES = {
    "box": (0.3, 0.1, 0.2),
    "sphere": (0.25,),
    "capsule": (0.1, 0.2),
    "cylinder": (0.15, 0.25),
}
KINDS = pytest.mark.parametrize("kind", SIZES)


def compile_model(*geoms):
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>"
    )


def rotated(kind):
    """A geom of this kind with its frame at POSITION, ROTATION."""
    quat = ROTATION.as_quat(scalar_first=True)
    text = {"pos": POSITION, "quat": quat, "size": SIZES[kind]}
    attributes = " ".join(f'{k}="{" ".join(map(repr, map(float, v)))}"' for k, v in text.items())
    return f'<geom name="{kind}" type="{kind}" {attributes}/>'


def random_points(count=2000):
    return POSITION + np.random.default_rng(0).uniform(-0.45, 0.45, (count, 3))


def sample_surface(kind, n=200):
    """Points on the surface, geom frame, at most about 5 mm apart."""
    size = SIZES[kind]
    unit, angle = np.linspace(-1, 1, n), np.linspace(0, 2 * np.pi, 2 * n)

    def grid(a, b):
        return tuple(x.ravel() for x in np.meshgrid(a, b))

    def ball(radius):
        phi, theta = grid(angle, np.linspace(0, np.pi, n))
        x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
        return radius * np.stack([x, y, np.cos(theta)], axis=1)

    def tube(radius, half):
        phi, z = grid(angle, half * unit)
        return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)

    if kind == "box":
        u, v = grid(unit, unit)
        faces = [
            np.insert(np.stack([u, v], axis=1), axis, side, axis=1)
            for axis in range(3)
            for side in (-1, 1)
        ]
        return np.concatenate(faces) * size
    if kind == "sphere":
        return ball(size[0])
    if kind == "capsule":
        shift, caps = np.array([0, 0, size[1]]), ball(size[0])
        caps = np.where(caps[:, 2:] > 0, caps + shift, caps - shift)
        return np.concatenate([caps, tube(*size)])
    phi, r = grid(angle, np.linspace(0, size[0], n))
    disk = np.stack([r * np.cos(phi), r * np.sin(phi), np.full_like(r, size[1])], axis=1)
    return np.concatenate([disk, disk * [1, 1, -1], tube(*size)])


def is_inside(kind, p):
    size = SIZES[kind]
    radial = np.linalg.norm(p[:, :2], axis=1)
    if kind == "box":
        return (np.abs(p) < size).all(axis=1)
    if kind == "sphere":
        return np.linalg.norm(p, axis=1) < size[0]
    if kind == "cylinder":
        return (radial < size[0]) & (np.abs(p[:, 2]) < size[1])
    beyond = np.maximum(np.abs(p[:, 2]) - size[1], 0)
    return np.hypot(radial, beyond) < size[0]


@KINDS
def test_distance_equals_that_to_dense_surface_samples(kind):
    points = random_points()
    sdf, _ = signed_distance(compile_model(rotated(kind)), points)
    local = ROTATION.inv().apply(points - POSITION)
    sampled, _ = cKDTree(sample_surface(kind)).query(local)
    assert (np.abs(sdf) <= sampled + 1e-9).all()
    assert (np.abs(sdf) >= sampled - 0.005).all()
    inside = is_inside(kind, local)
    assert 20 < inside.sum() < 1000
    np.testing.assert_array_equal(sdf < 0, inside)


@KINDS
def test_distance_equals_mujocos(kind):
    radius = 0.01
    probe = f'<body mocap="true"><geom name="probe" type="sphere" size="{radius}"/></body>'
    model = compile_model(rotated(kind), probe)
    data = mujoco.MjData(model)
    solid, probe = model.geom(kind).id, model.geom("probe").id
    points = random_points(300)
    expected = np.empty(len(points))
    for i, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        expected[i] = radius + mujoco.mj_geomDistance(model, data, solid, probe, 10.0, None)
    sdf, _ = signed_distance(compile_model(rotated(kind)), points)
    outside = sdf > radius
    assert outside.sum() > 100
    np.testing.assert_allclose(sdf[outside], expected[outside], atol=1e-5)


@KINDS
def test_gradient_equals_finite_differences(kind):
    model, points, h = compile_model(rotated(kind)), random_points(), 1e-6
    _, grad = signed_distance(model, points)
    differences = np.stack(
        [
            (signed_distance(model, points + e)[0] - signed_distance(model, points - e)[0])
            / (2 * h)
            for e in h * np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(grad, differences, atol=1e-4)


@KINDS
def test_a_step_against_the_gradient_leads_to_the_surface(kind):
    model, points = compile_model(rotated(kind)), random_points()
    sdf, grad = signed_distance(model, points)
    np.testing.assert_allclose(np.linalg.norm(grad, axis=1), 1, atol=1e-12)
    landed, _ = signed_distance(model, points - sdf[:, None] * grad)
    np.testing.assert_allclose(landed, 0, atol=1e-12)


@KINDS
def test_gradients_have_unit_length_on_planes_of_symmetry_and_surfaces(kind):
    size = (*SIZES[kind], 0, 0)[:3]
    axes = np.concatenate([np.zeros((1, 3)), np.diag(size), -np.diag(size)])
    corners = np.array(np.meshgrid(*[(-s, s) for s in size])).reshape(3, -1).T
    local = np.concatenate([axes, corners, corners + 1e-170, 2 * corners])
    model = compile_model(rotated(kind).replace('pos="0.3 -0.2 0.5"', ""))
    sdf, grad = signed_distance(model, ROTATION.apply(local))
    assert np.isfinite(sdf).all()
    np.testing.assert_allclose(np.linalg.norm(grad, axis=1), 1, atol=1e-12)
    # Without a rotation, whose rounding would break the ties.
    still = compile_model(f'<geom type="{kind}" size="{" ".join(map(str, SIZES[kind]))}"/>')
    _, grad = signed_distance(still, local)
    np.testing.assert_allclose(np.linalg.norm(grad, axis=1), 1, atol=1e-12)


def test_union_is_the_minimum_with_the_nearest_geoms_gradient():
    geoms = [
        '<geom type="box" size="0.2 0.2 0.2" pos="-0.1 0 0"/>',
        '<geom type="sphere" size="0.3" pos="0.3 0 0"/>',
    ]
    points = np.random.default_rng(1).uniform(-1, 1, (500, 3))
    each = [signed_distance(compile_model(geom), points) for geom in geoms]
    sdf, grad = signed_distance(compile_model(*geoms), points)
    np.testing.assert_array_equal(sdf, np.minimum(each[0][0], each[1][0]))
    box_wins = each[0][0] < each[1][0]
    assert 0 < box_wins.sum() < 500
    np.testing.assert_array_equal(grad, np.where(box_wins[:, None], each[0][1], each[1][1]))


def test_depth_inside_overlapping_solids_is_never_exaggerated():
    # Two boxes that overlap in a slab and make one box of 4 x 2 x 2, whose exact depth is known.
    halves = ['<geom type="box" size="1.1 1 1" pos="-0.9 0 0"/>']
    halves.append('<geom type="box" size="1.1 1 1" pos="0.9 0 0"/>')
    points = np.random.default_rng(2).uniform(-1, 1, (500, 3)) * [2, 1, 1]
    exact, _ = signed_distance(compile_model('<geom type="box" size="2 1 1"/>'), points)
    bound, _ = signed_distance(compile_model(*halves), points)
    assert (bound < 0).all()
    assert (bound >= exact - 1e-12).all()


def test_bodies_carry_their_geoms():
    geom = '<geom type="box" size="0.1 0.2 0.3" pos="1 0 0"/>'
    nested = compile_model(f'<body pos="0 1 0" euler="0 0 90">{geom}</body>')
    direct = compile_model('<geom type="box" size="0.2 0.1 0.3" pos="0 2 0"/>')
    points = np.random.default_rng(3).uniform(-1, 3, (200, 3))
    for got, expected in zip(
        signed_distance(nested, points), signed_distance(direct, points), strict=True
    ):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_the_chunk_size_changes_nothing(monkeypatch):
    model, points = compile_model(*map(rotated, SIZES)), random_points(1000)
    whole = signed_distance(model, points)
    monkeypatch.setattr(primitives, "_CHUNK", 64)
    for got, expected in zip(signed_distance(model, points), whole, strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-15)


def test_no_points_give_no_distances():
    sdf, grad = signed_distance(compile_model(rotated("box")), np.empty((0, 3)))
    assert sdf.shape == (0,) and grad.shape == (0, 3)


@pytest.mark.parametrize(
    ("kind", "size"), [("ellipsoid", "0.1 0.2 0.3"), ("plane", "1 1 0.1")], ids=lambda x: x
)
def test_other_types_of_geom_are_refused_by_name(kind, size):
    model = compile_model(f'<geom name="egg" type="{kind}" size="{size}"/>')
    with pytest.raises(ValueError, match=rf"egg.*{kind}.*expected box"):
        signed_distance(model, np.zeros((1, 3)))


def test_bad_points_and_empty_models_are_refused():
    with pytest.raises(ValueError, match=r"\(3,\), expected \(N, 3\)"):
        signed_distance(compile_model(rotated("box")), np.zeros(3))
    with pytest.raises(ValueError, match=r"points_world\[1\] .*nan.*expected finite"):
        signed_distance(compile_model(rotated("box")), np.array([[0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises(ValueError, match="0 geoms"):
        signed_distance(compile_model("<body/>"), np.zeros((1, 3)))
