"""Ctrl-C while the command imports what it needs."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = """
import os, signal, sys
signal.signal(signal.SIGINT, {handler})
class Interrupt:
    def find_spec(self, name, *_):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
import hiosdf_command
sys.argv[1:] = ["map", "--help"]
sys.exit(hiosdf_command.main())
"""


def run(module, handler):
    return subprocess.run(
        [sys.executable, "-c", COMMAND.format(module=module, handler=handler)],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize(
    "module", ["hiosdf_jax", "numpy._core._multiarray_umath", "jaxlib", "argparse"]
)
def test_ctrl_c_ends_with_one_line(module):
    done = run(module, "signal.default_int_handler")
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, "hiosdf: stopped\n")


def test_an_ignored_signal_stays_ignored():
    done = run("jaxlib", "signal.SIG_IGN")
    assert done.returncode == 0 and done.stdout.startswith("usage: hiosdf map"), done.stderr
