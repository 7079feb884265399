"""Wrong options and inputs of experiments end in one sentence with what was found and what was expected."""

from functools import partial

import pytest
import torch
from support.paper_protocol_runs import configured_method, small_room
from support.rooms import room_scene

from dhtorch.data.pairs import by_gap
from dhtorch.experiments.baselines import opencv, relative
from dhtorch.experiments.compare import dense_comparison, learned, method_comparison
from dhtorch.experiments.focal import blur, defocus_fusion, filling, focus_stack, sharpness
from dhtorch.experiments.negative import helix_correlation, hole_attention, icp
from dhtorch.experiments.paper import latency
from dhtorch.experiments.probes import learned_score
from dhtorch.experiments.protocol import Settings
from dhtorch.metrics import holdout
from dhtorch.pipeline.presets import MAP, PAPER
from dhtorch.records import Pose
from dhtorch.stages.sample import regular_grid
from dhtorch.synthetic.thin_lens import make_lens, render_defocus
from dhtorch.synthetic.viewpoints import open_viewpoints

POINTS = torch.rand(1, 50, 3, dtype=torch.float64)
STILL = Pose(torch.eye(3).double()[None], torch.zeros(1, 3).double())
SIGNAL, SITE = torch.rand(1, 400), torch.tensor([[5]])
LENS, DEPTH, IMAGE = make_lens(400.0), torch.ones(1, 8, 8), torch.zeros(1, 1, 8, 8)
ONE, THREE = torch.zeros(1, 1, 1, 32, 32), torch.zeros(1, 3, 1, 32, 32)
RELATIVE = relative.RelativeDepth(torch.ones(2, 2, 2), torch.ones(2, 2, 2), torch.ones(2, 2), torch.zeros(2, 2))


def run(experiment, scenes=(), methods=None, pairs=None, **options):
    chosen = {"paper": configured_method()} if methods is None else methods
    return experiment.run([room_scene(s, gap=3) for s in scenes], chosen, pairs or by_gap, Settings(), **options)


def real_holes(cut):
    frame = small_room()[0]
    samples = PAPER.sample_depth(frame)
    return holdout.select_real_holes(frame, samples, holdout.sample_truth(frame, samples.uv)[:, :cut])


def split(share, cut):
    samples = PAPER.replace(n=64).sample_depth(small_room(hw=(96, 128))[0])
    _, hidden = holdout.split_half(samples, 0, share=share)
    return holdout.hide_returns(samples, hidden[:, :cut])


