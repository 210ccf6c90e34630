"""Every reader on damaged files: see `mutations`, which runs in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


def check(first, count):
    command = [sys.executable, Path(__file__).with_name("mutations.py"), str(first), str(count)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    summary = json.loads(run.stdout)
    assert summary["faults"] == []
    assert summary["good"] > count / 10 and summary["refused"] > count / 3


def test_damaged_recordings_maps_and_meshes():
    check(0, 400)


@pytest.mark.long
def test_ten_thousand_damaged_recordings_maps_and_meshes():
    for first in range(400, 12_400, 3_000):
        check(first, 3_000)
