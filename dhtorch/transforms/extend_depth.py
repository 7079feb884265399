"""Sample dict → the same dict plus far depth: the whole method as a transform for data loaders."""

import copy
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from dhtorch.codes import Gate, names
from dhtorch.geometry import camera as cam
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import merge
from dhtorch.pipeline.presets import get_method
from dhtorch.pipeline.spec import iter_networks
from dhtorch.records import NO_HINT, DepthMap, Estimate, PoseFit, Samples, TrackHint
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.transforms.layout import UNREADABLE_KEY, clear_non_finite, conform, zeros_like
from dhtorch.transforms.maps import DenseMaps, map_to_samples
from dhtorch.transforms.poses import warn_refuted_poses
from dhtorch.transforms.sample_access import SampleError, check_sample, get_value, has_key, to_tensor
from dhtorch.transforms.sample_spec import SampleSpec, SampleViews, default_prefix
from dhtorch.transforms.schema import SampleProblem, SampleResults, blank_columns, columns_of_options
from dhtorch.transforms.tokens import FIT_MODES, patch_tokens, token_grid

ON_ERROR_CHOICES = ("raise", "skip", "flag")

#: Rows of the table of counts; more workers than rows share a row, and may then lose counts.
_MAX_COUNT_ROWS = 128


class _ProblemCounts:
    """Counts by problem in memory shared with forked and spawned workers, each of which writes its own row."""

    def __init__(self) -> None:
        counts = torch.zeros(_MAX_COUNT_ROWS, len(names(SampleProblem)), dtype=torch.int64, device="cpu")
        self.counts = counts.share_memory_()

    def add(self, problem: Tensor) -> None:
        """Count problem codes (B,) of samples."""
        worker = get_worker_info()
        row = 0 if worker is None else 1 + worker.id % (_MAX_COUNT_ROWS - 1)
        counts = self.counts[row].numpy()  # numpy: several torch operations per sample cost more
        for number in problem.tolist():
            counts[number] += 1

    def __deepcopy__(self, memo: dict[int, Any]) -> "_ProblemCounts":
        clone = copy.copy(self)
        clone.counts = self.counts.clone().share_memory_()
        return clone


