"""The line of stages with stages that only look: what is handed to whom, who is silenced, and what the map is made of."""

import itertools

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from dhtorch import extend
from dhtorch.cli.run import config_dir
from dhtorch.codes import Gate, Source
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline.pair import merge, undistort_tracks, uniform_draws, upcast_intrinsics
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Camera, Estimate, Frame, Samples, Tracks
from dhtorch.stages import pose, score, triangulate
from dhtorch.stages.track import lucas_kanade_affine

HW = (20, 30)


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frame(batch=2, seed=0, dtype=torch.float64, lens=None):
    camera = Camera(torch.tensor([[40.0, 42.0]]), torch.tensor([[15.0, 9.0]]), lens)
    camera = camera.map(lambda x: x.expand(batch, -1)).to(dtype)
    return Frame(image=rand(batch, 1, *HW, seed=seed).float(), depth=1 + rand(batch, *HW, seed=seed + 1), camera=camera)


def samples_of(uv, seed=3):
    """Every other sample is usable."""
    batch, n = uv.shape[:2]
    zero = torch.zeros(batch, n, dtype=torch.float64)
    usable = (torch.arange(n) % 2 == 0).expand(batch, n)
    return Samples(
        uv=uv,
        depth=1 + rand(batch, n, seed=seed),
        sigma=0.01 + rand(batch, n, seed=seed + 1),
        xyz=torch.where(usable[..., None], 1.0, torch.nan).expand(batch, n, 3).double(),
        confidence=rand(batch, n, seed=seed + 2),
        flag=zero.int(),
        trackability=rand(batch, n, seed=seed + 3),
        hole=zero.int(),
    )


def tracks_of(uv, seed=13):
    batch, n = uv.shape[:2]
    half = rand(batch, n, 2, 2, seed=seed) - 0.5
    return Tracks(
        uv_0=uv,
        uv_1=uv + 2 * rand(batch, n, 2, seed=seed + 1) - 1,
        error=rand(batch, n, seed=seed + 2),
        photometric=rand(batch, n, seed=seed + 3),
        cov=half @ half.mT + 0.1 * torch.eye(2),
        valid=rand(batch, n, seed=seed + 4) < 0.8,
    )


def estimate_of(samples, gate=None, seed=23):
    shape = samples.depth.shape
    gate = torch.randint(0, 3, shape, generator=torch.Generator().manual_seed(seed)).int() if gate is None else gate
    columns = [torch.where(gate == 0, 1 + rand(*shape, seed=seed + k), torch.nan) for k in range(3)]
    others = [rand(*shape, seed=seed + 3 + k) for k in range(3)]
    return Estimate(samples.uv, *columns, others[0], others[1], 2 + 0 * gate, others[2] * (gate == 0), gate)


# ---------------------------------------------------------------------------------------------------- the map


def test_the_map_is_the_sensor_else_the_answer_else_nothing_in_every_field():
    samples = samples_of(30 * rand(2, 20, 2))
    estimate = estimate_of(samples)
    merged = merge(samples, estimate)
    kinds = set()
    for b, k in itertools.product(range(2), range(20)):
        if bool(samples.xyz[b, k].isfinite().all()):
            expected = samples.depth, samples.sigma, samples.confidence, Source.SENSOR
        elif estimate.gate[b, k] == Gate.ANSWER:
            expected = estimate.depth, estimate.sigma, estimate.score, Source.RECOVERED
        else:
            nothing = torch.zeros(2, 20)
            expected = nothing, nothing, nothing, Source.NONE
        kinds.add((int(expected[3]), bool(estimate.gate[b, k] == Gate.ANSWER)))
        for name, x in zip(("depth", "sigma", "score"), expected[:3], strict=True):
            assert getattr(merged, name)[b, k] == x[b, k], name
        assert merged.source[b, k] == expected[3]
    assert len(kinds) == 4 and merged.source.dtype == torch.int32 and torch.equal(merged.uv, samples.uv)


# ---------------------------------------------------------------------------------------------------- who gets what


