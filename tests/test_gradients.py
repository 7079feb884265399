"""Gradients through the stages: what they recover, and that compiled graphs, vmap, forward and reverse mode agree."""

import shutil
from functools import partial

import pytest
import torch
from support.contract_inputs import shifted, tracked
from support.contract_rows import leaves, tensor_map
from torch.func import jacfwd, jacrev, vmap
from torch.utils import _pytree as torch_pytree

from dhtorch import MAP, PAPER, extend
from dhtorch.metrics import holdout
from dhtorch.pipeline.pair import merge, undistort_tracks
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Camera
from dhtorch.stages import backproject, holes, pose, score, track, triangulate
from dhtorch.synthetic.recording import SyntheticRoom

D = torch.float64
N = 256


def room(seed=2, **options):
    return SyntheticRoom(
        **{"seed": seed, "hw": (120, 160), "path": "orbit", "n_frames": 17, "lidar": "exact", **options}
    )


def views(recording, *numbers, near=2.0, dtype=D):
    """Frames of a room with a short-range sensor and a picture that can carry a gradient."""
    frames = [holdout.range_split(recording[k], near).to(dtype) for k in numbers]
    return [f.replace(image=f.image.to(dtype) / 255) for f in frames]


@pytest.fixture(scope="module")
def pair():
    return views(room(), 0, 16)


@pytest.fixture(scope="module")
def trace(pair):
    trace = {}
    METHODS["map"](*pair, n=N, trace=trace)
    assert int(trace["estimate"].keep.sum()) > 100 and bool(trace["fit"].ok)
    return trace


@pytest.fixture(scope="module")
def stages(pair, trace):
    """Name → (function, arguments): every stage on what the stages before it found."""
    frame, other = pair
    samples, tracks, fit, estimate = (trace[k] for k in ("samples", "tracks_ideal", "fit", "estimate"))
    draws = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(0), dtype=D)
    posing = samples, tracks, frame.camera, other.camera, draws
    geometry = samples, tracks, fit, frame.camera, other.camera
    scorer = score.LearnedScore(seed=1)
    torch.nn.init.normal_(scorer.last, std=0.1, generator=torch.Generator().manual_seed(0))
    lens = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=D)
    bent = [f.camera.replace(distortion=lens) for f in pair]
    return {
        "backproject": (backproject.backproject, (frame, samples.uv)),
        "classify": (holes.classify, (frame, samples)),
        "lucas_kanade": (track.lucas_kanade, (frame.image, other.image, samples.uv)),
        "lucas_kanade_affine": (track.lucas_kanade_affine, (frame.image, other.image, samples.uv)),
        "undistort_tracks": (undistort_tracks, (tracks, *bent)),
        "pnp_ransac": (pose.pnp_ransac, posing),
        "map_pose": (pose.map_pose, posing),
        "two_view": (triangulate.two_view, geometry),
        "two_view of map": (METHODS["map"].triangulate, geometry),
        "rank": (score.confidence, (estimate, samples, tracks, fit)),
        "rank_by_error": (score.confidence_from_error, (estimate, samples, tracks, fit)),
        "learned_score": (scorer, (estimate, samples, tracks, fit)),
        "merge": (merge, (samples, estimate)),
        "extend": (partial(extend, n=N), tuple(pair)),
        "map": (partial(METHODS["map"], n=N), tuple(pair)),
    }


def with_gradients(fn, args):
    """What ``fn`` returns, and the gradients of a weighted sum of all its finite values to every floating input."""
    flat, spec = torch_pytree.tree_flatten(args)
    floating = [isinstance(x, torch.Tensor) and x.is_floating_point() for x in flat]
    flat = [x.detach().clone().requires_grad_() if f else x for x, f in zip(flat, floating, strict=True)]
    out = fn(*torch_pytree.tree_unflatten(flat, spec))
    total = sum(
        (torch.where(x.isfinite(), x, 0) * torch.linspace(0.5, 1.5, x.numel(), dtype=x.dtype).view(x.shape)).sum()
        for x in leaves(out)
        if x.requires_grad
    )
    inputs = [x for x, f in zip(flat, floating, strict=True) if f]
    return out, torch.autograd.grad(total, inputs, allow_unused=True)


# ------------------------------------------------------------------------------------------------ one graph


