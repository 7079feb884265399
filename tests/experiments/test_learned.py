"""Learned baselines against small networks with the call signatures and output shapes of the real ones."""

import argparse
import sys
import types
from functools import partial

import pytest
import torch
from support.rooms import room_scene

from dhtorch import extend
from dhtorch.codes import Gate
from dhtorch.data.pairs import by_gap
from dhtorch.experiments.baselines import relative
from dhtorch.experiments.compare import learned
from dhtorch.experiments.protocol import Settings
from dhtorch.metrics import holdout
from dhtorch.records import Camera, Frame
from dhtorch.runtime import storage
from dhtorch.stages import sample
from dhtorch.synthetic.recording import SyntheticRoom

PAPER = extend.replace(n=512)
UNIT = 7.3  # metres per unit of the fake networks
DEEPEST = 16.0  # m, of a picture whose blue tells the depth


class FakeDust3r(torch.nn.Module):
    """Reads the depth from the blue channel and answers as AsymmetricCroCo3DStereo does."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(5))

    @classmethod
    def from_pretrained(cls, path, **_options):
        network = cls()
        network.load_state_dict(torch.load(path)["model"])
        return network

    def forward(self, view1, view2):
        image = view1["img"]
        assert image.dim() == 4 and image.shape[1] == 3 and image.min() >= -1 and view2["img"].shape == image.shape
        assert image.shape[-2] % 16 == 0 and image.shape[-1] % 16 == 0 and max(image.shape[-2:]) == 512
        assert torch.equal(view1["true_shape"], torch.tensor([list(image.shape[-2:])]))
        z = (image[:, 2] + 1) / 2 * DEEPEST / UNIT
        points = torch.stack((torch.zeros_like(z), torch.zeros_like(z), z), -1)
        conf = 1 + z
        return {"pts3d": points, "conf": conf}, {"pts3d_in_other_view": points + 9, "conf": conf}


def fake_inference(pairs, model, device, batch_size=8, verbose=True):
    """As dust3r.inference.inference: pairs of dicts in, a dict of predictions on the CPU out."""
    (view1, view2), *rest = pairs
    assert not rest and batch_size == 1 and [view1["idx"], view2["idx"]] == [0, 1]
    assert [view1["instance"], view2["instance"]] == ["0", "1"]
    with torch.no_grad():
        pred1, pred2 = model(view1, view2)
    return {"view1": view1, "view2": view2, "pred1": pred1, "pred2": pred2, "loss": None}


class FakeVggt(torch.nn.Module):
    """Reads the depth from the blue channel and answers as VGGT does, with its batch axis."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(7))

    def forward(self, images):
        images = images[None] if images.dim() == 4 else images
        B, S, C, H, W = images.shape
        assert (
            (B, S, C) == (1, 2, 3) and H % 14 == 0 and W == 518 and H <= 518 and 0 <= images.min() <= images.max() <= 1
        )
        z = (
            images[:, :, 2] * DEEPEST / UNIT * torch.tensor([1.0, 3.0]).view(1, 2, 1, 1)
        )  # the second view must not count
        return {
            "pose_enc": torch.zeros(B, S, 9),
            "depth": z[..., None],
            "depth_conf": 1 + z,
            "world_points": torch.zeros(B, S, H, W, 3),
            "world_points_conf": torch.ones(B, S, H, W),
        }


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """Both packages importable, and a weights file for each."""
    for name in ("dust3r", "dust3r.model", "dust3r.inference", "vggt", "vggt.models", "vggt.models.vggt"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules["dust3r.model"].AsymmetricCroCo3DStereo = FakeDust3r
    sys.modules["dust3r.inference"].inference = fake_inference
    sys.modules["vggt.models.vggt"].VGGT = FakeVggt
    files = {"dust3r": tmp_path / "dust3r.pth", "vggt": tmp_path / "model.pt"}
    torch.save({"args": argparse.Namespace(model="x"), "model": FakeDust3r().state_dict()}, files["dust3r"])
    torch.save(FakeVggt().state_dict(), files["vggt"])
    return files


ADAPTERS = {"dust3r": relative.DUSt3R, "vggt": relative.VGGT}


def ramp(height, width, batch=1):
    """A frame whose blue is its depth, smooth over the whole picture."""
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    depth = (2 + 4 * u / width + 3 * v / height + torch.arange(batch).view(-1, 1, 1)).float()
    image = torch.stack((torch.zeros_like(depth), torch.zeros_like(depth), depth / DEEPEST), 1)
    one = torch.ones(batch, 2)
    return Frame(image=image, depth=depth, camera=Camera(one * width, one * width / 2))


@pytest.mark.parametrize("hw", [(480, 640), (640, 480), (480, 480), (375, 1242), (241, 319)])
@pytest.mark.parametrize("name", list(ADAPTERS))
def test_depth_is_read_where_the_sample_is(installed, name, hw):
    """Resizing and cropping are undone: an image pixel reads the depth that was painted there."""
    frame = ramp(*hw, batch=2)
    found = ADAPTERS[name](installed[name])(frame, frame)
    uv = sample.regular_grid(hw, 400).expand(2, -1, -1)
    depth, confidence = relative.sample_relative_depth(found, uv)
    true = holdout.sample_truth(frame, uv, truth="raw").depth
    seen = depth.isfinite()
    coarse = max(hw) / 512  # image pixels to a network pixel: half of one may be missed, and half of an image pixel
    slope = 4 / hw[1] + 3 / hw[0]
    assert ((depth * UNIT - true).abs()[seen] < (coarse + 1) / 2 * slope + 0.02).all()
    assert torch.allclose(confidence[seen], 1 + depth[seen], atol=1e-4)
    kept = {"dust3r": {(480, 480): 0.75}, "vggt": {(640, 480): 518 / 686}}[name].get(hw, 1.0)
    assert abs(float(seen.float().mean()) - kept) < 0.07


@pytest.mark.parametrize("name", list(ADAPTERS))
def test_alone_or_in_a_batch(installed, name):
    frame = ramp(96, 128, batch=3)
    network = ADAPTERS[name](installed[name])
    whole = network(frame, frame)
    for b in range(3):
        one = network(frame[b : b + 1], frame[b : b + 1])
        assert all(torch.equal(getattr(whole, k)[b : b + 1], getattr(one, k)) for k in ("depth", "confidence", "gain"))


def test_estimate_has_codes_for_what_is_missing():
    depth = torch.tensor([[[1.0, -1.0], [torch.nan, 2.0]]]).expand(2, 2, 2)
    found = relative.RelativeDepth(depth, 1 + depth.abs(), torch.ones(2, 2), torch.zeros(2, 2))
    uv = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1], [5, 5]]).expand(2, -1, -1)
    estimate = relative.to_estimate(found, uv, torch.tensor([3.0, torch.nan]))
    assert estimate.gate[0].tolist() == [Gate.ANSWER, Gate.NO_TRACK, Gate.NO_TRACK, Gate.ANSWER, Gate.NO_TRACK]
    assert (estimate.gate[1] == Gate.NO_POSE).all() and estimate.depth[1].isnan().all()
    assert torch.allclose(estimate.depth[0, [0, 3]], torch.tensor([3.0, 6.0]))
    assert torch.allclose(estimate.score[0], torch.tensor([1 / 2, 0, 0, 2 / 3, 0])) and (estimate.score[1] == 0).all()


