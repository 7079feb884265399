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


def found(codes, unit=ASSUMED, sparse=False):
    """Codes and texts of the findings on depth maps of these codes."""
    return [(f.code, f.text, f.remedy) for f in plausibility_findings([c * unit.metres for c in codes], unit, sparse)]


def swap_bytes(code):
    return 256 * (code % 256) + code // 256


def test_sound_depth_is_not_doubted(codes):
    assert not found(codes) and not found(codes, MM) and not found([5 * c for c in codes], TUM)
    assert not plausibility_findings([c / 1000 for c in codes], None)
    assert not plausibility_findings([], MM) and not found([torch.zeros(120, 160).long()])


@pytest.mark.parametrize(
    ("factor", "unit", "likelier", "words"),
    [
        (10, ASSUMED, "1/10000", "beyond the reach of a short-range depth sensor"),
        (10, MM, "1/10000", "beyond the reach"),
        (0.05, ASSUMED, "1/100", "at or below the minimum range"),
        (1, DepthUnit(0.01), "1/1000", "beyond"),
    ],
)
def test_a_wrong_unit_is_doubted_with_a_likelier_one(codes, factor, unit, likelier, words):
    ((code, text, remedy),) = found([(c * factor).round().long() for c in codes], unit)
    assert code == "unit" and words in text and f"depth unit {likelier} m?" in text
    assert remedy == f"data.depth_unit={likelier}" and str(unit) in text


def test_the_unit_that_is_suggested_is_not_doubted(codes):
    tenfold = [10 * c for c in codes]
    assert found(tenfold) and not found(tenfold, DepthUnit(1 / 10000, "option depth_unit"))


def test_millimetres_as_metres_are_doubted_and_metres_of_a_street_are_not(codes):
    (finding,) = plausibility_findings([c.double() for c in codes], None)
    assert finding.code == "unit" and "data.depth_unit=1/1000" in finding.remedy
    street = [20 * c / 1000 for c in codes]
    assert not plausibility_findings(street, None) and not plausibility_findings(street, MM, sparse=True)


def test_every_row_of_a_small_map_counts_and_evenly_spaced_ones_of_a_large_one():
    street = torch.zeros(2, 600)
    street[1] = 3000.0
    assert plausibility_findings([street], None, False)
    large = torch.zeros(8, 6000)  # 48,000 values: every fourth row
    large[1:4], large[5:] = 3000.0, 3000.0
    assert not plausibility_findings([large], None, False)
    large[4] = 3000.0
    assert plausibility_findings([large], None, False)


def test_swapped_bytes_are_found(codes):
    ((code, text, remedy),) = found([swap_bytes(c) for c in codes], MM)
    assert code == "byte_order" and "other byte order" in text and "swap" in remedy
    assert float(re.search(r"differ (\d+) times as much", text).group(1)) > 1


def test_codes_rotated_by_three_bits_are_found_unless_the_unit_is_stated(codes):
    rotated = [(c << 3) % 65536 + (c >> 13) for c in codes]
    ((code, text, remedy),) = found(rotated)
    assert code == "shifted" and "SUN3D" in text and remedy == "data.depth_unit=1/8000"
    assert not found(rotated, DepthUnit(1 / 8000, "option depth_unit"))


@pytest.mark.parametrize("step", [20, 39.2])
def test_depth_of_8_bits_is_found(codes, step):
    ((code, text, remedy),) = found([((c / step).round() * step).round().long() for c in codes], MM)
    assert code == "8_bit" and "equal steps" in text and "16 bits" in remedy


@pytest.mark.parametrize(("n", "doubted"), [(2, False), (3, True), (256, True), (257, False)])
def test_8_bit_depth_has_three_to_256_different_values(n, doubted):
    floats = (1.0 + 0.02 * (torch.arange(1200.0) % n)).reshape(30, 40)
    assert [f.code for f in plausibility_findings([floats], MM, False)] == ["8_bit"] * doubted


def test_disparities_in_few_steps_are_not_8_bit_depth(codes):
    stereo = [(285_000 / (285_000 / c).round()).round().long() for c in codes]
    assert len(torch.cat(stereo).unique()) <= 256 and not found(stereo, MM)


@pytest.mark.parametrize("near", [0.005, 0.01, 0.05])
def test_a_z_buffer_is_found(codes, near):
    depth = [(1 - near / (c / 1000)) / (1 - near / 50) for c in codes]
    (finding,) = plausibility_findings(depth, DepthUnit(1.0))
    assert finding.code == "z_buffer" and "non-linear" in finding.text
    assert not plausibility_findings([c / 5000 for c in codes], DepthUnit(1.0, "file")), "a table top in metres"


@pytest.mark.skipif(not ROOT.is_dir(), reason="no DHTORCH_DATA")
@pytest.mark.parametrize("name", CAPTURES)
def test_captures_are_not_doubted_and_keep_their_depth(name):
    recording = data.open_all(ROOT / name, **CAPTURES[name])[0]
    frames = [recording[i].depth[0] for i in sorted({0, len(recording) // 2, len(recording) - 1})]
    assert not plausibility_findings(frames, recording.depth_unit, recording.sparse)
    stored = recording.load(0).depth
    assert torch.equal(frames[0], torch.where(stored > 0, stored, 0.0)[0]), "no far constant, no code in the middle"
