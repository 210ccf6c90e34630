"""Whole-arm clearance of a Panda and its gradient for 4096 configurations at once."""

import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from scene import build_map, exact_sdf

import hiosdf_jax as hio
from hiosdf_jax import planning

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # frax's advice on CPU setup
    import frax

BASE = np.eye(4, dtype=np.float32)
BASE[:3, 3] = (1.4, 2.0, 0.1)  # m, between the pillar and the table

# The robot is static and the map is traced: one compilation serves all maps of one layout.
arm_spheres = jax.jit(planning.frax.arm_spheres, static_argnames="arm")
clearance_and_grad = jax.jit(
    planning.frax.arm_clearance_and_grad, static_argnames=("arm", "unknown")
)


def draw(panda, count, rng):
    """Draws joint positions within the limits, (count, 7) rad."""
    low, high = panda.actuated_joint_lower_limits, panda.actuated_joint_upper_limits
    return rng.uniform(low, high, (count, panda.nq)).astype(np.float32)


def exact_clearance(panda, q):
    """Computes the clearance by the exact distances of the scene, (B,) m."""
    centers, radii = arm_spheres(panda, q, BASE)
    return (exact_sdf(centers) - radii).min(axis=-1)


def climb(field, panda, q, step_rad=0.02, steps=30, wanted_m=0.05):
    """Follows the gradient until the arm has the desired clearance."""
    for _ in range(steps):
        clearance, gradient = clearance_and_grad(field, panda, q, BASE)
        norm = jnp.linalg.norm(gradient, axis=-1, keepdims=True)
        q = q + step_rad * (clearance < wanted_m)[:, None] * gradient / jnp.maximum(norm, 1e-6)
    return q


if __name__ == "__main__":
    field, panda = hio.snapshot(build_map()), frax.load_panda()
    q = draw(panda, 4096, np.random.default_rng(0))
    clearance, gradient = jax.block_until_ready(clearance_and_grad(field, panda, q, BASE))
    began = time.perf_counter()
    clearance, gradient = jax.block_until_ready(clearance_and_grad(field, panda, q, BASE))
    print(f"{len(q)} clearances, gradients: {1e3 * (time.perf_counter() - began):.0f} ms")
    exact = exact_clearance(panda, q)
    error = np.abs(clearance - exact)[exact > 0]
    agree = np.mean((np.asarray(clearance) < 0) == (exact < 0))
    print(f"error where free {1e3 * error.mean():.1f} mm; collision checks right {agree:.1%}")
    near = q[(exact < 0) & (exact > -0.1)]
    after = exact_clearance(panda, climb(field, panda, near))
    print(f"{len(near)} in slight collision follow the gradient: {np.mean(after > 0):.1%} get free")
