"""The method on kornia: which of its functions run, exact gradients, and the independent implementation beside PAPER."""

import pytest
import torch
from support.contract_inputs import shifted, tracked
from support.rooms import room
from support.textures import waves
from torch.autograd import gradcheck

from dhtorch import KORNIA, PAPER
from dhtorch.codes import Flag, Gate, PoseCode
from dhtorch.geometry.camera import resize
from dhtorch.metrics import holdout
from dhtorch.pipeline.pair import uniform_draws
from dhtorch.records import Camera, Frame, Pose
from dhtorch.stages.kornia.backproject import backproject_kornia
from dhtorch.stages.kornia.holes import classify_kornia
from dhtorch.stages.kornia.pose import pnp_ransac_kornia
from dhtorch.stages.kornia.track import lucas_kanade_kornia
from dhtorch.stages.kornia.triangulate import two_view_kornia

D = torch.float64
N = 384


def views(dtype=torch.float32, near=2.0, numbers=(0, 16)):
    """Two frames of a room of 120 × 160 pixels with a short-range sensor."""
    recording = room(seed=2, hw=(120, 160), path="orbit", n_frames=17, lidar="exact")
    frames = [holdout.range_split(recording[k], near).to(dtype) for k in numbers]
    return [f.replace(image=f.image.to(dtype) / 255) for f in frames]


def answer(method, frames):
    trace = {}
    method(*frames, n=N, trace=trace)
    return trace


@pytest.fixture(scope="module")
def pair():
    return views()


@pytest.fixture(scope="module")
def both(pair):
    return answer(PAPER, pair), answer(KORNIA, pair)


# ------------------------------------------------------------------------------------------------ beside PAPER


def test_samples_are_those_of_paper(both):
    """Same pixels, returns, points, flags and confidence; trackability differs by its window, and with it some holes."""
    paper, kornia = (trace["samples"] for trace in both)
    for field in ("uv", "depth", "sigma", "confidence"):
        torch.testing.assert_close(getattr(kornia, field), getattr(paper, field), msg=field)
    torch.testing.assert_close(kornia.xyz, paper.xyz, equal_nan=True)
    assert torch.equal(kornia.usable, paper.usable) and (kornia.flag == paper.flag).float().mean() > 0.99
    assert (kornia.hole == paper.hole).float().mean() > 0.95
    ratio = (kornia.trackability / paper.trackability.clamp_min(1e-12)).log()
    assert (
        ratio.median().abs() < 1
        and torch.corrcoef(torch.stack((kornia.trackability[0], paper.trackability[0])))[0, 1] > 0.5
    )


@pytest.mark.parametrize("own_camera", [False, True])
def test_returns_of_sparse_maps_confidence_and_a_lens_are_read_as_by_paper(own_camera):
    draw = torch.Generator().manual_seed(0)
    depth = torch.rand(2, 45, 60, generator=draw, dtype=D) + 1
    depth = torch.where(torch.rand(2, 45, 60, generator=draw) < 0.05, depth, 0.0)
    lens = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=D).expand(2, -1)
    camera = Camera(torch.full((2, 2), 70.0, dtype=D), torch.tensor([[39.5, 29.5]], dtype=D).expand(2, 2), lens)
    frame = Frame(
        (255 * torch.rand(2, 3, 60, 80, generator=draw)).byte(),
        depth,
        camera,
        depth_camera=resize(camera.replace(distortion=None), (60, 80), (45, 60)) if own_camera else None,
        conf=torch.randint(0, 3, (2, 45, 60), generator=draw, dtype=torch.uint8),
        sparse=torch.tensor([True, False]),
    )
    uv = torch.rand(2, 300, 2, generator=draw, dtype=D) * torch.tensor([86.0, 66.0]) - 3
    options = {"near_limit": 1.8, "min_conf": 1, "sigma_m": 0.01}
    paper, kornia = PAPER.backproject(frame, uv, **options), backproject_kornia(frame, uv, **options)
    assert paper.usable[0].float().mean() > 0.2 > paper.usable[1].float().mean() > 0
    for field in ("depth", "sigma", "xyz"):
        torch.testing.assert_close(getattr(kornia, field), getattr(paper, field), equal_nan=True, msg=field)
    inner = ((uv > 6) & (uv < torch.tensor([73.0, 53.0]))).all(-1)  # windows end at the border, PAPER's move inside
    assert inner.float().mean() > 0.5
    assert torch.equal(kornia.flag[inner], paper.flag[inner]) and torch.equal(
        kornia.confidence[inner], paper.confidence[inner]
    )
    returns = Flag.NO_DEPTH | Flag.LOW_CONF | Flag.BEYOND_NEAR | Flag.BORDER
    assert torch.equal(kornia.flag & returns, paper.flag & returns)


