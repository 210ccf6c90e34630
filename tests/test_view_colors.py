"""Colors of values and the bars that explain them."""

import numpy as np
import pytest
from matplotlib import colormaps

from hiosdf_jax._src.view import colors


def test_values_have_the_colors_of_the_palette():
    values = np.random.default_rng(0).uniform(-1.5, 1.5, (4, 5))
    painted = colors.DISTANCE.paint(values)
    assert painted.shape == (4, 5, 3) and painted.dtype == np.uint8
    for value, color in zip(values.ravel(), painted.reshape(-1, 3), strict=True):
        expected = colormaps["RdBu"](min(max((value + 1) / 2, 0.0), 1.0))[:3]
        np.testing.assert_allclose(color / 255, expected, atol=0.01)


def test_a_value_that_is_not_known_is_gray():
    painted = colors.DISTANCE.paint(np.array([np.nan, np.inf, -np.inf, 0.0]))
    assert (painted[:3] == colors.UNSEEN).all()
    assert (painted[3] != colors.UNSEEN).any()


def luminance(color):
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


@pytest.mark.parametrize("scale", [colors.height_scale(np.arange(3.0)), colors.spread_scale()])
def test_palettes_of_one_direction_differ_in_lightness_alone(scale):
    """Whoever confuses hues still reads them."""
    lightness = luminance(scale.paint(np.linspace(scale.low, scale.high, 50)) / 255)
    steps = np.diff(lightness)
    assert (steps > 0).all() or (steps < 0).all()
    assert abs(lightness[-1] - lightness[0]) > 0.5


@pytest.mark.parametrize("scale", [colors.DISTANCE, colors.CLEARANCE, colors.error_scale()])
def test_palettes_of_two_directions_are_lightest_in_the_middle(scale):
    lightness = luminance(scale.paint(np.linspace(scale.low, scale.high, 51)) / 255)
    assert (np.diff(lightness[:26]) > -0.01).all() and (np.diff(lightness[25:]) < 0.01).all()
    # Neither end of these is a red that looks like the green of the other end.
    ends = scale.paint(np.array([scale.low, scale.high])).astype(int)
    assert np.sign(ends[0, 0] - ends[0, 2]) == -np.sign(ends[1, 0] - ends[1, 2])


def test_a_few_specks_do_not_stretch_the_heights():
    heights = np.concatenate([np.linspace(0, 2.5, 1000), [40.0]])
    scale = colors.height_scale(heights)
    assert scale.low == 0.0 and scale.high == 2.5
    assert colors.height_scale(np.zeros(4)).high > 0
    assert colors.height_scale(np.empty(0)).high > 0


@pytest.mark.parametrize(
    "scale",
    [colors.DISTANCE, colors.CLEARANCE, colors.error_scale(), colors.spread_scale()],
)
def test_each_bar_names_its_unit(scale):
    assert scale.label.endswith(("[m]", "[cm]"))


def test_bars_show_the_palette_from_low_to_high():
    picture = colors.draw_bars([colors.DISTANCE], ["a note"])
    assert picture.dtype == np.uint8 and (picture[0] == 255).all()
    row = picture[20].astype(int)
    low, high = colors.DISTANCE.paint(np.array([-0.9, 0.9])).astype(int)
    first = np.abs(row - low).sum(axis=1).argmin()
    last = np.abs(row - high).sum(axis=1).argmin()
    assert first < last
    assert np.abs(row[first] - low).max() < 12 and np.abs(row[last] - high).max() < 12
    taller = colors.draw_bars([colors.DISTANCE, colors.CLEARANCE])
    assert taller.shape[0] > picture.shape[0]


def test_gltf_colors_look_like_those_of_the_screen():
    screen = np.arange(256, dtype=np.uint8)
    linear = colors.to_linear(screen) / 255
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown, screen / 255, atol=0.03)