class RecordingStages:
    """Seven stages that answer made-up things and remember what they were given."""

    def __init__(self, n=12, batch=2, gate=None):
        self.seen, self.n = {}, n
        self.uv = 2 + rand(n, 2, seed=40) * torch.tensor([25.0, 15.0])
        self.samples = samples_of(self.uv.expand(batch, n, 2))
        self.tracks = tracks_of(self.samples.uv)
        self.fit = known_pose_fit(se3.exp(rand(batch, 6, seed=41)), n)
        self.estimate = estimate_of(self.samples, gate)
        answers = {"backproject": self.samples, "classify": self.samples.replace(flag=self.samples.flag + 4)}
        answers |= {"track": self.tracks, "pose": self.fit, "triangulate": self.estimate, "sample": self.uv}
        self.functions = {name: self.stage(name, answer) for name, answer in answers.items()}
        self.functions["score"] = self.stage("score", None)
        self.functions["verify"] = lambda samples, tracks, fit, camera_0, camera_1: fit

    def stage(self, name, answer):
        def look(*args, **options):
            self.seen[name] = args, options
            return args[0] if answer is None else answer

        return look


def test_every_stage_gets_what_those_before_it_found():
    stages, trace = RecordingStages(), {}
    lens = torch.tensor([[0.1, -0.05, 0.001, 0.002]])
    frame_0, frame_1 = frame(lens=lens), frame(seed=5, lens=-lens)
    frame_1 = frame_1.replace(camera=frame_1.camera.replace(f=1.1 * frame_1.camera.f))
    estimate = extend(
        frame_0, frame_1, **stages.functions, n=12, hypotheses=7, seed=3, min_trackability=0.3, trace=trace
    )
    (hw, n), options = stages.seen["sample"]
    assert (hw, n) == (HW, 12) and options == {"device": torch.device("cpu"), "dtype": torch.float64}
    assert stages.seen["backproject"][0][0].depth is frame_0.depth and stages.seen["backproject"][0][1] is stages.uv
    assert stages.seen["classify"][0][0].depth is frame_0.depth and stages.seen["classify"][0][1] is stages.samples
    images = stages.seen["track"][0]
    assert images[0] is frame_0.image and images[1] is frame_1.image and torch.equal(images[2], stages.samples.uv)
    classified, usable, camera_0, camera_1, draws = stages.seen["pose"][0]
    assert (classified.flag == 4).all(), "what classify made of the samples"
    expected = undistort_tracks(stages.tracks, frame_0.camera, frame_1.camera)
    for name in ("uv_0", "uv_1", "cov"):
        assert torch.equal(getattr(usable, name), getattr(expected, name)), name
    assert torch.equal(usable.valid, stages.tracks.valid & (stages.samples.trackability >= 0.3))
    for camera, of in ((camera_0, frame_0), (camera_1, frame_1)):
        assert torch.equal(camera.f, of.camera.f) and camera.distortion is None
    assert torch.equal(draws, uniform_draws(3, 2, 7)) and draws.dtype == torch.float64
    args = stages.seen["triangulate"][0]
    fit = args[2]
    assert args[0] is classified and args[1] is usable and fit.T_1_from_0 is stages.fit.T_1_from_0
    assert torch.equal(fit.code, stages.fit.code)
    assert args[3] is camera_0 and args[4] is camera_1
    assert stages.seen["score"][0][1:] == (classified, usable, fit)
    assert trace["tracks"] is stages.tracks and trace["tracks_ideal"] is usable and trace["fit"] is fit
    assert trace["samples"] is classified and trace["estimate"] is estimate


def test_a_given_pose_is_taken_and_stage_five_not_asked():
    stages, other = RecordingStages(), known_pose_fit(se3.exp(rand(2, 6, seed=90)), 12)
    extend(frame(), frame(), **stages.functions, n=12, fit=other)
    assert "pose" not in stages.seen and stages.seen["triangulate"][0][2] is other


def test_pairs_are_tracked_eight_at_a_time():
    stages, sizes = RecordingStages(batch=11), []
    track = lambda image_0, image_1, uv, *, hint: sizes.append((len(image_0), len(image_1))) or tracks_of(uv)  # noqa: E731
    extend(frame(11), frame(11), **stages.functions | {"track": track})
    assert sizes == [(8, 8), (3, 3)]