WITHOUT_GAZE = {"paper": PAPER.replace(sample=regular_grid)}
OPENCV_ALONE = {"paper": PAPER, "opencv": opencv.OPENCV}


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (partial(run, latency, rounds=0), "experiment.rounds"),
        (partial(run, latency, sizes=()), "experiment.sizes"),
        (partial(run, latency, n=0), "experiment.n"),
        (partial(icp.register_icp, POINTS[:, :0], POINTS, STILL), "expected at least one each"),
        (partial(icp.register_icp, POINTS, POINTS[:, :0], STILL), "expected at least one each"),
        (partial(icp.register_icp, POINTS, POINTS, STILL, keep=0.0), "expected keep and shrink"),
        (partial(icp.register_icp, POINTS, POINTS, STILL, reach_m=0.05), "least_reach_m <= reach_m"),
        (partial(icp.register_icp, POINTS, POINTS, STILL, normals_1=POINTS[:, :10]), "normals_1 has shape"),
        (partial(icp.estimate_normals, POINTS[:, :5]), "neighbours"),
        (
            partial(run, icp, [small_room(hw=(96, 128), n_frames=1)], links=10),
            "found 1 frame of synthetic_room and links",
        ),
        (
            partial(helix_correlation.correlate_windows, SIGNAL, SIGNAL, SITE, SITE, window=20),
            "expected odd from 3, and from 1",
        ),
        (
            partial(helix_correlation.correlate_windows, SIGNAL, SIGNAL, SITE, SITE, window=1),
            "expected odd from 3, and from 1",
        ),
        (
            partial(helix_correlation.correlate_windows, SIGNAL, SIGNAL, SITE, SITE, max_lag=0),
            "expected odd from 3, and from 1",
        ),
        (
            partial(helix_correlation.correlate_windows, SIGNAL[:, :30], SIGNAL, SITE, SITE),
            "signals have 30 and 400 steps, expected at",
        ),
        (
            lambda: hole_attention.largest_cluster(torch.zeros(1, 0, 2), torch.zeros(1, 0, dtype=torch.bool)),
            "found 0 samples, expected more than neighbours = 6",
        ),
        (
            lambda: hole_attention.largest_cluster(torch.rand(1, 6, 2), torch.zeros(1, 6, dtype=torch.bool)),
            "found 6 samples, expected more than neighbours = 6",
        ),
        (lambda: run(hole_attention, [small_room()], WITHOUT_GAZE), "expected a sampler with an option gaze"),
        (lambda: run(hole_attention, [small_room()], stride=0), "stride is 0"),
        (partial(render_defocus, IMAGE[..., :7], DEPTH, LENS, torch.ones(1, 1)), "depth has shape"),
        (partial(render_defocus, IMAGE, 0 * DEPTH, LENS, torch.ones(1, 1)), "without a value"),
        (partial(render_defocus, IMAGE, DEPTH, LENS, torch.full((1, 1), 0.01)), "beyond the focal length"),
        (partial(blur.estimate_blur, IMAGE, fine_px=2.0, coarse_px=1.0), "expected 0 < fine_px < coarse_px"),
        (partial(open_viewpoints, 0), "expected at least 1"),
        (partial(run, defocus_fusion, factor=0), "expected an odd number from 3"),
        (partial(run, defocus_fusion, factor=4), "expected an odd number from 3"),
        (partial(filling.fill_bilinear, torch.ones(4, 4), (8, 8)), "coarse has shape"),
        (partial(filling.fill_guided, torch.ones(1, 4, 4), torch.ones(1, 8, 9)), "guide has shape"),
        (partial(filling.fill_joint_bilateral, torch.ones(1, 4, 4), torch.ones(1, 8, 9)), "guide has shape"),
        (partial(sharpness.measure_sharpness, ONE), "found 1 picture, expected a stack of at least two"),
        (partial(sharpness.align_stack, ONE), "found 1 picture, expected a stack of at least two"),
        (
            partial(sharpness.measure_sharpness, THREE, "fourier"),
            "measure is 'fourier', expected one of modified_laplac",
        ),
        (partial(sharpness.align_stack, THREE, reference=7), "reference is 7"),
        (partial(sharpness.depth_at_focus, DEPTH, None), "focus_m is None, expected distances"),
        (partial(sharpness.depth_at_focus, DEPTH, torch.tensor([[1.0, 3.0, 2.0]])), "rise or to fall throughout"),
        (partial(run, focus_stack, slices=1), "slices: found 1"),
        (partial(run, learned, models={"m": partial(print, weights=None)}), r"experiment\.models\.m\.weights"),
        (partial(run, learned, scales=("guess",)), r"experiment\.scales"),
        (partial(relative.to_estimate, RELATIVE, torch.zeros(2, 5, 2), torch.ones(3)), "to_estimate"),
        (partial(run, learned_score, methods={"m": MAP.replace(views=3)}), "two views"),
        (partial(learned_score.train_score, []), "no answer with ground truth"),
        *((partial(run, dense_comparison, **{k: 0}), f"experiment.{k}") for k in ("stride", "reference_views")),
        (partial(run, dense_comparison, stride=1.5), "experiment.stride"),
        (partial(run, method_comparison, methods=OPENCV_ALONE), r"experiment\.methods: found paper, opencv"),
        (
            partial(run, method_comparison, methods={"m": MAP}),
            r"experiment\.methods: found m, expected paper and one more",
        ),
        (partial(run, method_comparison, chained=["none"]), r"experiment.chained: found none, expected some of paper"),
        (lambda: real_holes(5), "select_real_holes"),
        (lambda: split(1, None), r"holdout.share: found 1"),
        (lambda: split(0.5, 4), "hide_returns"),
    ],
)
def test_what_is_wrong_is_named(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()
