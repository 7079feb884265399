"""Poses from elsewhere: held against near returns, in sigma, in samples; what a wrong one is called."""

from types import SimpleNamespace

import pytest
import torch
from support.sample_dicts import GAP, frames, room

from dhtorch.codes import Gate, PoseCode
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import pose_conventions as conventions
from dhtorch.geometry import se3
from dhtorch.pipeline.presets import METHODS
from dhtorch.pytree import collate, stack
from dhtorch.records import Camera, PoseFit, Samples, Tracks
from dhtorch.stages import pose_prior
from dhtorch.stages.pose_prior import check_pose_prior, make_prior
from dhtorch.synthetic import SyntheticRoom
from dhtorch.transforms import ExtendDepth, ExtendedDataset, SampleError, poses

N = 400
SIGMA = (0.004, 0.008)


@pytest.fixture(scope="module")
def pairs():
    """Three pairs of a phone in the room, their true depth, and poses: places far from the world's origin."""
    walk = SyntheticRoom(n_frames=16, hw=(180, 240), depth_hw=(72, 96), range_limit=2.5, supersample=1)
    first, second = [0, 2, 4], [9, 12, 15]
    truth = torch.stack([walk.truth(i)["depth"][0] for i in first])
    worlds = walk.true_poses[torch.tensor(first)], walk.true_poses[torch.tensor(second)]
    return collate(walk[i] for i in first), collate(walk[i] for i in second), truth, worlds


def asked(pairs, motion, method="map", **options):
    reference, other, truth, _ = pairs
    trace = {}
    estimate = METHODS[method](reference, other, n=N, fit=motion.to(torch.float32), trace=trace, **options)
    uv = (estimate.uv + 0.5).floor().long()
    z = truth[torch.arange(len(truth))[:, None], uv[..., 1], uv[..., 0]]
    far = estimate.keep & ~trace["samples"].usable
    return estimate, trace["fit"], ((estimate.depth - z) / z)[far], ((estimate.depth - z) / estimate.sigma)[far]


