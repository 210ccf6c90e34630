"""Tables of scores."""

import math

from exact_sphere import CENTER, sphere, sphere_truth

from hiosdf_jax.scoring import evaluate, evaluate_bands, format_bands, format_score, format_table


def test_bands_become_rows():
    lines = format_bands(evaluate_bands(sphere, sphere_truth())).splitlines()
    assert lines[0].split() == ["true", "distance", "visible_cm", "eikonal", "cosine"]
    assert lines[2].split() == ["0-5", "cm", "0.00", "0.000", "0.000"]
    assert len(lines) == 6


def test_scores_become_rows():
    scores = {"visible_cm": 1.234, "recall": 0.98765, "surface_cm": math.nan}
    lines = format_table(scores).splitlines()
    assert lines[0].split() == ["metric", "unit", "better", "ours"]
    assert set(lines[1]) == {"-"}
    assert lines[2].split()[-3:] == ["cm", "lower", "1.23"]
    assert lines[3].split()[-3:] == ["cm", "lower", "-"]
    assert lines[4].split()[-3:] == ["-", "higher", "0.988"]
    assert len({line.index("cm") for line in lines[2:4]}) == 1
    assert format_score("visible_cm", [2.0, 4.0]) == "3.00"  # the mean over seeds
    assert format_score("recall", None) == "-"
    # Every score of evaluate has a row.
    full = evaluate(sphere, sphere_truth(), sensor_position_world=CENTER)
    assert len(format_table(full).splitlines()) == 2 + len(full)