CHEAP = ("learned_score", "merge")
MORE = ("two_view of map", "backproject", "classify", "undistort_tracks", "two_view", "rank", "rank_by_error")
LARGE = ("lucas_kanade", "lucas_kanade_affine", "pnp_ransac", "map_pose", "extend", "map")


def agrees_when_compiled(fn, args, backend, atol=1e-12):
    torch._dynamo.reset()
    plain, gradients = with_gradients(fn, args)
    compiled, again = with_gradients(torch.compile(fn, fullgraph=True, backend=backend), args)
    for x, y in zip(leaves(plain), leaves(compiled), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-9, atol=atol, equal_nan=True)
    assert any(g is not None for g in gradients)
    for g, h in zip(gradients, again, strict=True):
        assert (g is None) == (h is None)
        if g is not None:
            assert g.isfinite().all()
            torch.testing.assert_close(g, h, rtol=1e-9, atol=atol * float(1 + g.abs().max()))


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", [*CHEAP, *MORE, *LARGE])
def test_every_stage_and_whole_methods_compile_as_one_graph_with_equal_gradients(stages, name):
    """(That their values capture is tested for every stage in ``test_contract.py``.)"""
    agrees_when_compiled(*stages[name], "aot_eager")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.parametrize("name", ["backproject", "two_view of map", "rank_by_error", "learned_score"])
def test_inductor_agrees(stages, name):
    agrees_when_compiled(*stages[name], "inductor", atol=1e-9)


# ------------------------------------------------------------------------------- forward, reverse, differences


def exact(batch, n=24):
    """Samples, exact tracks, cameras and draws: the residuals are zero, so the pose's derivative is exact."""
    samples, tracks, _, camera_0, camera_1 = tracked(batch, n, D, noise=0.0)
    draws = torch.rand(1, 8, 3, generator=torch.Generator().manual_seed(9), dtype=D)  # one triple is nearly singular
    return samples, tracks, camera_0, camera_1, draws.expand(batch, 8, 3)


DIRECTIONS = torch.randn(3 * 24 + 8, 5, generator=torch.Generator().manual_seed(5), dtype=D)


def moved(q, samples, tracks, camera_0, camera_1, draws):
    """Near points, tracks and intrinsics of both views, moved along five fixed random directions by q (5,)."""
    n, shift = samples.depth.shape[1], DIRECTIONS @ q
    pixels, share, lens = shift[: 2 * n].view(n, 2), shift[2 * n : 3 * n, None], shift[3 * n :]
    first = Camera(camera_0.f + lens[:2], camera_0.c + lens[2:4])
    second = Camera(camera_1.f + lens[4:6], camera_1.c + lens[6:])
    return (
        samples.replace(xyz=samples.xyz * (1 + share)),
        tracks.replace(uv_1=tracks.uv_1 + pixels),
        first,
        second,
        draws,
    )


def posed(fn):
    def of(*args):
        fit = fn(*moved(*args))
        return torch.cat((fit.T_1_from_0.R.flatten(1), fit.T_1_from_0.t), 1)

    return of


def recovered(*args):
    """Everything behind the tracker: the recovered part of the map."""
    samples, tracks, first, second, draws = moved(*args)
    fit = pose.pnp_ransac(samples, tracks, first, second, draws)
    estimate = triangulate.two_view(samples, tracks, fit, first, second, min_parallax_deg=None)
    return merge(samples.replace(xyz=samples.xyz * torch.nan), estimate).depth


WHOLE = {
    "pnp_ransac": posed(pose.pnp_ransac),
    "map_pose": posed(partial(pose.map_pose, shutter_sigma=0.0, isotropic=1.0)),
    "pose, two_view, merge": recovered,
}


@pytest.mark.parametrize("name", WHOLE)
def test_forward_reverse_and_finite_differences_agree(name):
    """With respect to near points, tracks and intrinsics of both views at once, for a batch of pairs under vmap."""
    arguments = exact(2)

    def one(q, args):
        return WHOLE[name](q, *tensor_map(lambda v: v[None], args))[0]

    zero = torch.zeros(5, dtype=D)
    found = one(zero, tensor_map(lambda v: v[0], arguments))
    assert found.isfinite().all() and (found != 0).sum() >= 10
    reverse = vmap(jacrev(one), in_dims=(None, 0))(zero, arguments)
    forward = vmap(jacfwd(one), in_dims=(None, 0))(zero, arguments)
    torch.testing.assert_close(reverse, forward, rtol=1e-6, atol=1e-8)
    h = 1e-6
    for b in range(2):
        args = tensor_map(lambda v, b=b: v[b], arguments)
        numeric = torch.stack([(one(h * e, args) - one(-h * e, args)) / (2 * h) for e in torch.eye(5, dtype=D)], -1)
        assert numeric.abs().max() > 1e-3
        torch.testing.assert_close(reverse[b], numeric, rtol=1e-3, atol=1e-4 * float(numeric.abs().max()))