def off_by(T, sigma, seed=0):
    draw = torch.randn(len(T.t), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return se3.compose(se3.exp(draw * torch.tensor([sigma[0]] * 3 + [sigma[1]] * 3)), T)


# ---------------------------------------------------------------------------------------------------- in the room


@pytest.mark.parametrize("method", ["paper", "map"])
def test_a_right_pose_is_used_as_it_is(pairs, method):
    T = se3.relative(*pairs[3])
    _, fit, error, _ = asked(pairs, pose_prior.relative_prior(*pairs[3], sigma=(1e-4, 1e-4)), method)
    assert fit.ok.all() and error.numel() > 150 and error.abs().median() < 0.03
    assert torch.equal(fit.T_1_from_0.R, T.R.float()) and torch.equal(fit.T_1_from_0.t, T.t.float())
    assert torch.equal(fit.cov, torch.diag(torch.tensor([1e-8] * 6)).expand(3, 6, 6))
    assert (fit.matched_convention == 0).all() and fit.n_inlier.amin() > 50


def test_a_covariance_that_is_not_stated_is_taken_from_the_near_returns(pairs):
    T = se3.relative(*pairs[3])
    _, right, *_ = asked(pairs, pose_prior.make_prior(T))
    _, off, _, z = asked(pairs, pose_prior.make_prior(off_by(T, (0.002, 0.004))))
    assert right.ok.all() and off.ok.all()
    spread = lambda fit: fit.cov.diagonal(dim1=1, dim2=2).sum(-1)  # noqa: E731
    assert (spread(off) > 1.5 * spread(right)).all() and (z.abs() < 2).float().mean() > 0.6
    dark = pairs[0].replace(depth=torch.zeros_like(pairs[0].depth))
    _, fit, *_ = asked((dark, *pairs[1:]), pose_prior.make_prior(T, sigma=(0.0, 0.0)))
    assert fit.ok.all() and (fit.cov == 0).all() and fit.t_snr.isinf().all(), "exact because it is said"


@pytest.fixture(scope="module")
def few_returns(pairs):
    """The method where so many near returns are found again: fewer than a pose of their own takes."""
    trace = {}
    METHODS["map"](pairs[0], pairs[1], n=N, trace=trace)
    samples, tracks = trace["samples"], trace["tracks"]
    found = tracks.valid & samples.usable & trace["fit"].inlier

    def method(count):
        xyz = torch.where((found & (found.cumsum(1) <= count))[..., None], samples.xyz, torch.nan)
        seen = samples.replace(xyz=xyz)
        return METHODS["map"].replace(n=N, classify=lambda *_: seen, track=lambda *_, hint: tracks)

    return method


def test_a_pose_for_which_nobody_vouches_is_not_used(pairs, few_returns):
    """Without a covariance and with hardly a near return, sigma would be anybody's guess."""
    T = se3.relative(*pairs[3])

    def fit(count, motion, **options):
        trace = {}
        few_returns(count)(
            pairs[0], pairs[1], fit=pose_prior.make_prior(motion, **options).to(torch.float32), trace=trace
        )
        return trace["fit"]

    want = torch.tensor([0.01**2] * 3 + [0.02**2] * 3)
    confirmed = fit(6, T)
    assert confirmed.ok.all() and torch.allclose(confirmed.cov.diagonal(dim1=1, dim2=2).float(), want), "assumed"
    for count, motion in (
        (0, T),
        (3, T),
        (6, T.replace(t=1000 * T.t)),
        (6, se3.invert(T)),
        (0, T.replace(t=1000 * T.t)),
    ):
        for refine in (False, True):
            assert (fit(count, motion, refine=refine).code == PoseCode.TOO_FEW).all(), (count, refine)
    assert fit(0, T, sigma=SIGMA).ok.all(), "it is vouched for"


WRONG = {
    name: (lambda T, M=M: conventions.motion_from_axes(T, tuple(zip(*M, strict=True))))
    for name, M in conventions.CAMERA_AXES.items()
    if name
}
WRONG["the inverse"] = se3.invert
WRONG["millimetres"] = lambda T: T.replace(t=T.t * 1000)
WRONG["centimetres"] = lambda T: T.replace(t=T.t * 100)
WRONG["OpenGL axes (x right, y up, z backward), the inverse"] = lambda T: se3.invert(
    WRONG["OpenGL axes (x right, y up, z backward)"](T)
)


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_pose_is_refuted_and_named(pairs, name):
    estimate, fit, *_ = asked(pairs, pose_prior.make_prior(WRONG[name](se3.relative(*pairs[3]))), "paper")
    assert (fit.code == PoseCode.REFUTED).all() and not fit.ok.any() and fit.T_1_from_0.t.isnan().all()
    assert {conventions.CONVENTIONS[i] for i in fit.matched_convention.tolist()} == {name}
    silent = set(estimate.gate.unique().tolist())
    assert Gate.POSE_REFUTED in silent and not silent - {Gate.NO_TRACK, Gate.NO_TEXTURE, Gate.POSE_REFUTED}


def test_a_pose_that_explains_a_third_of_the_returns_in_some_reading_has_no_name():
    """Twice the motion, the wrong way round: read as the inverse it fits what is far away, and that is not enough."""
    camera = Camera(torch.tensor([[500.0, 500.0]]), torch.tensor([[320.0, 240.0]]))
    g = torch.Generator().manual_seed(0)
    depth = torch.cat((torch.linspace(0.5, 2.0, 39), torch.linspace(20.0, 22.0, 21)))
    xyz = torch.cat((torch.rand(60, 2, generator=g) - 0.5, torch.ones(60, 1)), 1) * depth[:, None]
    T = se3.identity(1, torch.zeros(1)).replace(t=torch.tensor([[0.2, 0.0, 0.0]]))
    uv = cam.project(camera, se3.apply(T, xyz[None]))
    zero = torch.zeros(1, 60)
    samples = Samples(uv, depth[None], 0.001 * depth[None], xyz[None], zero + 1, zero.int(), zero + 1, zero.int())
    tracks = Tracks(uv, uv, zero, zero, torch.eye(2).expand(1, 60, 2, 2), zero == 0)
    found = []
    for factor in (-2, 0.5, -1):
        motion = pose_prior.make_prior(T.replace(t=factor * T.t), sigma=(1e-3, 1e-3))
        found.append(pose_prior.check_pose_prior(motion, samples, tracks, camera, camera, known_pose_fit(T, 60)))
        assert found[-1].code.tolist() == [PoseCode.REFUTED] and not found[-1].inlier.any()
    assert int(found[0].matched_convention) == 0 and int(found[1].n_inlier) == 21
    assert conventions.CONVENTIONS[int(found[2].matched_convention)] == "the inverse"


def test_a_pose_without_translation_or_unknown_is_not_used(pairs):
    T = se3.relative(*pairs[3])
    reference, _, truth, worlds = pairs
    estimate, fit, *_ = asked((reference, reference, truth, worlds), pose_prior.make_prior(se3.identity(3, T.t)))
    assert (fit.code == PoseCode.NO_BASELINE).all() and not estimate.keep.any()
    estimate, fit, *_ = asked(pairs, pose_prior.make_prior(T.replace(t=T.t * torch.nan)))
    assert (fit.code == PoseCode.TOO_FEW).all() and not estimate.keep.any() and (estimate.gate == Gate.NO_POSE).any()


def test_frames_may_carry_the_pose(pairs):
    method = METHODS["paper"].replace(n=N, pose_prior=lambda a, b: pose_prior.priors_from_frames(a, b, sigma=SIGMA))
    placed = [f.replace(T_world_from_cam=T) for f, T in zip(pairs[:2], pairs[3], strict=True)]
    trace = {}
    method(*placed, trace=trace)
    assert torch.allclose(trace["fit"].T_1_from_0.t, se3.relative(*pairs[3]).t.float(), atol=1e-6)
    several = [placed[1], placed[1].replace(T_world_from_cam=pairs[3][0])]
    method.replace(views=2)(placed[0], several, trace=trace)
    codes = [view["fit"].code.tolist() for view in trace["views"]]
    assert codes[0] == [PoseCode.OK] * 3 and PoseCode.OK not in codes[1]
    two = stack([placed[1], placed[1].replace(T_world_from_cam=pairs[3][0])])
    motions = pose_prior.priors_from_frames(placed[0], two).T_1_from_0
    assert motions.t.shape == (2, 3, 3) and not motions.t[1].any()
    torch.testing.assert_close(motions.t[0], se3.relative(*pairs[3]).t.float())
    with pytest.raises(ValueError, match="T_world_from_cam is absent"):
        method(placed[0], pairs[1].replace(T_world_from_cam=None))
    with pytest.raises(ValueError, match=r"given.sigma: found \(1,\)"):
        pose_prior.priors_from_frames(*placed, sigma=(1,))


# ---------------------------------------------------------------------------------------------------- in samples


@pytest.fixture
def sample():
    poses = se3.to_matrix(room().true_poses)
    both = {"pose": poses[GAP].numpy(), "pose_before": poses[0].numpy()}
    return {**frames()[GAP], "before": frames()[0]["image"], **both}


def transform(**options):
    keys = {"pose": "pose", "other_pose": "pose_before"}
    return ExtendDepth(**{"depth_unit": "mm", "other_image": "before", "n": 256, **keys, **options})


def film(sample, T):
    """Both frames as one film, with poses of the world's first camera."""
    image = torch.stack((torch.as_tensor(sample["before"]), torch.as_tensor(sample["image"])))
    one = {k: v for k, v in sample.items() if "before" not in k}
    return one | {"image": image, "pose": torch.linalg.inv(torch.stack((T, torch.eye(4))).double())}


GL = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
RELATIVE = {"pose_kind": "1_from_0", "other_pose": None}


@pytest.mark.parametrize(
    ("stated", "options"),
    [
        (lambda s, T: s, {}),
        (lambda s, T: s | {k: s[k] @ GL.numpy() for k in ("pose", "pose_before")}, {"pose_axes": "gl"}),
        (lambda s, T: s | {"pose": T[:3].numpy()}, RELATIVE),
        (lambda s, T: s | {"pose": GL.float() @ T @ GL.float()}, RELATIVE | {"pose_axes": "gl"}),
        (lambda s, T: s | {"pose": T[:3] * torch.tensor([1, 1, 1, 1000.0])}, RELATIVE | {"pose_unit": "mm"}),
        (film, {"other_image": None, "other_pose": None}),
    ],
)
def test_samples_state_poses_in_many_ways(sample, stated, options):
    T = se3.to_matrix(se3.relative(room().true_poses[GAP : GAP + 1], room().true_poses[:1]))[0].float()
    found = transform(**options)(stated(sample, T))
    torch.testing.assert_close(found["dhtorch.T_1_from_0"], T, atol=1e-5, rtol=0)
    assert found["dhtorch.pose_ok"] and found.get("dhtorch.pose_convention", 0) == 0


def test_samples_state_covariances(sample):
    two = transform(pose_cov=(0.01, 0.02))(sample)
    torch.testing.assert_close(two["dhtorch.pose_cov"].diagonal(), torch.tensor([1e-4] * 3 + [4e-4] * 3))
    assert not transform(pose_cov=(0.0, 0.0))(sample)["dhtorch.pose_cov"].any(), "known exactly"
    sample["cov"] = torch.diag(torch.tensor([0.5e-4] * 3 + [2e-4] * 3)).numpy()
    each = transform(pose_cov="cov")(sample)["dhtorch.pose_cov"]
    assert each.diagonal()[:3].sum() == pytest.approx(3e-4, rel=1e-4), "two cameras, two errors"
    kept = transform(pose_cov="cov", pose_kind="1_from_0", other_pose=None)
    sample["pose"] = torch.eye(4)
    sample["pose"][0, 3] = 5.0
    with pytest.warns(UserWarning, match="near returns contradict the pose"):
        assert kept(sample)["dhtorch.pose_code"] == PoseCode.REFUTED


def test_a_wrong_pose_in_a_sample_is_named(sample):
    sample |= {
        "pose": torch.linalg.inv(torch.as_tensor(sample["pose"])),
        "pose_before": torch.linalg.inv(torch.as_tensor(sample["pose_before"])),
    }
    with pytest.warns(UserWarning, match="pose: the near returns contradict the pose; looks like the inverse"):
        out = transform()(sample)
    assert conventions.CONVENTIONS[out["dhtorch.pose_convention"]] == "the inverse" and not out["dhtorch.pose_ok"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda T: T * torch.tensor([-1.0, 1, 1, 1]), "a reflection: are the axes left-handed"),
        (lambda T: T * 2, "found no rotation"),
        (lambda T: T.T, "is the matrix transposed"),
        (lambda T: T[:, :2], "expected 3x4 or 4x4"),
        (lambda T: T.flatten(), "expected 3x4 or 4x4"),
    ],
)
def test_what_is_no_pose_is_refused(sample, change, said):
    sample["pose"] = change(torch.as_tensor(sample["pose"]).float())
    with pytest.raises(SampleError, match=said):
        transform()(sample)
    with pytest.warns(UserWarning, match="flagged"):
        blank = transform(on_error="flag")(sample)
    assert not blank["dhtorch.valid"].any() and blank["dhtorch.pose_convention"] == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"pose_kind": "0_from_1"}, "pose_kind"),
        ({"pose_axes": "unity"}, "pose_axes"),
        ({"pose_unit": "inch"}, "pose_unit"),
        ({"pose_cov": (1.0,)}, "pose_cov"),
        ({"other_pose": None}, "expected other_pose"),
        ({"pose": torch.eye(4).tolist(), "other_pose": None}, "pose: found pose_kind"),
        ({"pose": None}, "other_pose without pose"),
    ],
)
def test_options_that_cannot_be(options, said):
    with pytest.raises(ValueError, match=said):
        transform(**options)


