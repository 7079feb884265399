"""Sample dict → the same sample with far depth: the whole method as a transform for data loaders."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from dhtorch.codes import Gate
from dhtorch.geometry import camera as cam
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import merge
from dhtorch.pipeline.presets import get_method
from dhtorch.pipeline.spec import iter_networks
from dhtorch.records import NO_HINT, DepthMap, Estimate, PoseFit, Samples, TrackHint
from dhtorch.transforms import maps, poses, schema
from dhtorch.transforms.sample_access import SampleError, check_sample, get_value, to_tensor
from dhtorch.transforms.sample_spec import SampleSpec, SampleViews
from dhtorch.transforms.status import ProblemCounts, SampleProblem
from dhtorch.transforms.tokens import FIT_MODES, patch_tokens, token_grid

ON_ERROR_CHOICES = ("raise", "skip", "flag")


class ExtendDepth(torch.nn.Module):
    """Add to each sample what its depth and a second view tell: sparse metric points, the pose, and depth tokens.

    A new dict is returned, other keys untouched. Shapes are fixed by the options and the size of the image, every
    number is finite, and masks say what is meant: so samples collate, and an answer depends neither on the worker nor
    on the batch. Without a second view only the front end runs: the sensor's own returns, flags and hole classes.

    Args:
        method: a name (:data:`dhtorch.pipeline.presets.METHODS`) or a :class:`dhtorch.pipeline.method.Method`.
        n: samples per image; None = the method's own number.
        hint: what is known of the motion between the views, for the tracker.
        seed: of the pose search. With ``index_key`` each sample has the seed ``seed + sample[index_key]``.
        index_key: key of a whole number that tells samples apart; None = the same draws for all.
        dense: True = a map of every pixel as well, with the defaults of :func:`dhtorch.pipeline.dense.complete_depth`;
            a mapping =
            options for it: ``source_views``, ``planes``, ``size``, ``refinements``, ``min_correlation``,
            ``max_sigma_rel``. Sigma and score of swept pixels are calibrated by what travels with the package.
        patch, tokens_hw, fit: the network's patches, see :func:`dhtorch.transforms.patch_tokens`.
        on_error: what to do with a sample that cannot be read, or whose values contradict what was stated. ``raise``;
            ``skip`` = return None, see :func:`dhtorch.transforms.collate_kept`; ``flag`` = add zeros, and ``problem``
            says so. Skipped and flagged samples are counted (:meth:`report`) and warned of.
        batched: True = samples are collated batches, False = single ones. None = single ones, and where a field shows
            a batch (3x3 intrinsics, texts, an index or episode for each picture) it is refused instead of being read
            as frames along time. A batch with a missing key or a wrong shape raises in any case.
        prefix: of the keys that are added.
        **views: where the images, the depth and the intrinsics are, and their units: see
            :class:`dhtorch.transforms.SampleSpec`. ``depth_unit`` must be given.

    Returns:
        The sample and, behind the prefix and with B in front of a batch, the columns of
        :data:`dhtorch.transforms.schema.COLUMNS`: key, shape, unit and meaning of each stand there. What is not valid
        is 0; tokens have the channels :data:`dhtorch.transforms.TOKEN_CHANNELS`. ``pose_convention`` is there with
        ``pose``.

        With ``dense`` also the maps, over the field of the picture and of its size unless that is longer than ``size``.
        A silent pixel, NaN in a :class:`dhtorch.records.DepthMap`, is 0 here; where there is no second view the map
        is the sensor's. Tokens are then pooled from all pixels of the map, no longer from the samples; every other key
        is what it is without maps.

    Raises:
        ValueError: options that cannot be.
        SampleError: a bad sample, where ``on_error`` says so.

    Gradient: points, maps, tokens and pose to images, depth and intrinsics, as ``dhtorch.extend`` and
    ``dhtorch.pipeline.dense.complete_depth``; none in a worker, whose samples cannot carry a graph.
    Memory: with ``dense`` that of ``complete``, about a third as much again for tokens.
    Cost: as the method; with ``dense`` most of it is the sweep's. In workers use one thread
    (``worker_init_fn=one_thread``). A process that has used several threads should not be forked: set one thread
    before, or spawn the workers.
    """

    def __init__(
        self,
        *,
        method: str | Method = "paper",
        n: int | None = None,
        hint: TrackHint = NO_HINT,
        seed: int = 0,
        index_key: str | None = None,
        dense: bool | Mapping[str, Any] = False,
        patch: int = 14,
        tokens_hw: tuple[int, int] | None = None,
        fit: str = "stretch",
        on_error: str = "raise",
        batched: bool | None = None,
        prefix: str = "dhtorch.",
        **views: Any,
    ) -> None:
        super().__init__()
        method = get_method(method, n)
        if on_error not in ON_ERROR_CHOICES or (batched and on_error == "skip"):
            expected = ("raise", "flag") if batched else ON_ERROR_CHOICES
            raise ValueError(f"on_error is {on_error!r}, expected one of {', '.join(expected)}")
        if fit not in FIT_MODES:
            raise ValueError(f"fit is {fit!r}, expected one of {', '.join(FIT_MODES)}")
        token_grid((max(patch, 1),) * 2, patch=patch, tokens_hw=tokens_hw)  # raises where no patch fits
        self.views = SampleSpec(**views)
        self.maps = maps.DenseMaps.asked(dense)
        self.method, self.hint = method, hint
        self.learned = torch.nn.ModuleList(iter_networks(self.method))  # so that .to() and .parameters() find them
        self.seed, self.index_key = seed, index_key
        self.patch, self.tokens_hw, self.fit = patch, tokens_hw, fit
        self.on_error, self.batched, self.prefix = on_error, bool(batched), prefix
        self._stated = batched
        self.tally = ProblemCounts()
        self._seen_hw: tuple[int, int] | None = None

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any] | None:
        """The sample with our keys; None where it is skipped."""
        if sample is None and self.on_error == "skip":  # what a data set gives that could not read one
            return self.left_out({}, SampleError("sample: found None, expected a dict with pictures and depth"))
        check_sample(sample, self.views.image, self.views.intrinsics, self._stated)
        with torch.set_grad_enabled(torch.is_grad_enabled() and get_worker_info() is None):
            try:
                read = self.views.read(sample, batched=self.batched)
                seed = self._seeds(sample, len(read.bad))
                flagged = bool(read.complaints) and bool(read.bad.any())
                if flagged and not (self.batched and self.on_error == "flag"):
                    raise SampleError(read.complaint())
            except SampleError as error:
                if self.on_error == "raise" or self.batched:
                    raise
                return self.left_out(sample, error)
            if flagged:
                warnings.warn(f"flagged: {read.complaint()}", stacklevel=2)
            added = self._answer(read, seed, flagged)
        self._counted(added["problem"], read.reference.hw)
        return self._joined(sample, added)

    def report(self) -> dict[str, int]:
        """Number of samples by problem since the transform was made, those of all workers together."""
        return self.tally.report()

    def left_out(self, sample: Mapping[str, Any], error: Exception) -> dict[str, Any] | None:
        """A sample that cannot be read, as ``on_error`` wants it: None, or itself with zeros. Counted and warned of.

        Raises:
            SampleError: it is to be flagged, and nothing tells the size of its image.
        """
        hw = (None if self.maps else self.tokens_hw) or self.views.image_hw(sample) or self._seen_hw
        if self.on_error == "flag" and hw is None:
            missing = "maps" if self.maps else "tokens: give tokens_hw"
            raise SampleError(f"{error} (and no image tells the size of its {missing})") from error
        warnings.warn(f"{'skipped' if self.on_error == 'skip' else 'flagged'}: {error}", stacklevel=3)
        self.tally.add(torch.tensor([SampleProblem.UNREADABLE]))
        return None if self.on_error == "skip" or hw is None else self._joined(sample, self._blank(hw))

    def _answer(self, read: SampleViews, seed: int | Tensor, flagged: bool) -> dict[str, Tensor]:
        frame, paired, bad = read.reference, read.paired, read.bad
        samples, estimate, fits, dense = self._asked(read, seed)
        merged = merge(samples, estimate)
        pooled = (merged, samples.hole) if dense is None else maps.map_to_samples(dense, frame, self.method)
        tokens = patch_tokens(*pooled, frame.hw, patch=self.patch, tokens_hw=self.tokens_hw, fit=self.fit)
        xyz = samples.xyz if estimate is None else cam.unproject(frame.camera, merged.uv, merged.depth)
        problem = torch.tensor(_problem_codes(read, flagged), dtype=torch.int32, device=xyz.device)
        found = schema.SampleResults(
            samples=samples,
            merged=merged,
            xyz=xyz,
            estimate=estimate,
            fits=fits,
            paired=paired,
            tokens=tokens,
            dense=dense,
            problem=problem,
        )
        added = schema.compute_columns(found, self._column_options())
        if self.views.pose is not None:
            label = poses.pose_label(self.views.pose)
            poses.warn_refuted_poses(fits, paired, added["pose_convention"], label)
        return schema.fill_unreadable(added, bad) if flagged else added

    def _asked(
        self, read: SampleViews, seed: int | Tensor
    ) -> tuple[Samples, Estimate | None, list[PoseFit], DepthMap | None]:
        """What the method says, and of which views' poses, the last of which stands for all, and the maps where they
        are wanted; the front end alone, and no estimate, where nothing is paired."""
        if read.other is None or not bool(read.paired.any()):
            samples = self.method.sample_depth(read.reference)
            dense = None if self.maps is None else self.maps.sensed(read.reference, self.method)
            return samples, None, [], dense
        trace: dict[str, Any] = {}
        told: dict[str, Any] = {"seed": seed, "hint": self.hint, "trace": trace}
        told |= {} if read.given is None else {"fit": read.given}
        if self.maps is None:
            dense = None
            estimate = self.method(read.reference, read.other, **told)
        else:
            dense = self.maps.swept(read, self.method, **told)
            estimate = trace["sparse"]
        estimate = estimate.replace(gate=torch.where(read.paired[:, None], estimate.gate, Gate.NO_TRACK))
        return trace["samples"], estimate, [view["fit"] for view in trace.get("views", [trace])], dense

    def _seeds(self, sample: Mapping[str, Any], batch: int) -> int | Tensor:
        if self.index_key is None:
            return self.seed
        index = to_tensor(get_value(sample, self.index_key), self.index_key).flatten()
        if index.shape[0] != batch or index.is_floating_point():
            expected = f"{batch} whole numbers"
            raise SampleError(
                f"{self.index_key}: found {index.dtype} of shape {tuple(index.shape)}, expected {expected}"
            )
        return index.long().cpu() + self.seed

    def _blank(self, hw: tuple[int, int]) -> dict[str, Tensor]:
        """What is added to a sample that cannot be read: zeros of the usual shapes."""
        rows, across = token_grid(hw, patch=self.patch, tokens_hw=self.tokens_hw)
        sizes = {"N": self.method.n, "P": rows * across}
        if self.maps is not None:
            sizes |= dict(zip("HW", self.maps.hw(hw), strict=True))
        return schema.blank_columns(sizes, self._column_options())

    def _column_options(self) -> list[str]:
        """The options that bring columns of their own, see :mod:`dhtorch.transforms.schema`."""
        given = {"pose": self.views.pose is not None, "dense": self.maps is not None}
        return [option for option, stated in given.items() if stated]

    def _counted(self, problem: Tensor, hw: tuple[int, int]) -> None:
        self.tally.add(problem)
        if self._seen_hw != hw:  # torch looks twice at what a module is given
            self._seen_hw = hw

    def _joined(self, sample: Mapping[str, Any], added: Mapping[str, Tensor]) -> dict[str, Any]:
        # Copies of their own: a row of a shared table would be sent to the main process with the whole table.
        mine = {self.prefix + key: x if self.batched else x[0].contiguous() for key, x in added.items()}
        return {**sample, **mine}


def _problem_codes(read: SampleViews, flagged: bool) -> list[int]:
    """The code of each sample; few numbers, of which torch would make several operations."""
    bad = read.bad.tolist() if flagged else [False] * len(read.bad)

    def code(bad: bool, sensed: bool, paired: bool) -> int:
        if bad:
            return SampleProblem.UNREADABLE
        if not sensed:
            return SampleProblem.NO_DEPTH
        return SampleProblem.NONE if paired else SampleProblem.NO_SECOND_VIEW

    return list(map(code, bad, read.sensed.tolist(), read.paired.tolist()))
