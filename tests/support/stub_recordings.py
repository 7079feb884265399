"""Recordings of a few pixels with random pictures and depth, some of them damaged, and the rows of their extraction."""

import torch

from dhtorch.data import Recording, Scene
from dhtorch.extract import columns, plan
from dhtorch.extract.dataset import RowDataset
from dhtorch.records import Camera, Frame
from support.stub_samples import FixedEstimate, H, K, N, Stub, W

#: Patches of a picture, as tokens.
P = 6


def frame(seed, confidence=False, bent=False, own=False):
    """A random frame of this seed: picture, depth in metres and camera differ from those of every other seed.

    ``bent``: with lens distortion; ``own``: with a depth camera.
    """
    g = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (1, 3, H, W), generator=g, dtype=torch.uint8)
    depth = 0.5 + torch.rand(1, H, W, generator=g)
    camera = Camera(torch.tensor([[K[0] + seed, K[1]]]), torch.tensor([K[2:]]))
    if bent:
        camera = camera.replace(distortion=torch.tensor([[0.01 * seed, 0.0, 0.0, 0.0]]))
    conf = torch.randint(0, 3, (1, H, W), generator=g).to(torch.uint8) if confidence else None
    return Frame(
        image, depth, camera, Camera(torch.tensor([[9.0, 8.0]]), torch.tensor([[7.0, 6.0]])) if own else None, conf
    )


class Load:
    """Loader of frames by position; the ``bad`` positions raise ``error`` as a decoder would."""

    def __init__(self, first=0, bad=(), error=OSError, **options):
        self.first, self.bad, self.error, self.options = first, set(bad), error, options

    def __call__(self, i):
        if i in self.bad:
            raise self.error(f"position {i}\n  is   damaged")
        return frame(self.first + i, **self.options)


def recording(n=4, numbers=None, name="one", load=None, gap=None, levels=None, **options):
    """A scene of ``n`` random frames."""
    number = torch.tensor(numbers if numbers is not None else list(range(n)))
    recording = Recording(name=name, format="made", load=load or Load(), number=number, **options)
    return Scene(recording, gap=gap, levels=levels)


def rows(recordings, gap, method=None, wanted=None, **options):
    """The rows that an extraction of these recordings has, with the features of a stub method."""
    method = Stub(answer=method or FixedEstimate(), n=N)
    features = columns.feature_columns(N, P)
    whole = plan.make_plan(recordings, gap, 1)
    return RowDataset(recordings, whole, wanted or features, method=method, gap=gap, tokens_hw=(H, W), **options)