def test_tracks_are_those_of_paper(both):
    paper, kornia = (trace["tracks"] for trace in both)
    valid = paper.valid & kornia.valid
    assert (paper.valid == kornia.valid).float().mean() > 0.9 and valid.float().mean() > 0.5
    assert (paper.uv_1 - kornia.uv_1)[valid].norm(dim=-1).median() < 0.02
    for field in ("photometric", "cov"):
        a, b = (
            getattr(x, field)[valid].flatten(1) if field == "cov" else getattr(x, field)[valid] for x in (paper, kornia)
        )
        assert ((a - b).abs() / a.abs().clamp_min(1e-6)).median() < 0.1, field


def test_the_pose_from_papers_tracks_is_papers(pair, both):
    """The same near points: both end at the same minimum, and state the same covariance and scale."""
    samples, tracks = both[0]["samples"], both[0]["tracks"]
    args = samples, tracks, pair[0].camera, pair[1].camera, uniform_draws(0, 1, 200).float()
    paper, kornia = PAPER.pose(*args), pnp_ransac_kornia(*args)
    sigma = paper.cov.diagonal(dim1=1, dim2=2).sqrt()
    turn = (kornia.T_1_from_0.R @ paper.T_1_from_0.R.mT)[0]
    angles = torch.stack((turn[2, 1], turn[0, 2], turn[1, 0]))  # small
    assert (paper.inlier == kornia.inlier).float().mean() > 0.99
    assert (angles.abs() < sigma[0, :3]).all()
    assert ((paper.T_1_from_0.t - kornia.T_1_from_0.t).abs() < sigma[:, 3:]).all()
    for field in ("cov", "sigma_px", "rms_px", "t_snr", "n_inlier"):
        a, b = getattr(paper, field).double(), getattr(kornia, field).double()
        assert (a - b).abs().max() < 0.15 * a.abs().max(), field


def test_triangulation_is_papers_to_rounding():
    samples, tracks, fit, *cameras = tracked(3, 40, D, noise=6.0)
    fit = fit.replace(code=torch.tensor([PoseCode.OK, PoseCode.OK, PoseCode.MISALIGNED], dtype=torch.int32))
    tracks = tracks.replace(valid=torch.arange(40).expand(3, -1) % 7 > 0)
    paper, kornia = (m.triangulate(samples, tracks, fit, *cameras) for m in (PAPER, KORNIA))
    assert torch.equal(paper.gate, kornia.gate) and torch.equal(paper.n_views, kornia.n_views)
    assert {int(g) for g in paper.gate.unique()} >= {Gate.ANSWER, Gate.NO_TRACK, Gate.RESIDUAL, Gate.MISALIGNED}
    for field in ("depth", "sigma", "sigma_shared", "score"):
        torch.testing.assert_close(getattr(kornia, field), getattr(paper, field), equal_nan=True, rtol=1e-9, atol=0)
    for field in ("parallax_deg", "residual_px"):
        in_front = (paper.gate == Gate.ANSWER) | (paper.gate == Gate.RESIDUAL)
        torch.testing.assert_close(
            getattr(kornia, field)[in_front], getattr(paper, field)[in_front], rtol=1e-9, atol=1e-9
        )


# ------------------------------------------------------------------------------------------------ gradients


def test_gradients_of_backproject_and_classify_are_exact():
    draw = torch.Generator().manual_seed(0)
    image, depth = torch.rand(1, 3, 24, 32, generator=draw, dtype=D), 1 + torch.rand(1, 12, 16, generator=draw, dtype=D)
    camera = Camera(torch.tensor([[30.0, 31.0]], dtype=D), torch.tensor([[16.0, 12.0]], dtype=D))
    uv = 4 + 16 * torch.rand(1, 5, 2, generator=draw, dtype=D)

    def points(depth, f, c, uv):
        samples = backproject_kornia(Frame(image, depth, Camera(f, c)), uv)
        return samples.xyz, samples.depth, samples.sigma

    assert gradcheck(points, [x.clone().requires_grad_() for x in (depth, camera.f, camera.c, uv)])

    def trackability(image):
        frame = Frame(image, depth, camera)
        return classify_kornia(frame, backproject_kornia(frame, uv)).trackability

    assert gradcheck(trackability, [image.clone().requires_grad_()], fast_mode=True)