def test_the_tracker_in_forward_and_reverse_mode():
    """Forward mode differentiates the search, reverse mode its last step, whose Hessian is an approximation."""
    image_0, image_1, uv = shifted(2, 6, D)
    ramp = torch.linspace(0, 1, image_1.shape[-1], dtype=D)

    fine = partial(track.lucas_kanade, epsilon_px=1e-9, iterations=60)

    def of(light, first, second, at):
        return fine(first[None], (second * (1 + light * ramp))[None], at[None]).uv_1[0]

    zero, h = torch.zeros((), dtype=D), 1e-5
    reverse = vmap(jacrev(of), in_dims=(None, 0, 0, 0))(zero, image_0, image_1, uv)
    forward = vmap(jacfwd(of), in_dims=(None, 0, 0, 0))(zero, image_0, image_1, uv)
    ahead, back = (fine(image_0, image_1 * (1 + light * ramp), uv).uv_1 for light in (h, -h))
    numeric = (ahead - back) / (2 * h)
    assert float(numeric.abs().max()) > 0.01
    torch.testing.assert_close(forward, numeric, rtol=1e-2, atol=1e-3)
    cosine = torch.nn.functional.cosine_similarity(reverse.flatten(), numeric.flatten(), dim=0)
    assert float(cosine) > 0.9


# ------------------------------------------------------------------------------------------ where gradients go


@pytest.mark.parametrize("name", ["extend", "map"])
def test_gradients_reach_everything_a_pair_is_made_of(pair, name):
    parts = {
        "image 0": pair[0].image,
        "image 1": pair[1].image,
        "near depth": pair[0].depth,
        "f 0": pair[0].camera.f,
        "c 0": pair[0].camera.c,
        "f 1": pair[1].camera.f,
        "c 1": pair[1].camera.c,
        "depth f": pair[0].camera.f,
        "depth c": pair[0].camera.c,
    }
    given = {k: v.detach().clone().requires_grad_() for k, v in parts.items()}
    image_0, image_1, depth, f_0, c_0, f_1, c_1, *own = given.values()
    first = pair[0].replace(image=image_0, depth=depth, camera=Camera(f_0, c_0), depth_camera=Camera(*own))
    estimate = METHODS["map" if name == "map" else "paper"](
        first, pair[1].replace(image=image_1, camera=Camera(f_1, c_1)), n=N
    )
    far = estimate.keep & (estimate.depth > 2)
    torch.where(far, estimate.depth, 0).sum().backward()
    for k, v in given.items():
        if k.startswith("depth "):  # they only choose the pixel that is read
            assert v.grad is None or not v.grad.any(), k
        else:
            assert v.grad is not None and v.grad.isfinite().all() and v.grad.abs().max() > 0, k


@pytest.mark.parametrize("name", [*CHEAP, *MORE, *LARGE])
def test_points_without_an_answer_pass_no_nan(stages, name):
    """Half of the points are spoilt (no number, no track, no return): gradients stay finite everywhere."""
    fn, args = stages[name]

    def spoil(x):
        if not (isinstance(x, torch.Tensor) and x.dim() > 1 and x.shape[1] == N):
            return x
        odd = (torch.arange(N) % 2 == 1).view(1, N, *[1] * (x.dim() - 2))
        if x.dtype == torch.bool:
            return x & ~odd
        return torch.where(odd, torch.nan, x) if x.is_floating_point() else x

    spoilt = torch_pytree.tree_map(spoil, args)
    if name in ("extend", "map"):
        hollow = args[0].depth.clone()
        hollow[..., ::2] = 0
        spoilt = (args[0].replace(depth=hollow), args[1])
    _, gradients = with_gradients(fn, spoilt)
    some = [g for g in gradients if g is not None]
    assert some and all(g.isfinite().all() for g in some) and any(g.any() for g in some)


