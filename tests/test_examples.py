"""Examples that take minutes reach what the pages say of them."""

import re

import calibrate_extrinsics
import pytest


@pytest.mark.long
def test_extrinsics_are_found_from_ten_frames(capsys):
    calibrate_extrinsics.main()
    printed = capsys.readouterr().out.splitlines()
    way_cm, angle_deg = map(float, re.findall(r"\d+\.\d+", printed[-1]))
    assert way_cm < 1.0
    assert angle_deg < 0.25
