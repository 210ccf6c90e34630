"""A script that forgets to close its mapper ends at once, with its own exit code."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

HERE = Path(__file__).parent

# Without a guard against being imported again, and with a mapper that compiles for longer than a
# script may take to end.
SCRIPT = """
import os, sys, time
os.register_at_fork(before=lambda: print("fork"))
sys.path.insert(0, {here!r})
import jax
import hiosdf_jax as hio
from room import CONFIG, stream
mapper = hio.BackgroundMapper(hio.init(CONFIG, jax.random.key(0)), process={process})
mapper.put(*stream(1)[0])
time.sleep({sleep})
child = getattr(mapper._fuser, "_process", None)
print(child.pid if child else 0, int(mapper.field.updates), time.time(), flush=True)
{ending}
"""

ENDINGS = {
    "end of the script": ("", 0),
    "exit": ("sys.exit(7)", 7),
    "exception": ("1 / 0", 1),
    "kill": ("os.kill(os.getpid(), 9)", -signal.SIGKILL),
}
CASES = [  # (process, ending, runs)
    (False, "exception", 1),
    (True, "exit", 1),
    (True, "kill", 1),
    *(
        pytest.param(process, ending, 30, marks=pytest.mark.long)
        for process in (False, True)
        for ending in ENDINGS
    ),
]
MOST_S = 5.0


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc and /proc")
@pytest.mark.parametrize("process, ending, runs", CASES)
def test_a_script_that_does_not_close_its_mapper_ends(process, ending, runs, tmp_path):
    last_line, code = ENDINGS[ending]
    script, took, fused = tmp_path / "script.py", [], 0
    for run in range(runs):
        # It imports, traces, compiles, or has finished the frame.
        sleep = 2.0 if runs == 1 else 12 * run / runs
        script.write_text(
            SCRIPT.format(here=str(HERE), process=process, sleep=sleep, ending=last_line)
        )
        done = subprocess.run(
            [sys.executable, script],
            capture_output=True,
            text=True,
            timeout=120,
            env=os.environ
            | {"JAX_ENABLE_COMPILATION_CACHE": "false", "PYTHONPATH": str(HERE.parent)},
        )
        ended = time.time()
        assert done.returncode == code, done.stderr
        pid, updates, begun = done.stdout.split()  # nothing else: once, and without a fork
        took.append(ended - float(begun))
        fused += int(updates)
        while int(pid) and is_running(int(pid)):
            assert time.time() < ended + MOST_S
            time.sleep(0.05)
    print(f"{runs} ends, {fused} after the update: {max(took):.2f} s at most")
    assert runs == 1 or max(took) < MOST_S
