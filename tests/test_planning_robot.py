"""A robot as spheres: complete covers that protrude little, placed as MuJoCo places the geoms."""

import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from analytic import equalities_with_least, half_space
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco import mjx
from scipy.spatial import KDTree

from hiosdf_jax import planning
from hiosdf_jax._src.planning.robot import cover, solids
from hiosdf_jax.demo import signed_distance

TOLERANCE = 0.03
EGG = np.array([0.1, 0.06, 0.04])

ARM = """
<mujoco>
  <default><geom contype="1" conaffinity="0"/></default>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .2 0 0  0 .15 0  .2 .15 0  0 0 .1  0 .15 .1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="base" pos=".1 -.2 .3" euler="0 0 40">
      <geom name="stand" type="cylinder" size=".08 .15" pos="0 0 -.15"/>
      <body name="upper" pos="0 0 .05">
        <joint name="turn" axis="0 0 1"/>
        <joint name="lift" axis="0 1 0"/>
        <geom name="bone" type="capsule" fromto="0 0 0 .3 0 .1" size=".04"/>
        <geom name="look" type="box" size="1 1 1" contype="0" conaffinity="0"/>
        <body name="lower" pos=".3 0 .1">
          <joint name="bend" axis="0 1 0" pos="0 0 .01"/>
          <geom name="beam" type="box" size=".15 .03 .05" pos=".15 0 0" euler="20 0 0"/>
          <geom name="egg" type="ellipsoid" size=".1 .06 .04" pos=".3 0 0" euler="0 30 10"/>
          <body name="hand" pos=".35 0 0">
            <joint name="twist" axis="1 0 0"/>
            <geom name="ball" type="sphere" size=".06"/>
            <geom name="finger" type="mesh" mesh="wedge" pos=".1 0 0" euler="0 0 25"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(ARM)


@pytest.fixture(scope="module")
def alone(model):
    return {name: planning.spheres_from_model(model, TOLERANCE, geoms=[name]) for name in GEOMS}


@pytest.fixture(scope="module")
def spheres(model):
    return planning.spheres_from_model(model, TOLERANCE)


def exact_distance(name, geom_xml):
    """Signed distance to a geom in its own frame, by code independent of the covers."""
    if geom_xml is not None:
        alone = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{geom_xml}</worldbody></mujoco>"
        )
        return lambda points: signed_distance(alone, points)[0]
    if name == "egg":
        solid = trimesh.creation.icosphere(3)
        solid.apply_scale(EGG)
    else:
        compiled = mujoco.MjModel.from_xml_string(ARM)
        solid = trimesh.Trimesh(compiled.mesh_vert, compiled.mesh_face, process=False)
    return lambda points: distance_to_convex(solid, points)


def distance_to_convex(solid, points):
    """Signed distance by all face planes and, outside, the closest points of all triangles."""
    heights = points @ solid.face_normals.T - np.sum(
        solid.face_normals * solid.triangles[:, 0], axis=1
    )
    value = heights.max(axis=1)
    outside = value > 0
    least = np.full(outside.sum(), np.inf)
    for triangle in solid.triangles:
        repeated = np.broadcast_to(triangle, (len(least), 3, 3))
        closest = trimesh.triangles.closest_point(repeated, points[outside])
        least = np.minimum(least, np.linalg.norm(points[outside] - closest, axis=1))
    value[outside] = least
    return value


GEOMS = {  # as in ARM, at the origin; largest number of spheres
    "stand": ("<geom type='cylinder' size='.08 .15'/>", 25),
    "bone": (f"<geom type='capsule' size='.04 {np.hypot(0.3, 0.1) / 2}'/>", 4),
    "beam": ("<geom type='box' size='.15 .03 .05'/>", 12),
    "egg": (None, 10),
    "ball": ("<geom type='sphere' size='.06'/>", 1),
    "finger": (None, 45),
}


@pytest.mark.parametrize("name", GEOMS)
def test_spheres_cover_a_geom_and_protrude_at_most_the_tolerance(model, alone, name):
    geom, spheres = model.geom(name), alone[name]
    xml, most = GEOMS[name]
    distance = exact_distance(name, xml)
    # Back to the geom's own frame, by MuJoCo's arithmetic.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, geom.quat)
    centers = (np.asarray(spheres.centers_body, float) - geom.pos) @ rotation.reshape(3, 3)
    radii = np.asarray(spheres.radii, float)
    assert (spheres.body == geom.bodyid[0]).all()
    assert len(radii) <= most

    # Dense points inside the solid, and points moved out to its surface by bisection.
    rng = np.random.default_rng(0)
    box = model.geom_aabb[geom.id]
    low, high = box[:3] - box[3:], box[:3] + box[3:]
    points = rng.uniform(low, high, (10_000, 3))

    def is_in(points):
        return np.sum((points / EGG) ** 2, axis=1) <= 1 if name == "egg" else distance(points) <= 0

    inside, outside = points[is_in(points)], points[~is_in(points)]
    assert len(inside) > 2000
    outside = rng.permutation(outside)[: len(inside)]
    near, far = inside[: len(outside)].copy(), outside[: len(inside)].copy()
    for _ in range(12):
        middle = (near + far) / 2
        solid = is_in(middle)[:, None]
        near, far = np.where(solid, middle, near), np.where(solid, far, middle)
    corners = low + (high - low) * np.array(list(np.ndindex(2, 2, 2)))
    corners = corners[is_in(corners * (1 - 1e-9))]
    covered = np.concatenate([inside, near, corners])
    room = np.linalg.norm(covered[:, None] - centers, axis=2) - radii
    assert room.min(axis=1).max() <= 1e-6

    # Dense points on the spheres are within the tolerance of the solid.
    directions = trimesh.creation.icosphere(3).vertices
    outline = (centers[:, None] + radii[:, None, None] * directions).reshape(-1, 3)
    farthest = distance(outline[:: max(1, len(outline) // 2000)]).max()
    assert farthest <= TOLERANCE + (4e-4 if name == "egg" else 1e-6)  # an inscribed polyhedron
    assert farthest > 0.4 * TOLERANCE or name == "ball"


def test_bodies_and_geoms_are_chosen_by_name_or_id(model, alone, spheres):
    # By default the colliding geoms of what can move, in order: neither the base nor "look".
    moving = [part for name, part in alone.items() if name != "stand"]
    together = jax.tree.map(lambda *parts: np.concatenate(parts), *moving)
    jax.tree.map(np.testing.assert_array_equal, spheres, together)
    every = planning.spheres_from_model(model, TOLERANCE, bodies=range(1, model.nbody))
    together = jax.tree.map(lambda *parts: np.concatenate(parts), *alone.values())
    jax.tree.map(np.testing.assert_array_equal, every, together)
    assert [leaf.dtype for leaf in jax.tree.leaves(spheres)] == [
        jnp.int32,
        jnp.float32,
        jnp.float32,
    ]
    hand = model.body("hand").id
    for bodies in (["hand"], [hand], np.array([hand])):
        chosen = planning.spheres_from_model(model, TOLERANCE, bodies=bodies)
        assert set(np.asarray(chosen.body).tolist()) == {hand}
        assert len(chosen.radii) == len(alone["ball"].radii) + len(alone["finger"].radii)
    by_id = planning.spheres_from_model(model, TOLERANCE, geoms=[model.geom("bone").id])
    jax.tree.map(np.testing.assert_array_equal, by_id, alone["bone"])


def test_an_mjx_model_gives_the_same_spheres(model, alone):
    found = planning.spheres_from_model(mjx.put_model(model), TOLERANCE, bodies=["upper", "hand"])
    expected = jax.tree.map(
        lambda *parts: np.concatenate(parts), *(alone[name] for name in ("bone", "ball", "finger"))
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), found, expected)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"geoms": ["floor"]}, r"geom 0 \('floor'\) is of type plane"),
        ({"bodies": ["world"]}, r"geom 0 \('floor'\) is of type plane"),
        ({"geoms": ["nose"]}, "no geom 'nose'"),
        ({"bodies": ["leg"]}, "no body 'leg', expected one of .*'upper'"),
        ({"bodies": [17]}, "no body 17, expected 0 to 4"),
        ({"bodies": "hand"}, "string 'hand'"),
        ({"bodies": []}, "no geom is chosen"),
        ({"bodies": ["hand"], "geoms": ["ball"]}, "both"),
        ({"tolerance_m": 0.0}, "tolerance_m is 0.0"),
        ({"tolerance_m": float("nan")}, "tolerance_m is nan"),
    ],
)
def test_bad_choices_are_refused(model, arguments, words):
    with pytest.raises(ValueError, match=words):
        planning.spheres_from_model(model, **({"tolerance_m": TOLERANCE} | arguments))


@settings(max_examples=40, deadline=None)
@given(st.floats(0.005, 0.3), st.floats(0, 1), st.floats(0.003, 0.1))
def test_rows_of_spheres_cover_any_capsule(radius, half_length, tolerance):
    centers, radii = cover.cover_capsule(radius, half_length, tolerance)
    # On the axis a sphere protrudes by the difference of the radii.
    assert (centers[:, :2] == 0).all()
    assert (np.abs(centers[:, 2]) <= half_length).all()
    assert (radii <= radius + tolerance + 1e-12).all()
    # The outline: sides and a cap, by the angle from the axis.
    angle = np.linspace(0, np.pi / 2, 200)
    z = np.concatenate([np.linspace(0, half_length, 2000), half_length + radius * np.cos(angle)])
    out = np.concatenate([np.full(2000, radius), radius * np.sin(angle)])
    room = np.hypot(out[:, None], z[:, None] - centers[:, 2]) - radii
    assert room.min(axis=1).max() <= 1e-9
    # No larger than needed: the cover touches the outline between spheres and at the ends.
    assert room.min(axis=1)[-200:].max() >= -1e-9
    if len(radii) > 1:
        assert room.min(axis=1)[:2000].max() >= -1e-3
    # With one sphere fewer the largest allowed radius would not suffice.
    if len(radii) > 1:
        reach = np.sqrt((radius + tolerance) ** 2 - radius**2)
        assert 2 * (half_length - tolerance) > (len(radii) - 2) * 2 * reach - 1e-9


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0.01, 0.3), min_size=3, max_size=3), st.floats(0.015, 0.1))
def test_lattices_of_spheres_cover_any_box(half, tolerance):
    half = np.array(half)
    centers, radii = cover.cover_box(half, tolerance)
    assert (np.abs(centers) <= half).all()
    assert (radii - (half - np.abs(centers)).min(axis=1)).max() <= tolerance + 1e-9
    rng = np.random.default_rng(0)
    inside = rng.uniform(-half, half, (1500, 3))
    faces = inside[:750].copy()
    axis = rng.integers(3, size=750)
    faces[np.arange(750), axis] = half[axis] * rng.choice([-1, 1], 750)
    corners = half * np.array(list(np.ndindex(2, 2, 2))) * 2 - half
    points = np.concatenate([inside, faces, corners])
    room = np.linalg.norm(points[:, None] - centers, axis=2) - radii
    assert room.min(axis=1).max() <= 1e-9


def test_the_distance_to_an_ellipsoid_equals_that_to_a_fine_mesh():
    solid = trimesh.creation.icosphere(4)
    solid.apply_scale(EGG)
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [rng.uniform(-0.12, 0.12, (100, 3)), np.zeros((1, 3)), np.diag(EGG) / 2]
    )
    least, greatest = solids.ellipsoid(EGG).distance(points)
    np.testing.assert_array_equal(least, greatest)
    np.testing.assert_allclose(least, distance_to_convex(solid, points), atol=3e-4)


def test_the_bounds_of_the_distance_to_a_mesh_hold():
    compiled = mujoco.MjModel.from_xml_string(ARM)
    vertices, faces = compiled.mesh_vert.astype(float), compiled.mesh_face
    points = np.random.default_rng(2).uniform(-0.2, 0.2, (3000, 3))
    exact = distance_to_convex(trimesh.Trimesh(vertices, faces, process=False), points)
    solid = solids.mesh(vertices, faces, TOLERANCE)
    least, greatest = solid.distance(points)
    assert (least <= exact + 1e-9).all()
    assert (exact <= greatest + 1e-9).all()
    assert (greatest - least).max() < 0.5 * TOLERANCE
    # The quick bounds are wider far from the surface.
    least, greatest = solid.quick(points)
    assert (least <= exact + 1e-9).all()
    assert (exact <= greatest + 1e-9).all()
    in_box = np.all((points >= vertices.min(axis=0)) & (points <= vertices.max(axis=0)), axis=1)
    assert (greatest - least)[in_box].max() < TOLERANCE
    assert (greatest - least)[np.abs(exact) < TOLERANCE / 16].max() < 0.5 * TOLERANCE
    # Without one face it encloses nothing: no point is inside a sheet.
    sheet = solids.mesh(vertices, faces[1:], TOLERANCE)
    assert (sheet.distance(points)[1] >= 0).all()
    assert (sheet.quick(points)[1] >= 0).all()


def test_the_hole_of_a_ring_stays_open():
    ring = trimesh.creation.torus(0.12, 0.03, major_sections=64, minor_sections=32)
    vertices, faces = np.asarray(ring.vertices), np.asarray(ring.faces)

    def distance(points):  # of the torus around the mesh, at most 0.3 mm away
        radial = np.hypot(points[:, 0], points[:, 1]) - 0.12
        return np.hypot(radial, points[:, 2]) - 0.03

    solid = solids.mesh(vertices, faces, TOLERANCE)
    centers, radii = cover.cover_solid(solid, *ring.bounds, TOLERANCE)
    outline = centers[:, None] + radii[:, None, None] * trimesh.creation.icosphere(2).vertices
    assert distance(outline.reshape(-1, 3)).max() <= TOLERANCE
    points = np.random.default_rng(4).uniform(*ring.bounds, (30_000, 3))
    points = np.concatenate([points[distance(points) < -4e-4], vertices])
    room = np.linalg.norm(points[:, None] - centers, axis=2) - radii
    assert room.min(axis=1).max() <= 1e-9
    assert len(radii) <= 20


NORMAL, OFFSET = np.array([0.48, -0.6, 0.64]), 0.5
CONFIGURATIONS = np.random.default_rng(3).uniform(-1.2, 1.2, (6, 4)).astype(np.float32)


def mujoco_centers(model, spheres, joints):
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_kinematics(model, data)
    centers = [
        data.xpos[body] + data.xmat[body].reshape(3, 3) @ center
        for body, center in zip(spheres.body, np.asarray(spheres.centers_body, float), strict=True)
    ]
    return np.array(centers), data


def test_spheres_are_placed_where_mujoco_has_the_bodies(model, spheres):
    for joints in CONFIGURATIONS[:2]:
        expected, data = mujoco_centers(model, spheres, joints)
        np.testing.assert_allclose(planning.place_spheres(spheres, data), expected, atol=1e-6)
    poses = planning.BodyPoses(np.stack([data.xpos] * 2), np.stack([data.xmat] * 2))
    placed = jax.jit(planning.place_spheres)(spheres, poses)
    np.testing.assert_allclose(placed, np.stack([expected] * 2), atol=1e-6)
    # The ball's center is where MuJoCo has the geom.
    ball = np.asarray(spheres.radii) == np.float32(0.06)
    assert ball.sum() == 1
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.geom("ball").xpos, np.asarray(placed)[0, ball][0], atol=1e-6)


def test_robot_clearance_and_its_gradient_through_mjx(model, spheres):
    moving = np.asarray(spheres.body) > model.body("base").id
    spheres = jax.tree.map(lambda array: array[moving], spheres)
    simulated = mjx.put_model(model)
    start = mjx.make_data(simulated)

    def clearance(field, joints):
        data = mjx.kinematics(simulated, start.replace(qpos=joints))
        return planning.robot_clearance(field, spheres, data)

    field = half_space(NORMAL, OFFSET)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(clearance, 1), (None, 0)))(
        field, CONFIGURATIONS
    )

    def reference(joints):
        centers, _ = mujoco_centers(model, spheres, joints)
        return np.min(centers @ NORMAL + OFFSET - np.asarray(spheres.radii, float))

    expected = [reference(joints) for joints in CONFIGURATIONS]
    np.testing.assert_allclose(values, expected, atol=1e-5)
    step = 1e-5
    for axis in range(4):
        shift = step * np.eye(4)[axis]
        numeric = [
            (reference(q + shift) - reference(q - shift)) / (2 * step) for q in CONFIGURATIONS
        ]
        np.testing.assert_allclose(slopes[:, axis], numeric, atol=2e-4)
    assert np.abs(slopes).max() > 0.1
    assert equalities_with_least(lambda q: clearance(field, q), jnp.asarray(CONFIGURATIONS[0])) == 0


def test_bad_poses_are_refused(model, spheres):
    xpos, xmat = np.zeros((5, 3)), np.zeros((5, 3, 3))
    for poses, words in (
        (planning.BodyPoses(xpos[:3], xmat[:3]), "3 bodies, expected more than 4"),
        (planning.BodyPoses(xpos[:, :2], xmat), r"xpos has shape \(5, 2\)"),
        (planning.BodyPoses(xpos, xmat[:4]), r"xmat has shape \(4, 3, 3\), expected \(5, 3, 3\)"),
    ):
        with pytest.raises(ValueError, match=words):
            planning.place_spheres(spheres, poses)


TWO_BODIES = """
<mujoco>
  <worldbody>
    <body name="post" pos="1 0 0"><geom type="box" size="0.1 0.1 0.5"/></body>
    <body name="arm">
      <joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.05"/>
      <body name="shell" pos="0 0 0.5">
        <joint axis="1 0 0"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <geom type="sphere" size="0.1" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_moving_bodies_of_models_specifications_and_files(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(TWO_BODIES)
    model = mujoco.MjModel.from_xml_string(TWO_BODIES)
    arm = model.body("arm").id
    found = []
    for source in (model, mujoco.MjSpec.from_string(TWO_BODIES), path, str(path)):
        with pytest.warns(UserWarning, match=r"bodies \['shell'\] have geoms but none that coll"):
            found.append(planning.spheres_from_model(source, 0.01))
    for spheres in found:
        assert set(np.asarray(spheres.body).tolist()) == {arm}
        np.testing.assert_array_equal(spheres.centers_body, found[0].centers_body)
    every = planning.spheres_from_model(model, 0.01, bodies=["post", "arm"])
    assert model.body("post").id in np.asarray(every.body)


@pytest.mark.parametrize("tolerance", ["1cm", None, True, 0, -0.1, np.nan, 1j])
def test_a_tolerance_that_is_no_length_is_refused(tolerance):
    model = mujoco.MjModel.from_xml_string(TWO_BODIES)
    with pytest.raises(ValueError, match=r"tolerance_m (is|has) .*, expected"):
        planning.spheres_from_model(model, tolerance)
    with pytest.raises(ValueError, match="model is int, expected a MjModel"):
        planning.spheres_from_model(3, 0.01)


def test_the_time_for_covers_is_limited():
    model = mujoco.MjModel.from_xml_string(TWO_BODIES)
    with pytest.raises(TimeoutError, match=r"covered 0 of 1 geoms in budget_s = -1.0 s"):
        planning.spheres_from_model(model, 0.01, bodies=["arm"], budget_s=-1)


def test_the_time_for_covers_ends_threads_and_stops_inside_a_mesh(model):
    with pytest.raises(TimeoutError, match=r"of 5 geoms in budget_s = 0\.01 s"):
        planning.spheres_from_model(model, 0.01, budget_s=0.01)
    names = [thread.name for thread in threading.enumerate()]
    assert not any(name.startswith("ThreadPoolExecutor") for name in names)
    with pytest.raises(ValueError, match="budget_s"):
        planning.spheres_from_model(model, TOLERANCE, budget_s="soon")


def test_a_cache_serves_the_same_geoms_and_tolerance_alone(model, alone, tmp_path, monkeypatch):
    path, geoms = tmp_path / "arm.npz", ["bone", "finger"]
    expected = jax.tree.map(lambda *parts: np.concatenate(parts), *(alone[g] for g in geoms))

    def covered(tolerance=TOLERANCE, chosen=geoms):
        return planning.spheres_from_model(model, tolerance, geoms=chosen, cache=path)

    jax.tree.map(np.testing.assert_array_equal, covered(), expected)
    written = path.read_bytes()
    with monkeypatch.context() as patched:  # read, not covered again
        patched.setattr("hiosdf_jax._src.planning.robot.spheres.cover_geom", None)
        jax.tree.map(np.testing.assert_array_equal, covered(), expected)
        with pytest.raises(TypeError):
            covered(0.02)
        with pytest.raises(TypeError):
            covered(chosen=["bone"])
    assert path.read_bytes() == written
    assert len(covered(chosen=["bone"]).radii) == len(alone["bone"].radii)
    assert path.read_bytes() != written


def test_another_file_is_no_cache_and_stays(model, tmp_path):
    path = tmp_path / "points.npz"
    np.savez(path, points=np.zeros(3))
    other = path.read_bytes()
    with pytest.raises(ValueError, match=r"points\.npz holds no covers"):
        planning.spheres_from_model(model, TOLERANCE, geoms=["bone"], cache=path)
    assert path.read_bytes() == other
    path.write_bytes(b"text")
    with pytest.raises(ValueError, match=r"points\.npz"):
        planning.spheres_from_model(model, TOLERANCE, geoms=["bone"], cache=path)
    with pytest.raises(FileNotFoundError):
        planning.spheres_from_model(model, TOLERANCE, geoms=["bone"], cache=tmp_path / "no" / "a")


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -0.1, 0.0])
def test_damaged_covers_are_refused(model, tmp_path, wrong):
    path = tmp_path / "arm.npz"
    planning.spheres_from_model(model, TOLERANCE, geoms=["bone"], cache=path)
    arrays = dict(np.load(path))
    arrays["radii"][0] = wrong
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=r"arm\.npz holds covers that are damaged"):
        planning.spheres_from_model(model, TOLERANCE, geoms=["bone"], cache=path)


