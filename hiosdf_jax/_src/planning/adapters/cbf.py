"""A safety filter for velocity commands: the map as a control barrier function of `cbfpy`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cbfpy
import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.queries import AnyField, Unknown
from hiosdf_jax._src.numerics.intake import as_number, as_real
from hiosdf_jax._src.planning.body import BodySpheres
from hiosdf_jax._src.planning.clearance import checked_spheres, sphere_clearance
from hiosdf_jax._src.state.pytrees import Baked, Bound

_PENALTY = 100.0
_TOLERANCE = 1e-3


def velocity_filter(
    spheres: BodySpheres,
    velocity_limits: Any,
    *,
    margin_m: float,
    gain_per_s: float = 5.0,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> Callable[[AnyField, jax.Array, jax.Array], jax.Array]:
    """Makes a filter that changes velocity commands just enough to keep the body off the map.

    With h_i = sdf(center_i) - radius_i - margin for every sphere i of the body, the filter returns
    the velocity nearest to the desired one, in units of the limits, among those within the limits
    for which d(h_i)/dt >= -gain h_i. Where none exists it violates the constraints as little as it
    can, and where the solver fails it stops. The result is accurate to 3 % of the limits (float32).

    A sphere sees only the surface nearest to its center, so that in a corner the filter would obey
    one wall at a time. Describe a thick body by several spheres, see `inscribed`.

    Example:
        def body(position):
            return planning.cbf.inscribed(position[None], jnp.array([0.15]))

        safe = jax.jit(planning.cbf.velocity_filter(body, [1.0, 1.0, 1.0], margin_m=0.1))
        velocity = safe(field, jnp.array([0.5, 0.0, 0.3]), jnp.array([-1.0, 0.0, 0.0]))

    Args:
        spheres: The body at a configuration, a pure function of JAX arrays.
        velocity_limits: (n,) > 0, the largest |velocity| of each coordinate, m/s or rad/s.
        margin_m: Clearance to keep, m, >= 0. It has to cover the distance that a sphere travels
            while a command is held, and the map's error.
        gain_per_s: The clearance beyond the margin shrinks by at most this fraction per second.
            Keep it well below 1 / dt for commands held for dt.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        The pure function (field, q (n,), desired velocity (n,)) -> velocity (n,). The map is a
        traced argument. Use vmap over q for many robots.

    Raises:
        ValueError: A limit or the gain is not positive, or the margin is negative.
    """
    limits = as_real("velocity_limits", velocity_limits).astype(float)
    if limits.ndim != 1 or not (np.isfinite(limits).all() and (limits > 0).all()):
        raise ValueError(f"velocity_limits is {velocity_limits!r}, expected shape (n,), all > 0")
    margin_m = as_number("margin_m", margin_m, 0)
    gain_per_s = as_number("gain_per_s", gain_per_s, 0, above=True)
    cbf = cbfpy.CBF.from_config(_Shares(spheres, limits, margin_m, gain_per_s, unknown, bound))

    def filtered(field: AnyField, q: jax.Array, desired: jax.Array) -> jax.Array:
        shares = cbf.safety_filter(q, desired / limits, field)
        # A robot that tracks velocities is safe where it stands.
        shares = jnp.where(jnp.isfinite(shares).all(), jnp.clip(shares, -1, 1), 0)
        return shares * limits

    return filtered


def inscribed(centers: Any, radii: Any, share: float = 0.5) -> tuple[jax.Array, jax.Array]:
    """Adds six smaller spheres to each sphere, touching it from inside along +-x, +-y and +-z.

    They do not enlarge the body, but each sees the surface on its own side.

    Args:
        centers: (S, 3) m.
        radii: (S,) m.
        share: Radius of the smaller spheres as a fraction of the sphere's, in (0, 1).

    Returns:
        centers (7 S, 3) m and radii (7 S,) m; the given spheres come first.

    Raises:
        ValueError: `share` is out of range, or a shape or a radius is wrong.
    """
    share = as_number("share", share, 0, above=True)
    if share >= 1:
        raise ValueError(f"share is {share!r}, expected 0 < share < 1")
    centers, radii = checked_spheres(centers, radii, "centers")
    radii = jnp.broadcast_to(radii, centers.shape[:1])
    axes = jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    inner = centers + (1 - share) * radii[:, None] * axes[:, None, :]
    return (
        jnp.concatenate([centers, inner.reshape(-1, 3)]),
        jnp.concatenate([radii, jnp.tile(share * radii, 6)]),
    )


class _Shares(cbfpy.CBFConfig):
    """dq/dt = limits * u, the dynamics of a robot whose own controllers track velocities."""

    def __init__(
        self,
        spheres: BodySpheres,
        limits: np.ndarray,
        margin_m: float,
        gain_per_s: float,
        unknown: Unknown,
        bound: Bound,
    ) -> None:
        self._limits, self._gain_per_s = limits, gain_per_s
        count = len(limits)

        # Compiled: cbfpy's checks call this several times outside jit, which would take seconds.
        @jax.jit
        def barriers(z: jax.Array, field: AnyField) -> jax.Array:
            centers_world, radii = spheres(z)
            return sphere_clearance(field, centers_world, radii, unknown, bound) - margin_m

        self._barriers = barriers
        super().__init__(
            count,
            count,
            u_min=-np.ones(count),
            u_max=np.ones(count),
            # cbfpy's default penalties and tolerances are too far apart for float32 and give NaN.
            cbf_relaxation_penalty=_PENALTY,
            control_relaxation_penalty=_PENALTY,
            solver_tol=_TOLERANCE,
            # cbfpy keeps the arguments of its checks, hence the smallest map that satisfies them.
            init_args=(_smallest_map(),),
        )

    def f(self, z: jax.Array, field: AnyField) -> jax.Array:
        return jnp.zeros(self.n)

    def g(self, z: jax.Array, field: AnyField) -> jax.Array:
        return jnp.diag(jnp.asarray(self._limits))

    def h_1(self, z: jax.Array, field: AnyField) -> jax.Array:
        return self._barriers(z, field)

    def alpha(self, h: jax.Array, field: AnyField) -> jax.Array:
        return self._gain_per_s * h


def _smallest_map() -> Baked:
    """A slope along (1, 1, 1): cbfpy checks that the control changes the barrier."""
    slope = jnp.indices((2, 2, 2)).sum(0).astype(jnp.float32)
    return Baked(
        corner_world=jnp.zeros(3),
        resolution=jnp.ones(()),
        sdf=slope,
        frontier=slope,
        lower=slope,
        updates=jnp.zeros((), jnp.int32),
        stamp=jnp.zeros(()),
    )
