"""Scenes with the frame number as grey value, and a method whose answers depend on the frame step alone."""

import torch

import dhtorch
from dhtorch.codes import Gate
from dhtorch.data.recording import Recording, consecutive_frame_numbers
from dhtorch.data.scene import Scene
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.pipeline.method import Method
from dhtorch.records import Estimate, Pose, Tracks
from dhtorch.stages.sample import regular_grid

#: Step from the reference view -> share of the samples with a (correct) answer.
SHARES = {1: 0.2, 2: 0.5, -2: 0.1, 5: 0.3, -5: 0.4}
NEAR, FAR = 1.0, 3.0


def frame(i):
    depth = torch.full((1, 48, 64), FAR)
    depth[..., :16] = NEAR
    camera = dhtorch.Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[31.5, 23.5]]))
    return dhtorch.Frame(torch.full((1, 1, 48, 64), i, dtype=torch.uint8), depth, camera)


def scene(name="hall", n=10, load=frame, **notes):
    recording = Recording(name=name, format="made", load=load, number=consecutive_frame_numbers(n))
    return Scene(recording, near=2.0, gap=min(2, n - 1), **notes)


def track(image_0, image_1, uv_0, *, hint):
    step = (image_1.double() - image_0.double()).mean((1, 2, 3))
    zero = torch.zeros_like(uv_0[..., 0])
    cov = torch.eye(2).expand(*zero.shape, 2, 2)
    return Tracks(uv_0, uv_0 + step[:, None, None].to(uv_0), zero, zero, cov, zero == 0)


def pose(samples, _tracks, _camera_0, _camera_1, _draws):
    still = Pose(torch.eye(3).expand(len(samples.uv), 3, 3), torch.zeros(len(samples.uv), 3))
    return known_pose_fit(still, samples.uv.shape[1])


def triangulate(samples, tracks, _fit, _camera_0, _camera_1):
    steps = (tracks.uv_1 - tracks.uv_0)[:, 0, 0].round().int().tolist()
    lost = (~tracks.valid).any(-1).tolist()
    shares = torch.tensor([0.0 if out else SHARES.get(step, 0.0) for step, out in zip(steps, lost, strict=True)])
    says = torch.arange(samples.uv.shape[1]) % 10 < 10 * shares[:, None]
    unanswered = Estimate.unanswered(samples, Gate.NO_TRACK, n_views=2)
    answer = torch.where(says, FAR, torch.nan)
    gate = torch.where(says, Gate.ANSWER, unanswered.gate)
    return unanswered.replace(depth=answer, sigma=answer / 100, sigma_shared=0 * answer, gate=gate)


def score(estimate, _samples, _tracks, _fit):
    return estimate.replace(score=estimate.keep.to(estimate.depth))


MAP = Method(
    sample=regular_grid, track=track, pose=pose, triangulate=triangulate, score=score, n=1920, min_trackability=0.0
)


def choosing(*steps):
    """A choice of views that takes the frames at these steps, in this order."""

    def choose(reference, others, views, *, fit=None):
        steps_of_views = (others.image.double() - reference.image.double()).mean((2, 3, 4))
        return torch.stack([(steps_of_views == step).double().argmax(0) for step in steps])

    return MAP.replace(select_views=choose, views=len(steps))