def test_a_gap_brings_the_pose_along():
    poses = se3.to_matrix(room().true_poses)
    items = [{**frame, "pose": T} for frame, T in zip(frames(), poses, strict=True)]
    data = ExtendedDataset(items, transform(), gap=GAP)
    assert data[GAP]["dhtorch.pose_ok"] and not {"before", "pose_before"} & data[GAP].keys()
    assert not data[1]["dhtorch.pose_ok"] and data[1]["dhtorch.gate"].unique().tolist() == [Gate.NO_TRACK]


@pytest.mark.parametrize(("deviation", "refuted"), [(0.9, False), (1.1, True)])
def test_the_standard_deviation_of_a_fit_counts_threefold(deviation, refuted):
    """A given pose is refuted beyond 4.74 deviations of both, that of near returns taken three times."""
    sigma, draw = 1e-3, torch.Generator().manual_seed(0)
    camera = Camera(torch.tensor([[500.0, 500.0]]).double(), torch.tensor([[320.0, 240.0]]).double())
    z = 1 + torch.rand(1, 40, generator=draw).double()
    uv = torch.rand(1, 40, 2, generator=draw).double() * torch.tensor([600.0, 440.0])
    xyz = cam.unproject(camera, uv, z)
    own = se3.exp(torch.tensor([[0.01, -0.02, 0.005, 0.2, 0.01, -0.03]]).double())
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    samples = Samples(uv, z, 0.01 * z, xyz, one, zero.int(), one, zero.int())
    uv_1 = cam.project(camera, se3.apply(own, xyz))
    tracks = Tracks(uv, uv_1, zero, zero, torch.eye(2).double().expand(1, 40, 2, 2), one > 0)
    numbers = [
        torch.tensor([40]),
        *(torch.tensor([x]).double() for x in (0.5, 0.5, 100.0)),
        torch.tensor([PoseCode.OK]),
    ]
    fit = PoseFit(own, sigma**2 * torch.eye(6).double()[None], one > 0, *numbers)
    xi = torch.zeros(1, 6).double()
    xi[0, 4] = deviation * 4.74 * 3 * sigma
    prior = make_prior(se3.compose(se3.exp(xi), own), cov=torch.full((1, 6, 6), 0.0).double() + 1e-12 * torch.eye(6))
    checked = check_pose_prior(prior, samples, tracks, camera, camera, fit, max_residual=0.1)
    assert (int(checked.code) == PoseCode.REFUTED) == refuted
    assert refuted or int(checked.code) == PoseCode.OK