@pytest.mark.parametrize("name", ["paper", "map"])
def test_a_pair_without_any_answer_has_finite_gradients(pair, name):
    """No return, no pose: silence is no NaN to whoever learns from many pairs at once."""
    depth = torch.zeros_like(pair[0].depth).requires_grad_()
    image = pair[0].image.clone().requires_grad_()
    estimate = METHODS[name](pair[0].replace(depth=depth, image=image), pair[1], n=64)
    assert not estimate.keep.any()
    total = sum(torch.where(x.isfinite(), x, 0).sum() for x in leaves(estimate) if x.requires_grad)
    for x in torch.autograd.grad(total, (depth, image), allow_unused=True):
        assert x is None or x.isfinite().all()


# ------------------------------------------------------------------------------------------------ half precision


@pytest.fixture(scope="module")
def single():
    """Frames in single precision and the estimate of each method."""
    frames = [f.to(torch.float32) for f in views(room(), 0, 16)]
    return frames, {name: METHODS[name](*frames, n=N) for name in ("paper", "map")}


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize(
    ("name", "what"), [("map", "image"), ("map", "depth"), ("map", "camera"), ("map", "all"), ("paper", "all")]
)
def test_half_precision_is_lifted_where_it_is_read(single, name, what, dtype):
    change = {
        "image": lambda f: f.replace(image=f.image.to(dtype)),
        "depth": lambda f: f.replace(depth=f.depth.to(dtype)),
        "camera": lambda f: f.replace(camera=f.camera.to(dtype), depth_camera=f.depth_camera.to(dtype)),
        "all": lambda f: f.to(dtype),
    }[what]
    frames, known = single
    trace = {}
    half = METHODS[name](*map(change, frames), n=N, trace=trace)
    for record in (half, trace["samples"], trace["tracks"], trace["fit"]):
        assert all(x.dtype == torch.float32 for x in leaves(record) if x.is_floating_point())
    both = half.keep & known[name].keep
    assert int(both.sum()) > 0.95 * int(known[name].keep.sum()) and half.depth[half.keep].isfinite().all()
    error = ((half.depth - known[name].depth).abs() / known[name].depth)[both]
    assert float(error.median()) < (0.004 if dtype == torch.bfloat16 else 0.002)


# --------------------------------------------------------------------------------------------- what they recover


@pytest.mark.parametrize("method", [PAPER, MAP], ids=["paper", "map"])
def test_the_whole_line_has_the_derivative_of_its_answers(method):
    """Far depth is as long as the near ruler, and moves with the intrinsics as it does between two runs."""
    room = SyntheticRoom(n_frames=12, hw=(120, 160), depth_hw=(120, 160), lidar="exact", image_noise=0.0)
    views = [holdout.range_split(room[i], 2.0).to(torch.float64) for i in (3, 11)]
    method = method.replace(n=384)

    def ask(near, focal):
        asked = (v.replace(depth=near * v.depth, camera=v.camera.replace(f=focal * v.camera.f)) for v in views)
        return method(*asked, trace=trace)

    trace = {}
    near, focal = (torch.ones((), dtype=torch.float64, requires_grad=True) for _ in range(2))
    found = ask(near, focal)
    t, keep = trace["fit"].T_1_from_0.t[0], found.keep[0].nonzero()[:, 0]
    length = (t.detach() @ t) / t.detach().square().sum()
    assert float(torch.autograd.grad(length, near, retain_graph=True)[0]) == pytest.approx(1, abs=0.02)
    slopes = [torch.autograd.grad(found.depth[0, i].log(), near, retain_graph=True)[0] for i in keep[::20]]
    torch.testing.assert_close(torch.stack(slopes), torch.ones(len(slopes), dtype=torch.float64), rtol=0, atol=0.05)
    if method.pose is MAP.pose:  # where the set of inliers does not jump
        ask(torch.ones(()), torch.tensor(1 + 1e-5, dtype=torch.float64))
        moved = (trace["fit"].T_1_from_0.t[0] - t).detach() / 1e-5
        slope = torch.stack([torch.autograd.grad(x, focal, retain_graph=True)[0] for x in t])
        torch.testing.assert_close(slope, moved, rtol=0, atol=0.02 * float(moved.norm()))