def test_a_lost_sample_without_texture_says_so():
    """NO_TEXTURE takes the place of NO_TRACK where a track was found and only the texture is too weak."""
    gate = torch.tensor([[Gate.NO_TRACK] * 4 + [Gate.NO_POSE, Gate.ANSWER, Gate.NO_TRACK]], dtype=torch.int32)
    stages = RecordingStages(n=7, batch=1, gate=gate)
    valid = torch.tensor([[True, True, False, False, True, True, True]])
    texture = torch.tensor([[0.1, 0.3, 0.1, 0.3, 0.1, 0.1, 0.2]]).double()
    stages.functions["track"] = stages.stage("track", stages.tracks.replace(valid=valid))
    stages.functions["classify"] = stages.stage("classify", stages.samples.replace(trackability=texture))
    found = extend(frame(1), frame(1), **stages.functions, min_trackability=0.2).gate[0]
    lost = Gate.NO_TRACK
    assert found.tolist() == [Gate.NO_TEXTURE, lost, lost, lost, Gate.NO_POSE, Gate.ANSWER, lost]
    usable = stages.seen["pose"][0][1].valid[0]
    assert usable.tolist() == [False, True, False, False, False, False, True], "texture at the limit is enough"
    faint = stages.samples.replace(trackability=texture.clamp(max=1e-5) * torch.tensor([1, 0.99, 1, 1, 1, 1, 1.0]))
    stages.functions["classify"] = stages.stage("classify", faint)
    extend(frame(1), frame(1), **stages.functions)
    assert stages.seen["pose"][0][1].valid[0].tolist() == [True, False, False, False, True, True, True], "1e-5"


def test_intrinsics_of_half_precision_are_computed_with_as_single_ones():
    half = frame(1, dtype=torch.float16)
    seen = half.camera.map(lambda x: x[:1])
    both = half.replace(depth_camera=seen, image=half.image.half())
    found = upcast_intrinsics(both)
    assert found.camera.f.dtype == found.depth_camera.c.dtype == torch.float32
    assert torch.equal(found.camera.f, half.camera.f.float()) and found.image.dtype == torch.float16
    for dtype in (torch.float32, torch.float64):
        plain = frame(1, dtype=dtype)
        assert upcast_intrinsics(plain).camera is plain.camera and upcast_intrinsics(plain).depth_camera is None
    stages = RecordingStages(batch=1)
    extend(half, half, **stages.functions)
    assert stages.seen["sample"][1]["dtype"] == torch.float32
    assert stages.seen["triangulate"][0][4].f.dtype == torch.float32


def test_views_of_another_shape_or_number_are_refused():
    for bad in (frame(1), frame(2).replace(image=frame(2).image[:, 0]), frame(2).replace(image=frame(1).image)):
        for views in ((frame(2), bad), (bad, frame(2))):
            with pytest.raises(ValueError, match="extend"):
                extend(*views, **RecordingStages().functions)
    with pytest.raises(ValueError, match="expected"):
        extend(frame(2).replace(depth=frame(2).depth[0]), frame(2))


# ---------------------------------------------------------------------------------------------------- draws


def test_the_draws_of_a_pair_hang_on_its_seed_alone():
    def plain(seed, n):
        return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

    same, own = uniform_draws(5, 3, 4), uniform_draws(torch.tensor([9, 5, 2**40]), 3, 4)
    assert same.shape == own.shape == (3, 4, 3) and own.dtype == torch.float64
    for b in range(3):
        assert torch.equal(same[b], plain(5, 4)) and torch.equal(own[b], plain([9, 5, 2**40][b], 4))
    assert uniform_draws(torch.zeros(0, dtype=torch.int64), 0, 4).shape == (0, 4, 3)
    for bad in (torch.tensor([1, 2]), torch.tensor(1), torch.tensor([[1, 2, 3]])):
        with pytest.raises(ValueError, match="seed has shape"):
            uniform_draws(bad, 3, 4)


# ---------------------------------------------------------------------------------------------------- lenses

LENS_0 = torch.tensor([[0.262383, -0.953104, -0.005358, 0.002628, 1.163314]])
LENS_1 = torch.tensor([[-0.21, 0.09, 0.012, -0.007, 0.02]])