class ExtendDepth(torch.nn.Module):
    """Sample dict with images and depth -> the same dict plus sparse metric points, relative pose and depth tokens.

    A new dict is returned, other keys untouched. Shapes are fixed by the options and the image size, every number is
    finite, and masks mark the valid ones: so samples collate, and a result depends neither on the worker nor on the
    batch. Without a source view only the front end runs: the sensor's own returns, flags and hole classes.

    Args:
        method: a name (:data:`dhtorch.pipeline.presets.METHODS`) or a :class:`dhtorch.pipeline.method.Method`; None =
            ``fused`` with ``dense``, else ``paper``.
        n: samples per image; None = the method's own number.
        hint: prior information on the motion between the views, for the tracker.
        seed: of the pose search. With ``index_key`` each sample has the seed ``seed + sample[index_key]``.
        index_key: key of an integer that identifies a sample; None = the same draws for all samples.
        dense: True = also a dense depth map, with the defaults of :func:`dhtorch.pipeline.completion.complete_depth`;
            a mapping = options for it: ``source_views``, ``planes``, ``size``, ``refinements``, ``min_correlation``,
            ``max_sigma_rel``. Sigma and score of swept pixels are calibrated with the package's default calibration.
        budget: with ``dense`` also the largest cause of every pixel's sigma, ``cause_map``.
        patch, tokens_hw, fit: the network's patches, see :func:`dhtorch.transforms.patch_tokens`.
        on_error: what to do with a sample that cannot be read, or whose values contradict the options. ``raise``;
            ``skip`` = return None, see :func:`dhtorch.transforms.collate_kept`; ``flag`` = add zeros and set
            ``problem`` to UNREADABLE; keys that are read get zeros too where they are missing, of another shape than in
            the first good sample, or not finite. Skipped and flagged samples are counted (:meth:`report`) and raise a
            warning.
        batched: True = samples are collated batches, False = single samples. None = single samples, and a sample that
            looks like a batch (3x3 intrinsics, texts, an index or episode for each image) is rejected instead of being
            read as frames along time. A batch with a missing key or a wrong shape raises in any case.
        prefix: of the added keys. None = ``dhtorch.``, and ``observation.dh_`` where ``image`` is named as LeRobot
            names its pictures (``observation.images.…``): its processors keep no other keys.
        **views: keys, layouts and units of the images, the depth and the intrinsics: see
            :class:`dhtorch.transforms.SampleSpec`. ``depth_unit`` is required.

    Returns:
        The sample plus the columns of :data:`dhtorch.transforms.schema.COLUMNS`, which lists key, shape, unit and
        meaning; keys carry the prefix, and batches have B in front of the shape. Invalid values are 0; tokens have the
        channels :data:`dhtorch.transforms.TOKEN_CHANNELS`. ``pose_convention`` is present only with ``pose``.

        With ``dense`` also the maps, over the field of view of the image and of its size unless that is longer than
        ``size``. An unanswered pixel, NaN in a :class:`dhtorch.records.DepthMap`, is 0 here; without a source view the
        map holds the sensor's depth. Tokens are then pooled from all pixels of the map instead of the samples; every
        other key is the same as without maps.

    Raises:
        ValueError: invalid options.
        SampleError: a bad sample, depending on ``on_error``.

    Gradient: points, maps, tokens and pose to images, depth and intrinsics, as ``dhtorch.extend`` and
    ``dhtorch.pipeline.completion.complete_depth``; none in a worker, whose samples cannot carry a graph.
    Memory: with ``dense`` that of ``complete_depth``, and about a third of it again for tokens.
    Compilation: ``torch.compile`` leaves the transform as it is and compiles what is around it in a model.
    Cost: as the method; with ``dense`` the plane sweep dominates. In workers use one thread
    (``worker_init_fn=one_thread``). A process that has used several threads should not be forked: set one thread
    before, or spawn the workers.
    """

    def __init__(
        self,
        *,
        method: str | Method | None = None,
        n: int | None = None,
        hint: TrackHint = NO_HINT,
        seed: int = 0,
        index_key: str | None = None,
        dense: bool | Mapping[str, Any] = False,
        budget: bool = False,
        patch: int = 14,
        tokens_hw: tuple[int, int] | None = None,
        fit: str = "stretch",
        on_error: str = "raise",
        batched: bool | None = None,
        prefix: str | None = None,
        **views: Any,
    ) -> None:
        super().__init__()
        default = "paper" if dense is False else "fused"
        method = get_method(default if method is None else method, n)
        if on_error not in ON_ERROR_CHOICES or (batched and on_error == "skip"):
            expected = ("raise", "flag") if batched else ON_ERROR_CHOICES
            raise ValueError(f"on_error is {on_error!r}, expected one of {', '.join(expected)}")
        if fit not in FIT_MODES:
            raise ValueError(f"fit is {fit!r}, expected one of {', '.join(FIT_MODES)}")
        token_grid((max(patch, 1),) * 2, patch=patch, tokens_hw=tokens_hw)  # raises if no patch fits
        self.views = SampleSpec(**views)
        self.maps = DenseMaps.from_options(dense)
        self.budget = budget and self.maps is not None
        self.method, self.hint = method, hint
        self.learned = torch.nn.ModuleList(iter_networks(self.method))  # so that .to() and .parameters() find them
        self.seed, self.index_key = seed, index_key
        self.patch, self.tokens_hw, self.fit = patch, tokens_hw, fit
        self.on_error, self.batched = on_error, bool(batched)
        self.prefix = default_prefix(self.views.image) if prefix is None else prefix
        self._batched_option = batched
        self.tally = _ProblemCounts()
        self._seen_hw: tuple[int, int] | None = None
        self._layout: dict[str, Any] | None = None  # zeros in the shapes of the first good sample, with on_error=flag

    def __repr__(self) -> str:
        dense = "" if self.maps is None else ", dense maps"
        keys = ", ".join(map(str, self.views.keys()))
        return f"ExtendDepth({self.method!r}{dense}; reads {keys}; adds {self.prefix}*)"

    def with_options(self, *, batched: bool) -> "ExtendDepth":
        """The same transform for batches or for single samples; networks and counts of problems are shared.

        Raises:
            ValueError: ``batched`` other than that stated when the transform was made.
        """
        if self._batched_option not in (None, batched):
            raise ValueError(f"batched is {self._batched_option}, expected {batched}, or no statement")
        other = copy.copy(self)
        other.batched, other._batched_option = batched, batched
        return other

    @standard_numerics
    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any] | None:
        """Sample or batch -> copy of it with the added columns; None if it is skipped."""
        if torch.compiler.is_compiling():
            return torch.compiler.disable(
                ExtendDepth._extend,
                reason="ExtendDepth reads a sample in Python, and its control flow depends on values",
            )(self, sample)
        return self._extend(sample)

    def _extend(self, sample: Mapping[str, Any]) -> dict[str, Any] | None:
        if sample is None and self.on_error == "skip":  # a data set may return None for an unreadable item
            return self.left_out({}, SampleError("sample: found None, expected a dict with pictures and depth"))
        check_sample(sample, self.views.image, self.views.intrinsics, self._batched_option)
        with torch.set_grad_enabled(torch.is_grad_enabled() and get_worker_info() is None):
            try:
                read = self.views.read(sample, batched=self.batched)
                if UNREADABLE_KEY in sample:  # bad too; their messages were shown when they were loaded
                    marked = to_tensor(sample[UNREADABLE_KEY], UNREADABLE_KEY).to(read.bad)
                    complaints = ((marked, marked.float(), ""), *read.complaints)
                    read = read._replace(bad=read.bad | marked, complaints=complaints)
                seed = self._seeds(sample, len(read.bad))
                flagged = bool(read.complaints) and bool(read.bad.any())
                if flagged and not (self.batched and self.on_error == "flag"):
                    raise SampleError(read.complaint())
            except SampleError as error:
                if self.on_error == "raise" or self.batched:
                    raise
                return self.left_out(sample, error)
            if flagged and (complaint := read.complaint()):
                warnings.warn(f"flagged: {complaint}", stacklevel=3)
            frame, paired = read.reference, read.paired
            samples, estimate, fits, dense = self._run_method(read, seed)
            merged = merge(samples, estimate)
            pooled = (merged, samples.hole) if dense is None else map_to_samples(dense, frame, self.method)
            tokens = patch_tokens(*pooled, frame.hw, patch=self.patch, tokens_hw=self.tokens_hw, fit=self.fit)
            xyz = samples.xyz if estimate is None else cam.unproject(frame.camera, merged.uv, merged.depth)
            # Plain Python, because several torch operations on so few numbers cost more.
            bad = read.bad.tolist() if flagged else [False] * len(paired)
            codes = [
                SampleProblem.UNREADABLE
                if is_bad
                else SampleProblem.NO_DEPTH
                if not has_returns
                else SampleProblem.NONE
                if is_paired
                else SampleProblem.NO_SECOND_VIEW
                for is_bad, has_returns, is_paired in zip(bad, read.has_returns.tolist(), paired.tolist(), strict=True)
            ]
            results = SampleResults(
                samples=samples,
                merged=merged,
                xyz=xyz,
                estimate=estimate,
                fits=fits,
                paired=paired,
                tokens=tokens,
                dense=dense,
                problem=torch.tensor(codes, dtype=torch.int32, device=xyz.device),
            )
            columns = {column: column.compute(results) for column in columns_of_options(self._column_options())}
            added = {column.key: x for column, x in columns.items()}
            if self.views.pose is not None:
                name = self.views.pose if isinstance(self.views.pose, str) else "pose"
                warn_refuted_poses(fits, paired, added["pose_convention"], name)
            if flagged:
                added = {
                    column.key: x.masked_fill(read.bad.view(-1, *[1] * (x.ndim - 1)), column.unreadable)
                    for column, x in columns.items()
                }
        self.tally.add(added["problem"])
        if self._seen_hw != read.reference.hw:  # nn.Module.__setattr__ is slow
            self._seen_hw = read.reference.hw
        if flagged:
            sample = clear_non_finite(sample, self.views.number_keys(), read.bad)
        elif self.on_error == "flag" and self._layout is None and not self.batched:
            self._layout = {k: zeros_like(get_value(sample, k)) for k in self.read_keys if has_key(sample, k)}
        return self._add_columns(sample, added)

    @property
    def read_keys(self) -> tuple[str, ...]:
        """The keys that are read from a sample."""
        return (*self.views.keys(), *(() if self.index_key is None else (self.index_key,)))

    def report(self) -> dict[str, int]:
        """Number of samples by problem since the transform was constructed, summed over all workers."""
        total = self.tally.counts.sum(0).tolist()
        return {name.lower(): total[code] for code, name in names(SampleProblem).items()}

    def left_out(self, sample: Mapping[str, Any], error: Exception) -> dict[str, Any] | None:
        """Result for an unreadable sample by ``on_error``: None, or the sample with blank columns; counts and warns.

        Raises:
            SampleError: ``on_error`` is flag, and the image size is unknown.
        """
        if self.on_error == "flag":
            sample = clear_non_finite(sample, self.views.number_keys())
            sample = sample if self._layout is None else conform(sample, self._layout, self.read_keys)
        hw = (None if self.maps else self.tokens_hw) or self.views.image_hw(sample) or self._seen_hw
        if self.on_error == "flag" and hw is None:
            missing = "maps" if self.maps else "tokens: give tokens_hw"
            raise SampleError(f"{error} (and no image gives the size of its {missing})") from error
        warnings.warn(f"{'skipped' if self.on_error == 'skip' else 'flagged'}: {error}", stacklevel=4)
        self.tally.add(torch.tensor([SampleProblem.UNREADABLE]))
        return None if self.on_error == "skip" or hw is None else self._add_columns(sample, self.blank_columns(hw))

    def _run_method(
        self, read: SampleViews, seed: int | Tensor
    ) -> tuple[Samples, Estimate | None, list[PoseFit], DepthMap | None]:
        """Views -> samples, estimate, pose fits of the source views (the last is the overall one), dense maps or None.

        Without any paired sample only the front end runs: the estimate is None and the list of fits empty.
        """
        if read.other is None or not bool(read.paired.any()):
            samples = self.method.sample_depth(read.reference)
            dense = None if self.maps is None else self.maps.sensor_depth(read.reference, self.method)
            return samples, None, [], dense
        trace: dict[str, Any] = {}
        method_args: dict[str, Any] = {"seed": seed, "hint": self.hint, "trace": trace}
        method_args |= {} if read.pose_prior is None else {"fit": read.pose_prior}
        if self.maps is None:
            dense = None
            estimate = self.method(read.reference, read.other, **method_args)
        else:
            dense = self.maps.complete(read, self.method, **method_args)
            estimate = trace["fused"]
        estimate = estimate.replace(gate=torch.where(read.paired[:, None], estimate.gate, Gate.NO_TRACK))
        return trace["samples"], estimate, [view["fit"] for view in trace.get("views", [trace])], dense

    def _seeds(self, sample: Mapping[str, Any], batch: int) -> int | Tensor:
        """Seed of the pose search: one for all samples, or (B,) int64 with ``index_key``."""
        if self.index_key is None:
            return self.seed
        index = to_tensor(get_value(sample, self.index_key), self.index_key).flatten()
        if index.shape[0] != batch or index.is_floating_point():
            expected = f"{batch} whole numbers"
            raise SampleError(
                f"{self.index_key}: found {index.dtype} of shape {tuple(index.shape)}, expected {expected}"
            )
        return index.long().cpu() + self.seed

    def blank_columns(self, hw: tuple[int, int]) -> dict[str, Tensor]:
        """Image size -> blank columns (1, …) of an unreadable sample, in the usual shapes."""
        rows, columns = token_grid(hw, patch=self.patch, tokens_hw=self.tokens_hw)
        sizes = {"N": self.method.n, "P": rows * columns}
        if self.maps is not None:
            sizes |= dict(zip("HW", self.maps.hw(hw), strict=True))
        return blank_columns(sizes, self._column_options())

    def _column_options(self) -> list[str]:
        """The active options that add columns, see :mod:`dhtorch.transforms.schema`."""
        active = {"pose": self.views.pose is not None, "dense": self.maps is not None, "budget": self.budget}
        return [option for option, is_active in active.items() if is_active]

    def _add_columns(self, sample: Mapping[str, Any], added: Mapping[str, Tensor]) -> dict[str, Any]:
        """Sample and columns (B, …) -> new dict with the columns under prefixed keys."""
        # Contiguous copies: a row of a shared table would be sent to the main process with the whole table.
        prefixed = {self.prefix + key: x if self.batched else x[0].contiguous() for key, x in added.items()}
        return {**sample, **prefixed}