def test_each_of_two_poses_has_its_own_covariance():
    """Of every member of a batch and both frames, the covariance that stands beside the pose."""
    draw = torch.Generator().manual_seed(0)
    motion = se3.exp(0.2 * torch.rand(4, 6, generator=draw).double())
    worlds = se3.to_matrix(motion).view(2, 2, 4, 4)  # (batch, time)
    root = torch.rand(2, 2, 6, 6, generator=draw).double()
    covs = root @ root.mT
    values = {"pose": worlds, "cov": covs}
    leaves = SimpleNamespace(sample=values, get=values.get, dtype=torch.float64, like=worlds)
    options = {"cov": "cov", "kind": "world_from_cam", "axes": "cv", "unit": 1.0, "refine": False}
    prior = poses.read_pose_priors(leaves, (1, [0]), (2, 2), [], keys=("pose", None), **options)[0]
    for b in range(2):
        world_0, world_1 = (se3.from_matrix(worlds[b : b + 1, at]) for at in (1, 0))
        expected = conventions.relative_covariance(world_1, covs[b : b + 1, 1], covs[b : b + 1, 0])
        torch.testing.assert_close(prior.cov[b : b + 1], expected)
        torch.testing.assert_close(prior.T_1_from_0.t[b : b + 1], se3.relative(world_0, world_1).t)