def through_lenses():
    """Two different lenses, and tracks (1, 40) with covariances of their own."""
    camera_0 = Camera(torch.tensor([[517.3, 516.5]]), torch.tensor([[318.6, 255.3]]), LENS_0)
    camera_1 = Camera(torch.tensor([[420.0, 470.0]]), torch.tensor([[300.6, 231.3]]), LENS_1)
    tracks = tracks_of(rand(1, 40, 2, seed=50) * torch.tensor([560.0, 400.0]) + 40)
    return tracks, camera_0.to(torch.float64), camera_1.to(torch.float64)


def test_tracks_lose_the_lens_of_their_own_view():
    tracks, camera_0, camera_1 = through_lenses()
    ideal = undistort_tracks(tracks, camera_0, camera_1)
    torch.testing.assert_close(cam.distort(camera_0, ideal.uv_0), tracks.uv_0, atol=1e-6, rtol=0)
    torch.testing.assert_close(cam.distort(camera_1, ideal.uv_1), tracks.uv_1, atol=1e-6, rtol=0)
    assert torch.equal(ideal.valid, tracks.valid)
    assert torch.equal(ideal.error, tracks.error) and torch.equal(ideal.photometric, tracks.photometric)
    assert undistort_tracks(tracks, cam.ideal(camera_0), cam.ideal(camera_1)) is tracks
    for one, other in ((camera_0, cam.ideal(camera_1)), (cam.ideal(camera_0), camera_1)):
        half = undistort_tracks(tracks, one, other)
        assert torch.equal(half.uv_0, tracks.uv_0 if one.distortion is None else ideal.uv_0)
        torch.testing.assert_close(half.uv_1, tracks.uv_1 if other.distortion is None else ideal.uv_1)
        torch.testing.assert_close(half.cov, tracks.cov if other.distortion is None else ideal.cov)


def test_covariances_go_through_the_second_lens_as_finite_differences_do():
    tracks, camera_0, camera_1 = through_lenses()
    ideal, h = undistort_tracks(tracks, camera_0, camera_1), 1e-3
    columns = []
    for step in h * torch.eye(2).double():
        columns.append(
            (cam.undistort(camera_1, tracks.uv_1 + step) - cam.undistort(camera_1, tracks.uv_1 - step)) / (2 * h)
        )
    J = torch.stack(columns, -1)[0].numpy()
    assert np.abs(J[:, 0, 1] - J[:, 1, 0]).max() > 0.01, "a Jacobian that is not its transpose"
    expected = [J[k] @ tracks.cov[0, k].numpy() @ J[k].T for k in range(40)]
    np.testing.assert_allclose(ideal.cov[0].numpy(), expected, rtol=1e-5)


def test_a_pixel_outside_of_a_lens_model_or_no_number_is_no_longer_valid():
    camera = Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[8.0, 8.0]]), torch.tensor([[-0.4, 0.0, 0.0, 0.0]]))
    camera = camera.to(torch.float64)
    tracks = tracks_of(torch.tensor([[[9.0, 9.0]]]).double().expand(1, 7, 2))
    out, nan = torch.tensor([60.0, 60.0]).double(), torch.nan
    uv_0, uv_1, cov = tracks.uv_0.clone(), tracks.uv_1.clone(), tracks.cov.clone()
    uv_0[0, 1], uv_1[0, 2], uv_0[0, 3, 0], uv_1[0, 4, 1], cov[0, 5] = out, out, nan, nan, nan
    valid = torch.ones(1, 7, dtype=torch.bool)
    valid[0, 6] = False
    leaves = [x.requires_grad_() for x in (uv_0, uv_1, cov)]
    given = tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov, valid=valid)
    found = undistort_tracks(given, camera, camera)
    assert found.valid.tolist() == [[True, False, False, False, False, True, False]]
    for x, y in ((found.uv_0, uv_0), (found.uv_1, uv_1)):
        assert torch.equal(x[0, 1:5].nan_to_num(-7), y[0, 1:5].nan_to_num(-7)), "it stays where it was"
    assert found.cov[0, 5].isnan().all() and found.cov[0, :5].isfinite().all()
    (found.uv_0[0, :2].sum() + found.uv_1[0, :2].sum() + found.cov[0, :2].sum()).backward()
    assert all(x.grad.isfinite().all() for x in leaves)


# ---------------------------------------------------------------------------------------------------- methods


