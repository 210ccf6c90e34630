"""A controller at 50 Hz beside a `BackgroundMapper`, on the machine's own cores.

    python -m benchmarks.beside_mapping [--seconds 60] [--serve map|baked]

Each period the controller queries 1,000 spheres with gradients. A deadline is missed where a period
ends after the next one should have. Other work on the machine counts: see `load` in the output.
"""

from __future__ import annotations

import argparse
import json
import os
import time

import jax
import jax.numpy as jnp
import numpy as np

import hiosdf_jax as hio
from hiosdf_jax import demo, planning

PERIOD_S = 0.02


def run(seconds, serve):
    stream = demo.ApartmentStream(frames=20)
    config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
    frames = [stream[k] for k in range(len(stream))]
    state = hio.init(config, jax.random.key(0))
    for cloud, pose in frames[:3]:  # compiled, and past the warm-up
        state = hio.update(state, cloud, pose)
    low, high = np.asarray(demo.BOUNDS_WORLD)
    centers = np.random.default_rng(0).uniform(low, high, (1000, 3))
    centers = jnp.asarray(centers, jnp.float32)
    control = jax.jit(planning.sphere_clearance_and_grad)

    def bake(field):
        return hio.bake(field, 0.1, center=(4.0, 2.0, 1.2), size=(4.0, 4.0, 2.0))

    missed, periods, ages = 0, 0, []
    with hio.BackgroundMapper(state, serve=bake if serve == "baked" else None) as mapper:
        jax.block_until_ready(control(mapper.field, centers, 0.1))
        begin = time.perf_counter()
        due, last_put = begin + PERIOD_S, 0.0
        while (now := time.perf_counter()) - begin < seconds:
            if now - last_put > 0.1:  # a sensor at 10 Hz
                mapper.put(*frames[periods % len(frames)], stamp=now - begin)
                last_put = now
            jax.block_until_ready(control(mapper.field, centers, 0.1))
            done = time.perf_counter()
            periods += 1
            missed += done > due
            if np.isfinite(age := mapper.age(done - begin)):
                ages.append(age)
            while due - PERIOD_S < done:  # the next period that begins
                due += PERIOD_S
            time.sleep(max(0.0, due - PERIOD_S - time.perf_counter()))
        updates = int(mapper.field.updates)
    return {
        "serve": serve,
        "periods": periods,
        "missed_percent": round(100 * missed / periods, 2),
        "age_median_s": round(float(np.median(ages)), 2) if ages else None,
        "updates": updates,
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
    }


def main():
    parser = argparse.ArgumentParser(description="Counts missed deadlines beside a mapper.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--serve", choices=["map", "baked"], default="baked")
    options = parser.parse_args()
    print(json.dumps(run(options.seconds, options.serve)))


if __name__ == "__main__":
    main()