def test_the_scale_rests_on_pixels_that_no_sample_reads():
    """Truth that is wrong at every sample, and only there, does not move the scale."""
    frame = ramp(120, 160)
    found = relative.RelativeDepth(frame.depth / UNIT, frame.depth, torch.ones(1, 2), torch.zeros(1, 2))
    uv = sample.regular_grid(frame.hw, 9000)[None]
    at = (uv[0] + 0.5).floor().long()
    lying = frame.depth.clone()
    lying[0, at[:, 1], at[:, 0]] = 99.0
    assert (lying == 99).float().mean() > 0.4, "the test would pass with samples counted"
    scale = learned.fit_scale(found, frame.replace(depth=lying), uv, n_pixels=4096, seed=0)
    assert abs(float(scale.factor) - UNIT) < 1e-4 and 1000 < int(scale.n_pixels) < 3000
    again = learned.fit_scale(found, frame.replace(depth=lying), uv, n_pixels=4096, seed=0)
    assert torch.equal(scale.factor, again.factor)
    sparse = frame.replace(sparse=torch.ones(1, dtype=torch.bool), depth=torch.zeros_like(frame.depth))
    sparse.depth[0, 60:63, 80:83] = 5.0  # in a sparse map the return within the search of a sample does not count
    at, away = (
        learned.fit_scale(found, sparse, torch.tensor([[[80.0 - d, 60.0 - d]]]), n_pixels=50000, seed=0)
        for d in (0, 50)
    )
    assert int(away.n_pixels) > int(at.n_pixels) and at.factor.isnan().all()
    empty = learned.fit_scale(found, frame.replace(depth=0 * lying), uv, n_pixels=4096, seed=0)
    assert empty.factor.isnan().all() and int(empty.n_pixels) == 0


