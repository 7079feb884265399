"""Tuning constants of the alignment of depth maps, one record with a default for each."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class AlignmentOptions:
    """Options of :func:`dhtorch.alignment.align.align_depth`: its tuning constants with their meaning and unit.

    Chosen on ``data=shared_scenes``, those of model selection also on ``data=streams`` (``align_study.json``,
    ``align_study_streams.json``).
    """

    # References

    #: Most references of one source, evenly spread over its samples or pixels.
    max_references_per_source: int = 512

    #: Relative error of every return in addition to its stated one.
    min_return_error: float = 0.01

    #: Relative error of a far answer alone in addition to its stated one: wrong matches.
    far_own_error: float = 0.02

    #: Relative error that all far answers share in addition to their stated one: motions with too small a covariance.
    far_shared_error: float = 0.05

    #: Fraction of the variance of a map's far pixels that all share (their motion's).
    map_shared_ratio: float = 0.5

    #: Correlation of the errors of two references of one block.
    block_correlation: float = 0.3

    # Error models and their fits

    #: Correlation lengths of fields, long and short, as a fraction of the picture's longer side.
    field_lengths: tuple[float, float] = (0.3, 0.13)

    #: Correlation length of the correction, as a fraction of the range of log values.
    curve_length: float = 0.4

    #: Degrees of freedom of Student's t during selection: tails heavy enough to keep a fit of which nearly half of the
    #: references are outliers.
    student_freedom: float = 1.0

    #: Degrees of freedom with lighter tails, candidates for near returns without such outliers.
    lighter_freedoms: tuple[float, ...] = (2.0, 4.0, 8.0, 30.0)

    #: Least noise of a reference, of log depth.
    min_reference_noise: float = 3e-4

    #: Bounds of the factor on the stated noise of near returns.
    near_noise_range: tuple[float, float] = (1e-4, 1e4)

    #: Bounds of the factor on the stated noise of far answers.
    far_noise_range: tuple[float, float] = (0.4, 8.0)

    #: Prior weight of a factor of 1 on the stated noise, in references.
    stated_noise_weight: float = 0.1

    #: Prior standard deviation of the scale, as a fraction of its initial value.
    scale_prior_sigma: float = 1.0

    #: Prior standard deviation of the shift, as a fraction of the references' median.
    shift_prior_sigma: float = 0.5

    #: Least scale of a head, as a fraction of its initial value.
    min_scale: float = 0.05

    #: Least value of a head, m or 1/m.
    min_head: float = 1e-3

    #: Prior log probability that a model loses for every kind of error that it has.
    complexity_log_penalty: float = 3.0

    #: Iterations of a fit for model selection.
    selection_steps: int = 10

    #: Iterations of the fit of the answer.
    final_steps: int = 40

    # Model selection and averaging

    #: Fewest references of a fit, and of far answers that can refute a model.
    min_references: int = 8

    #: Most models that contribute to sigma.
    max_models: int = 3

    #: Grid step for what varies slowly over the picture, px.
    field_stride_px: int = 8

    #: Relative error of near returns below which two models are not compared by how well they fit them.
    exact_fit_error: float = 0.002

    #: A shift that fits near returns to ``exact_fit_error`` is rejected only if it raises the loss of far answers by
    #: more than this many standard errors; any other shift is rejected from one on.
    veto_standard_errors: float = 2.0

    #: Loss difference that rounding alone may cause.
    loss_rounding: float = 1e-6

    #: Loss of a reference under a model that could not be fitted.
    failed_fit_loss: float = 10.0

    #: Bounds of the factor on sigma that left-out references give.
    sigma_scale_range: tuple[float, float] = (0.3, 4.0)

    #: Prior weight of a factor of 1 on sigma, in left-out references.
    sigma_scale_prior: int = 20

    #: Least probability of a power law that adds to sigma: a smaller one changes no interval that holds nine of ten
    #: errors. Source: derived, 1 - 0.9.
    min_power_probability: float = 0.1

    #: Iterations of the fit of a power law.
    power_steps: int = 30

    #: Relative error at which the initial fit of a head changes from least squares to least absolute values.
    huber_bend: float = 0.03

    # Family of the map

    #: Fewest near returns that show that inverse depth is linear in the values, not depth.
    family_min_references: int = 50

    #: Median relative error of a line from value to depth up to which the map is one of depth.
    #: Source: chosen on depth of ten recordings of DHTORCH_DATA as z-buffer and as disparity.
    family_min_error: float = 0.001

    #: Largest ratio of the error of a line to inverse depth to that error at which the map is one of inverse depth.
    #: Source: chosen on depth of ten recordings of DHTORCH_DATA as z-buffer and as disparity, ratios below 0.001, and
    #: with every fault of synthetic.depth_faults, above 0.24.
    family_max_ratio: float = 0.2

    # Residual noise

    #: Relative scatter of a map without near returns.
    default_residual: float = 0.01

    #: Error per unit of roughness (both log depth) of a map without near returns.
    default_roughness_gain: float = 0.5

    #: Side of the window over which roughness is averaged, as a fraction of the longer side.
    roughness_window: float = 0.03

    #: Candidate levels of relative error: exponents of ten from, to, and number.
    error_levels: tuple[int, int, int] = (-5, 0, 51)

    #: Candidate levels of error per roughness: exponents of ten from, to, and number.
    roughness_levels: tuple[int, int, int] = (-3, 1, 41)

    #: Width of the kernel of local errors over the picture, as a fraction of the longer side.
    place_kernel_width: float = 0.04

    #: Width of the kernel of local errors over depth, log depth.
    depth_kernel_width: float = 0.05

    #: Weight of zero local error, in returns, against the returns around a pixel.
    empty_kernel_weight: float = 0.3

    #: Depth bins of the grid of local errors.
    n_depth_bins: int = 48

    #: A return has a local error beyond this many sigmas of the map's scatter. Beyond two, chance leaves .08 of the
    #: variance of returns with normal noise, all over the map; beyond three, .005.
    #: Source: chosen on data=synthetic_seeds 20 to 44, align_study_unseen_2.json and docs/align.md, "Measured".
    outlier_sigmas: float = 3.0

    #: Returns off by more than this many levels do not enter the estimate of the returns' noise.
    outlier_levels: float = 3.0

    #: Unevenness of a map, as a fraction of the scatter of returns, below which it counts as even.
    #: Source: chosen on data=synthetic_seeds 0 to 4 and data=streams, align_study_rooms.json and
    #: align_study_streams.json.
    min_unevenness: float = 0.1

    #: Distance beyond which the sensor noise of two returns is independent, since it is smooth over a few pixels of the
    #: sensor; residuals correlated beyond it are the map's. A fraction of the longer side.
    #: Source: chosen on data=synthetic_seeds 10 to 19, docs/align.md, "Measured".
    noise_independence_distance: float = 0.035

    #: Least fraction of the returns' noise variance that is uncorrelated between neighbouring returns.
    #: Source: chosen on data=synthetic_seeds 10 to 19, docs/align.md, "Measured".
    min_uncorrelated_ratio: float = 0.5

    #: Prior weight, in pairs of returns, of the hypothesis that all scatter is the map's.
    #: Source: chosen on data=synthetic_seeds 0 to 4 and data=streams, align_study_rooms.json and
    #: align_study_streams.json.
    prior_pairs: int = 10

    @property
    def map_correlation_length(self) -> float:
        """Correlation length of a map's smooth errors: that of the shorter field, as a fraction of the longer side."""
        return min(self.field_lengths)


#: The default of every function that takes options.
DEFAULT_ALIGNMENT_OPTIONS: Final = AlignmentOptions()
