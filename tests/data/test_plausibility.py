"""Doubts about stored depth: gross errors of unit, bytes and meaning are found, sound depth is not doubted."""

import os
import re
from pathlib import Path

import pytest
import torch

from dhtorch import data
from dhtorch.data.plausibility import plausibility_findings
from dhtorch.data.units import DepthUnit
from dhtorch.synthetic.recording import SyntheticRoom

MM, ASSUMED, TUM = DepthUnit(0.001, "meta.json: depth_scale"), DepthUnit(0.001), DepthUnit(1 / 5000)
ROOT = Path(os.environ.get("DHTORCH_DATA", "nowhere"))

#: Captures of DHTORCH_DATA and options that open them rightly.
CAPTURES = {
    **{f"7s_redkitchen_{k}": {} for k in ("000", "200", "400", "600", "stream_000", "stream_200")},
    **{name: {} for name in ("holo_a", "holo_stream", "slambook_rgbd", "tum_fr1_desk9", "tum_fr1_rpy_a", "r3d_door")},
    **{name: {} for name in ("dgp_drive6cam", "eth3d_terrace", "middlebury_motorcycle")},
    "field_cases/11e-poses-ok": {},
    "field_cases/22a-stray-ok": {},
}


@pytest.fixture(scope="module")
def codes():
    """16-bit codes (h, w) int64 of millimetres of two frames of the built-in room, with sensor noise of a few codes."""
    room = SyntheticRoom(n_frames=2, hw=(120, 160), depth_hw=(120, 160), supersample=1)
    g = torch.Generator().manual_seed(0)
    return [
        (1000 * room.truth(k)["depth"][0] + 3 * torch.randn(120, 160, generator=g)).round().long() for k in range(2)
    ]


def swap_bytes(code):
    return 256 * (code % 256) + code // 256


METRES = DepthUnit(1.0)
STATED = DepthUnit(1 / 8000, "option depth_unit")


def z_buffer(near):
    return lambda c: (1 - near / (c / 1000)) / (1 - near / 50)


#: What a capture stores of the codes, its unit (None: metres by its format), whether it is sparse; the finding's code,
#: words of its text and its remedy, or None for sound depth.
STORED = [
    *((change, unit, False, None, "", "") for change, unit in [
        (lambda c: c, ASSUMED), (lambda c: c, MM), (lambda c: 5 * c, TUM), (lambda c: 0 * c, ASSUMED),
        (lambda c: 10 * c, DepthUnit(1 / 10000, "option depth_unit")),  # the unit that is suggested
    ]),
    (lambda c: c / 1000, None, False, None, "", ""),
    (lambda c: 10 * c, ASSUMED, False, "unit", "beyond the reach of a short-range depth sensor.*depth unit 1/10000 m\\?", "data.depth_unit=1/10000"),
    (lambda c: 10 * c, MM, False, "unit", "beyond the reach.*depth unit 1/10000 m\\?", "data.depth_unit=1/10000"),
    (lambda c: (0.05 * c).round().long(), ASSUMED, False, "unit", "at or below the minimum range.*depth unit 1/100 m\\?", "data.depth_unit=1/100"),
    (lambda c: c, DepthUnit(0.01), False, "unit", "beyond.*depth unit 1/1000 m\\?", "data.depth_unit=1/1000"),
    (lambda c: c.double(), None, False, "unit", "", "data.depth_unit=1/1000"),  # millimetres as metres
    (lambda c: 20 * c / 1000, None, False, None, "", ""),  # a street in metres
    (lambda c: 20 * c, MM, True, None, "", ""),
    (swap_bytes, MM, False, "byte_order", "differ [1-9].* times as much.*other byte order", "swap"),
    (lambda c: (c << 3) % 65536 + (c >> 13), ASSUMED, False, "shifted", "SUN3D", "data.depth_unit=1/8000"),
    (lambda c: (c << 3) % 65536 + (c >> 13), STATED, False, None, "", ""),
    *((lambda c, step=step: ((c / step).round() * step).round().long(), MM, False, "8_bit", "equal steps", "16 bits") for step in (20, 39.2)),
    (lambda c: (285_000 / (285_000 / c).round()).round().long(), MM, False, None, "", ""),  # disparities in few steps
    *((z_buffer(near), METRES, False, "z_buffer", "non-linear", "") for near in (0.005, 0.01, 0.05)),
    (lambda c: c / 5000, DepthUnit(1.0, "file"), False, None, "", ""),  # a table top in metres
]  # fmt: skip


@pytest.mark.parametrize(("stored", "unit", "sparse", "code", "words", "remedy"), STORED)
def test_gross_errors_are_doubted_and_sound_depth_is_not(codes, stored, unit, sparse, code, words, remedy):
    metres = 1.0 if unit is None else unit.metres
    findings = plausibility_findings([stored(c) * metres for c in codes], unit, sparse)
    assert [each.code for each in findings] == ([] if code is None else [code])
    for each in findings:
        assert re.search(words, each.text) and remedy in each.remedy
        assert code != "unit" or unit is None or str(unit) in each.text


def test_every_row_of_a_small_map_counts_and_evenly_spaced_ones_of_a_large_one():
    assert not plausibility_findings([], MM)
    street = torch.zeros(2, 600)
    street[1] = 3000.0
    assert plausibility_findings([street], None, False)
    large = torch.zeros(8, 6000)  # 48,000 values: every fourth row
    large[1:4], large[5:] = 3000.0, 3000.0
    assert not plausibility_findings([large], None, False)
    large[4] = 3000.0
    assert plausibility_findings([large], None, False)


@pytest.mark.parametrize(("n", "doubted"), [(2, False), (3, True), (256, True), (257, False)])
def test_8_bit_depth_has_three_to_256_different_values(n, doubted):
    floats = (1.0 + 0.02 * (torch.arange(1200.0) % n)).reshape(30, 40)
    assert [f.code for f in plausibility_findings([floats], MM, False)] == ["8_bit"] * doubted


@pytest.mark.skipif(not ROOT.is_dir(), reason="no DHTORCH_DATA")
@pytest.mark.parametrize("name", CAPTURES)
def test_captures_are_not_doubted_and_keep_their_depth(name):
    recording = data.open_all(ROOT / name, **CAPTURES[name])[0]
    frames = [recording[i].depth[0] for i in sorted({0, len(recording) // 2, len(recording) - 1})]
    assert not plausibility_findings(frames, recording.depth_unit, recording.sparse)
    stored = recording.load(0).depth
    assert torch.equal(frames[0], torch.where(stored > 0, stored, 0.0)[0]), "no far constant, no code in the middle"
