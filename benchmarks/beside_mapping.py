"""A controller at 50 Hz beside a `BackgroundMapper`, on the machine's own cores.

    python -m benchmarks.beside_mapping [--seconds 60] [--serve map|baked]

Each period the controller queries 1,000 spheres with gradients. A deadline is missed where a period
ends after the next one should have. The controller runs three times: without a mapper, beside a
mapper in a thread, and beside a mapper in a process. Other work on the machine counts: the run
without a mapper shows how much, and `load` is in the output.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import time

import jax
import jax.numpy as jnp
import numpy as np

import hiosdf_jax as hio
from hiosdf_jax import demo, planning

PERIOD_S = 0.02
SENSOR_S = 0.1
MAPPERS = ("none", "thread", "process")
WINDOW = functools.partial(hio.bake, resolution=0.1, center=(4.0, 2.0, 1.2), size=(4.0, 4.0, 2.0))


def prepare():
    """Frames, a map past its warm-up, and the centers of the spheres."""
    stream = demo.ApartmentStream(frames=20)
    config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
    frames = [stream[k] for k in range(len(stream))]
    state = hio.init(config, jax.random.key(0))
    for cloud, pose in frames[:3]:
        state = hio.update(state, cloud, pose)
    low, high = np.asarray(demo.BOUNDS_WORLD)
    centers = np.random.default_rng(0).uniform(low, high, (1000, 3))
    return frames, state, jnp.asarray(centers, jnp.float32)


def run(frames, state, centers, seconds, serve, kind):
    serve = WINDOW if serve == "baked" else None
    control = jax.jit(planning.sphere_clearance_and_grad)
    missed, periods, ages, late = 0, 0, [], []
    with contextlib.ExitStack() as stack:
        mapper = None
        if kind == "none":
            field = hio.snapshot(state) if serve is None else serve(hio.snapshot(state))
        else:
            mapper = hio.BackgroundMapper(state, serve=serve, process=kind == "process")
            stack.enter_context(mapper)
            mapper.put(*frames[3])  # a process compiles it first
            mapper.wait()
            field = mapper.field
        first = int(field.updates)
        jax.block_until_ready(control(field, centers, 0.1))
        begin = time.perf_counter()
        due, last_put = begin + PERIOD_S, 0.0
        while (now := time.perf_counter()) - begin < seconds:
            if mapper is not None:
                if now - last_put > SENSOR_S:
                    mapper.put(*frames[periods % len(frames)], stamp=now - begin)
                    last_put = now
                field = mapper.field
            jax.block_until_ready(control(field, centers, 0.1))
            done = time.perf_counter()
            periods += 1
            missed += done > due
            late.append(max(0.0, done - due))
            if mapper is not None:
                ages.append(mapper.age(done - begin))
            while due - PERIOD_S < done:  # the next period that begins
                due += PERIOD_S
            time.sleep(max(0.0, due - PERIOD_S - time.perf_counter()))
    return {
        "mapper": kind,
        "periods": periods,
        "missed_percent": round(100 * missed / periods, 2),
        "latest_ms": round(1e3 * max(late), 1),
        "age_median_s": round(float(np.median(ages)), 2) if ages else None,
        "updates": int(field.updates) - first,
        "cores": os.cpu_count(),
        "load": [round(each, 1) for each in os.getloadavg()],
    }


def main():
    parser = argparse.ArgumentParser(description="Counts missed deadlines beside a mapper.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--serve", choices=["map", "baked"], default="baked")
    parser.add_argument("--mapper", choices=MAPPERS, nargs="+", default=MAPPERS)
    options = parser.parse_args()
    prepared = prepare()
    for kind in options.mapper:
        print(json.dumps(run(*prepared, options.seconds, options.serve, kind)), flush=True)


if __name__ == "__main__":
    main()