def told(n=40, noise_px=0.4):
    """Frames through a long lens, and a track and a pose stage that know everything: points 2 to 60 m away, with noise."""
    frame_0, frame_1 = frame(1), frame(1, seed=7)
    rng = np.random.default_rng(0)
    uv = torch.tensor(rng.uniform([2, 2], [27, 17], (1, n, 2)))
    depth = torch.tensor(np.exp(rng.uniform(np.log(2), np.log(60), (1, n))))
    T = se3.exp(torch.tensor([[0.002, 0.003, -0.001, 0.1, 0.02, 0.01]]).double())
    big = frame_0.camera.replace(f=frame_0.camera.f * 100)
    frame_0, frame_1 = frame_0.replace(camera=big), frame_1.replace(camera=big)
    seen = cam.project(big, se3.apply(T, cam.unproject(big, uv, depth)))
    tracks = tracks_of(uv).replace(valid=torch.ones(1, n, dtype=torch.bool))
    tracks = tracks.replace(
        uv_1=seen + noise_px * torch.tensor(rng.normal(size=(1, n, 2))),
        photometric=torch.tensor(rng.uniform(0, 3, (1, n))),
    )
    fit = known_pose_fit(T, n).replace(
        cov=1e-8 * torch.eye(6).double()[None],
        inlier=torch.arange(n)[None] % 3 == 0,
        sigma_px=torch.tensor([0.7]).double(),
        t_snr=torch.tensor([40.0]).double(),
    )
    samples = samples_of(uv)
    samples = samples.replace(trackability=0.01 + 0.3 * samples.trackability, sigma=0.05 * samples.depth)
    given = {"sample": lambda *_, **__: uv, "backproject": lambda *_: samples, "classify": lambda *_: samples}
    return (frame_0, frame_1), given | {"track": lambda *_, hint: tracks, "pose": lambda *_: fit}, fit


WRITTEN_OUT = {
    "min_parallax_deg": None,
    "max_residual_px": 3.0,
    "max_sigma_rel": 0.2,
    "min_t_snr": 30.0,
    "max_mismatch_px": 10.0,
    "fitted_noise": True,
    "isotropic": 0.1,
    "mismatch_px": 2.0,
    "residual_px": 0.5,
    "round_trip_px": 0.4,
    "sigma_scale": 1.0,
    "sensor_share": 1.0,
}


def test_every_option_of_the_method_reaches_its_stage():
    """The same as the line with all options written out; leaving any of the method's own out changes the answer."""
    frames, given, fit = told()

    def answer(**options):
        of = lambda *args: triangulate.two_view(*args, **options)  # noqa: E731
        return extend(*frames, **given, triangulate=of, score=score.confidence_from_error)

    found, expected = METHODS["map"](*frames, **given), answer(**WRITTEN_OUT)
    assert 5 < int(found.keep.sum()) < 40
    for name in ("depth", "sigma", "sigma_shared", "score", "gate"):
        assert torch.equal(getattr(found, name).nan_to_num(), getattr(expected, name).nan_to_num()), name
    for name in WRITTEN_OUT.keys() - {"min_t_snr", "max_residual_px", "isotropic", "sigma_scale"}:
        other = answer(**{k: v for k, v in WRITTEN_OUT.items() if k != name})
        alike = torch.equal(other.sigma.nan_to_num(), found.sigma.nan_to_num()) and torch.equal(other.gate, found.gate)
        assert not alike, name
    for weak in (29.9, 30.1):
        given["pose"] = lambda *_, weak=weak: fit.replace(t_snr=torch.tensor([weak]).double())
        assert bool(METHODS["map"](*frames, **given).keep.any()) == (weak > 30)


def test_the_method_has_the_stages_that_its_configuration_names():
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        configured = instantiate(compose("run", ["method=map"]).method, _convert_="all")
    method = METHODS["map"]
    assert METHODS["paper"] is extend and type(method) is type(configured)
    assert method.pose is pose.map_pose is configured.pose.func
    assert method.score is score.confidence_from_error is configured.score.func
    options = configured.triangulate.keywords
    assert {k: options[k] for k in WRITTEN_OUT} == WRITTEN_OUT, "what the test above asks for"
    assert method.triangulate.keywords.items() <= WRITTEN_OUT.items()
    assert method.track.func is lucas_kanade_affine is configured.track.func
    assert method.track.keywords == {"levels": configured.track.keywords["levels"]} == {"levels": 5}
