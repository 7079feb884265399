"""Units of depth: what a name, a fraction or a number of metres means, and how a unit is shown."""

import pytest

from dhtorch.data.units import UNIT_METRES, DepthUnit, format_unit, parse_unit


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("m", 1.0),
        ("cm", 0.01),
        ("mm", 0.001),
        ("inch", 0.0254),
        ("1/5000", 1 / 5000),
        ("1/5000 m", 1 / 5000),
        ("1/1000m", 1e-3),
        ("0.5", 0.5),
        (0.001, 0.001),
        (2, 2.0),
        ("10/65535", 10 / 65535),
        *UNIT_METRES.items(),
    ],
)
def test_units_as_metres_of_one_step(text, metres):
    assert parse_unit(text) == pytest.approx(metres, rel=1e-12)


WRONG = ["", "feet", "1/0", "1/x", "-1", "0", "nan", "inf", -0.001, 0, True, None, float("nan")]


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_no_unit_is_refused_with_the_expected_forms(wrong):
    with pytest.raises(ValueError, match=r"^depth_unit: .* expected m, cm, mm, inch, 1/5000, or metres") as e:
        parse_unit(wrong)
    assert repr(wrong) in str(e.value) and "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (1.0, "1 m"),
        (0.01, "1/100 m"),
        (0.001, "1/1000 m"),
        (1 / 5000, "1/5000 m"),
        (0.0254, "0.0254 m"),
        (1 / 6553.5, "0.00015259 m"),
        (10.0, "10 m"),
        *((metres, format_unit(metres)) for metres in UNIT_METRES.values()),
    ],
)
def test_a_unit_as_text(metres, text):
    assert format_unit(metres) == text
    assert parse_unit(text) == pytest.approx(metres, rel=1e-5)


def test_an_assumed_unit_is_announced_and_a_stated_one_names_its_source():
    assumed, stated = DepthUnit(0.001), DepthUnit(1 / 5000, "camera.json: depth_scale")
    assert assumed.is_assumed and str(assumed) == "depth unit assumed: 1/1000 m"
    assert not stated.is_assumed and str(stated) == "depth unit: 1/5000 m (camera.json: depth_scale)"