@pytest.mark.parametrize("wanted", ["points", "images"])
def test_gradients_of_the_tracks_are_exact(wanted):
    """At the converged position; the derivative includes that of the template's gradient."""
    images = waves(1, 60, 70, shortest=9.0), waves(1, 60, 70, (1.3, -0.9), shortest=9.0)
    uv = torch.tensor([[[30.3, 25.2], [22.3, 40.6]]], dtype=D)
    options = {"window": 9, "levels": 2, "iterations": 50, "epsilon_px": 1e-12}
    inputs = [
        x.clone().requires_grad_(one == wanted)
        for x, one in zip((*images, uv), ("images", "images", "points"), strict=True)
    ]
    assert lucas_kanade_kornia(*inputs, **options).valid.all()
    assert gradcheck(
        lambda *x: lucas_kanade_kornia(*x, **options).uv_1, inputs, atol=1e-5, fast_mode=wanted == "images"
    )


def test_gradients_of_the_pose_are_exact():
    samples, tracks, _, camera_0, camera_1 = tracked(2, 12, D, noise=0.1)
    draws = uniform_draws(0, 2, 8)

    def pose(xyz, uv_1, f, c):
        seen = samples.replace(xyz=xyz), tracks.replace(uv_1=uv_1), camera_0, Camera(f, c)
        T = pnp_ransac_kornia(*seen, draws, steps=6).T_1_from_0
        return T.R, T.t

    inputs = (samples.xyz, tracks.uv_1, camera_1.f, camera_1.c)
    assert gradcheck(pose, [x.clone().requires_grad_() for x in inputs], atol=1e-5, fast_mode=True)


def test_gradients_of_the_triangulation_are_exact():
    samples, tracks, fit, camera_0, camera_1 = tracked(1, 8, D)
    T, cov_pose = fit.T_1_from_0, 1e4 * fit.cov  # large beside the step of the numerical derivative

    def estimate(uv_0, uv_1, f_0, f_1, c_1, R, t, cov, cov_pose):
        seen = tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov), fit.replace(T_1_from_0=Pose(R, t), cov=cov_pose)
        e = two_view_kornia(samples, *seen, Camera(f_0, camera_0.c), Camera(f_1, c_1))
        return e.depth, e.sigma, e.sigma_shared, e.parallax_deg, e.residual_px

    inputs = (tracks.uv_0, tracks.uv_1, camera_0.f, camera_1.f, camera_1.c, T.R, T.t, tracks.cov, cov_pose)
    assert gradcheck(estimate, [x.clone().requires_grad_() for x in inputs], atol=1e-5, fast_mode=True)


# ------------------------------------------------------------------------------------------------ rare inputs


def test_a_pair_without_a_pose_has_papers_code():
    samples, tracks, _, *cameras = tracked(5, 30, D)
    line = samples.xyz.clone()
    line[1] = torch.linspace(0.5, 2, 30, dtype=D)[:, None] * torch.tensor([0.1, 0.2, 1.0], dtype=D) + 1
    valid = tracks.valid.clone()
    valid[2], valid[3, 5:] = False, False
    samples, tracks = samples.replace(xyz=line), tracks.replace(valid=valid)
    codes = [pose(samples, tracks, *cameras, uniform_draws(0, 5, 64)).code for pose in (PAPER.pose, KORNIA.pose)]
    assert torch.equal(*codes) and codes[1].tolist() == [PoseCode.OK, PoseCode.DEGENERATE, *[PoseCode.TOO_FEW] * 2, 0]


def test_points_outside_the_picture_stay_where_the_search_would_begin():
    image_0, image_1, uv = shifted(2, 6, D)
    uv[0, 0], uv[0, 1], uv[1, 2] = torch.tensor([-40.0, 10.0]), torch.nan, torch.tensor([torch.inf, 5.0])
    paper, kornia = (track(image_0, image_1, uv, window=9, levels=2) for track in (PAPER.track, lucas_kanade_kornia))
    outside = torch.tensor([[1, 1, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]]).bool()
    assert not kornia.valid[outside].any() and kornia.valid[~outside].float().mean() > 0.5
    assert torch.equal(kornia.uv_1[outside], paper.uv_1[outside])
    assert all(x.isfinite().all() for x in (kornia.uv_1, kornia.error, kornia.photometric, kornia.cov))
