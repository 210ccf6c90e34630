"""Examples that take minutes reach what the pages say of them."""

import re

import calibrate_extrinsics
import pytest


@pytest.mark.long
def test_extrinsics_are_found_from_ten_frames(capsys):
    calibrate_extrinsics.main()
    lines = capsys.readouterr().out.splitlines()
    first, last = (
        [float(number) for number in re.findall(r"\d+\.\d+", line)]
        for line in (lines[0], lines[-1])
    )
    assert first[0] > 2.9
    assert first[1] > 1.9
    assert last[0] < 1.0
    assert last[1] < 0.25