def test_samples_of_triangles_leave_no_gap():
    rng = np.random.default_rng(5)
    # Needles, a point and a segment among them.
    triangles = rng.uniform(-1, 1, (40, 3, 3)) * np.where(rng.random((40, 1, 1)) < 0.5, 1, 0.02)
    triangles[:10, 2] = triangles[:10, 0] + 0.01 * rng.uniform(-1, 1, (10, 3))
    triangles[-1], triangles[-2, 2] = triangles[-1, :1], triangles[-2, 1]
    samples = solids._on_triangles(triangles, 0.02)
    weights = rng.dirichlet(np.full(3, 0.5), (40, 500))
    points = (weights @ triangles).reshape(-1, 3)
    assert KDTree(samples).query(points)[0].max() <= 0.02
    # All of them are on their triangles, by areas: those to the corners add up to the whole.
    counts = [len(solids._on_triangles(t[None], 0.02)) for t in triangles]
    assert sum(counts) == len(samples)
    a, b, c = (np.repeat(triangles[:, k], counts, axis=0) - samples for k in range(3))
    parts = [np.linalg.norm(np.cross(u, v), axis=1) for u, v in ((a, b), (b, c), (c, a))]
    whole = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    np.testing.assert_allclose(sum(parts), whole, atol=1e-12)


