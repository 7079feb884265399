"""Codes and their names, and records as trees of tensors: joined, cut into chunks, mapped."""

import numpy as np
import pytest
import torch

from dhtorch import codes, pytree
from dhtorch.codes import Flag, Gate, Hole, PoseCode, Source
from dhtorch.records import Camera, Pose, PoseFit, Samples, SigmaBudget


def test_codes_are_named_by_column_alone_and_in_lists():
    assert codes.name("gate", Gate.PARALLAX) == "PARALLAX"
    assert codes.name("dhtorch.source_map", torch.tensor([[Source.NONE, Source.SWEPT]])) == [["NONE", "SWEPT"]]
    assert codes.name("hole", np.array([Hole.TRACKABLE_NO_LIDAR])) == ["TRACKABLE_NO_LIDAR"]
    assert codes.name(Flag, Flag.NO_DEPTH | Flag.SATURATED) == "NO_DEPTH|SATURATED" and codes.name("flag", 0) == ""
    assert codes.words("TRACKABLE_NO_LIDAR") == "trackable, no LiDAR"
    assert list(codes.names(Gate)) == sorted(codes.names(Gate)) and codes.names(Gate)[Gate.ANSWER] == "ANSWER"
    with pytest.raises(ValueError, match="found the code 99"):
        codes.name("gate", 99)
    with pytest.raises(ValueError, match="found the column 'depth'"):
        codes.name("depth", 0)


def test_estimated_pixels_are_swept_filled_or_recovered():
    source = torch.tensor([Source.NONE, Source.SENSOR, Source.RECOVERED, Source.SWEPT, Source.FILLED])
    assert codes.is_swept(source).tolist() == [False, False, False, True, True]
    assert codes.is_estimated(source).tolist() == [False, False, True, True, True]
    assert codes.is_estimated(source.numpy()).tolist() == [False, False, True, True, True]
    assert codes.is_recovered(source).tolist() == [False, False, True, True, False]


def test_recovered_pixels_are_those_of_other_views_alone():
    counts = {Source.NONE: 1, Source.SENSOR: 10, Source.RECOVERED: 100, Source.SWEPT: 1000, Source.FILLED: 10000}
    kinds = codes.count_kinds(counts)
    assert list(kinds.items()) == [("recovered", 1100), ("filled", 10000), ("sensor", 10), ("no_answer", 1)]


def test_the_first_reason_counts():
    one, two = torch.tensor([True, True, False, False]), torch.tensor([False, True, True, False])
    assert codes.first_reason((one, 5), (two, 7), otherwise=3).tolist() == [5, 5, 7, 3]
    assert codes.describe(Gate, "parallax") == codes.describe(Gate, "PARALLAX") is not None
    assert codes.describe(Gate, "nothing") is None


def test_a_pose_is_one_by_its_code_alone():
    values = list(codes.names(PoseCode))
    fit = PoseFit(*7 * [None], code=torch.tensor(values, dtype=torch.int32))
    assert len(values) > 4 and fit.ok.tolist() == [value in (PoseCode.OK, PoseCode.KEPT_PNP) for value in values]


def camera(k, n=2):
    return Camera(torch.arange(2.0 * n).view(n, 2) + 10 * k, torch.ones(n, 2) * k)


def test_records_are_joined_in_order_and_cut_into_chunks():
    joined = pytree.collate([camera(1), camera(2)])
    assert joined.c[:, 0].tolist() == [1, 1, 2, 2] and joined.distortion is None
    stacked = pytree.stack([camera(1), camera(2)])
    assert stacked.f.shape == (2, 2, 2) and stacked.c[:, 0, 0].tolist() == [1, 2]
    sizes = []

    def double(record, values):
        sizes.append(len(values))
        return record.replace(f=record.f * values[:, None])

    values = torch.arange(4.0)
    result = pytree.chunked_apply(double, 3, joined, values)
    assert sizes == [3, 1] and torch.equal(result.f, joined.f * values[:, None])
    assert torch.equal(pytree.chunked_apply(double, 4, joined, values).f, result.f) and sizes == [3, 1, 4]
    bent = camera(1).replace(distortion=torch.zeros(2, 4))
    with pytest.raises(ValueError, match=r"Camera\.distortion is present in some records"):
        pytree.collate([camera(1), bent])
    with pytest.raises(ValueError, match="found none"):
        pytree.collate([])
    with pytest.raises(ValueError, match="unequal shapes"):
        pytree.stack([camera(1), camera(2, n=3)])
    with pytest.raises(ValueError, match="records of one kind"):
        pytree.collate([camera(1), Pose(torch.eye(3)[None], torch.zeros(1, 3))])


def test_a_record_moves_by_position_and_by_name():
    one = camera(1)
    for moved in (one.to(torch.float64), one.to(dtype=torch.float64), one.to("cpu", torch.float64, non_blocking=True)):
        assert moved.f.dtype == moved.c.dtype == torch.float64 and torch.equal(moved.f.float(), one.f)
    assert one.to("cpu").f.dtype == torch.float32 and one.to(device="meta").c.device.type == "meta"


def test_a_budget_is_scaled_to_sigma_term_by_term():
    parts = SigmaBudget(*(torch.tensor([x, x, 0.0]) for x in (1.0, 2.0, 0.0, 0.0, 1.0)))
    scaled = parts.scaled_to(torch.tensor([2.0, 1.0, 3.0]))
    assert torch.stack(scaled.values()).sum(0).tolist() == pytest.approx([4.0, 1.0, 9.0])
    assert scaled.pose.tolist() == pytest.approx([2.0, 0.5, 0.0]) and scaled.model[2] == 9.0
    assert parts.dominating[:2].tolist() == [codes.Cause.TRACK + 1] * 2


def test_usable_samples_are_those_with_a_place():
    flag = torch.tensor([[0, Flag.SPECULAR, 0]]).int()
    one = torch.ones(1, 3)
    xyz = torch.stack([one, one, torch.tensor([[1.0, torch.nan, 2.0]])], -1)
    samples = Samples(torch.zeros(1, 3, 2), one, one, xyz, one, flag, one, flag)
    assert samples.usable.tolist() == [[True, False, True]]