class TellingRoom(SyntheticRoom):
    """The room with its exact depth painted into the blue channel."""

    def __getitem__(self, index):
        frame = super().__getitem__(index)
        image = frame.image.float() / 255
        blue = (self.truth(index)["depth"] / DEEPEST).clamp(0, 1)[:, None]
        return frame.replace(image=torch.cat((image[:, :2], blue), 1))


@pytest.fixture(scope="module")
def room():
    return TellingRoom(hw=(240, 320), n_frames=8, lidar="exact", image_noise=0.0)


def asked(room, installed, **options):
    models = {name: partial(ADAPTERS[name], weights=installed[name]) for name in ADAPTERS}
    pairs = partial(by_gap, gap=6)
    return learned.run([room_scene(room)], {"paper": PAPER}, pairs, Settings(), **{"models": models, **options})


@pytest.mark.slow
def test_networks_are_measured_on_our_candidates(room, installed):
    outcome = asked(room, installed)
    rows = {r["method"]: r for r in outcome.rows if r["pair"] is None}
    assert list(rows) == ["paper", "dust3r_oracle", "dust3r_near", "vggt_oracle", "vggt_near"]
    assert len({r["n_candidates"] for r in rows.values()}) == 1 and rows["paper"]["n_candidates"] > 50
    assert (rows["paper"]["scale"], rows["paper"]["metric"], rows["paper"]["parameters"]) == ("sensor", "yes", 0)
    for name in list(rows)[1:]:
        row, oracle = rows[name], name.endswith("oracle")
        assert (row["scale"], row["metric"]) == (("oracle", "no") if oracle else ("near", "yes"))
        assert row["parameters"] == (5 if name.startswith("dust3r") else 7) and row["pnp_success"] is None
        assert row["median_rel"] < 0.02 and row["coverage"] > 0.9, "a network that reads the truth is nearly exact"
        assert abs(row["scale_factor"] - UNIT) < 0.1 and row["scale_pixels"] > 500 and row["seconds_per_video"] > 0
        assert row["on_ours"]["median_rel"] < 0.02 and f"{name}.on_ours.median_rel" in outcome.summary
    assert outcome.verdict == "supported" and "1 of 1" in outcome.why
    storage.to_strict_json(outcome.rows)


@pytest.mark.slow
def test_a_network_runs_once_for_all_its_scales_and_the_control_is_worth_its_scale_alone(room, installed):
    calls = []

    class Counted(relative.VGGT):
        def __call__(self, frame_0, frame_1):
            calls.append(1)
            return super().__call__(frame_0, frame_1)

    models = {"vggt": partial(Counted, weights=installed["vggt"]), "constant": relative.ConstantDepth}
    outcome = asked(room, installed, models=models)
    assert len(calls) == outcome.n_pairs == 2
    times = [r["ms"]["network"] for r in outcome.rows if "vggt" in r["method"] and r["pair"] == [0, 6]]
    assert len(times) == 2 and times[0] == times[1] > 0
    (row,) = (r for r in outcome.rows if r["pair"] == [0, 6] and r["method"] == "constant_oracle")
    truth = room.truth(0)["depth"]
    assert abs(row["scale_factor"] / float(truth.median()) - 1) < 0.05 and row["coverage"] == 1
    assert row["parameters"] == 0 and row["median_rel"] > 0.1
    alone = asked(room, installed, models={"constant": relative.ConstantDepth}, scales=("oracle",))
    assert alone.verdict == "undecided" and "vggt_oracle was not run" in alone.why


@pytest.mark.parametrize("name", list(ADAPTERS))
def test_missing_packages_and_weights_are_named(installed, monkeypatch, tmp_path, name):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        ADAPTERS[name](tmp_path / "nowhere")
    if name == "vggt":
        with pytest.raises(ValueError, match="same size"):
            ADAPTERS[name](installed[name])(ramp(96, 128), ramp(96, 112))
    monkeypatch.setitem(sys.modules, {"dust3r": "dust3r.inference", "vggt": "vggt.models.vggt"}[name], None)
    with pytest.raises(ImportError, match=r"github\.com/.*" + name):
        ADAPTERS[name](tmp_path)