def test_poses_before_kinematics_are_refused_and_inside_jit_in_collision():
    model = mujoco.MjModel.from_xml_string(TWO_BODIES)
    spheres = planning.spheres_from_model(model, 0.01, bodies=["arm"])
    data, field = mujoco.MjData(model), half_space([0.0, 0.0, 1.0], -2.0)
    with pytest.raises(ValueError, match=r"data\.xmat has rotations that are zero.*mj_kinematics"):
        planning.robot_clearance(field, spheres, data)
    clearance = jax.jit(planning.robot_clearance)
    unposed = planning.BodyPoses(jnp.asarray(data.xpos), jnp.asarray(data.xmat))
    assert clearance(field, spheres, unposed) < -1e29
    mujoco.mj_kinematics(model, data)
    posed = planning.BodyPoses(jnp.asarray(data.xpos), jnp.asarray(data.xmat))
    np.testing.assert_allclose(
        clearance(field, spheres, posed), planning.robot_clearance(field, spheres, data), atol=1e-6
    )


def test_the_gradient_of_a_robot_with_jacobians_is_that_by_the_joints():
    model = mujoco.MjModel.from_xml_string(TWO_BODIES)
    spheres = planning.spheres_from_model(model, 0.01, bodies=["arm"])
    data, field = mujoco.MjData(model), half_space([1.0, 0.0, 0.0], -2.0)

    def at(angle):
        data.qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return planning.robot_clearance_and_grad(field, spheres, data, unknown="network")

    up, down = at(0.301)[0], at(0.299)[0]
    _, by_position, by_rotation = at(0.3)
    body, by_joint = model.body("arm").id, np.zeros(model.nv)
    jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, jacp, jacr, body)
    by_joint = jacp.T @ np.asarray(by_position[body]) + jacr.T @ np.asarray(by_rotation[body])
    np.testing.assert_allclose(by_joint[0], (up - down) / 0.002, atol=2e-3)
