"""Tuning constants of the validation of depth maps, one record with a default for each."""

import math
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class ValidationOptions:
    """Options of :func:`dhtorch.validation.validate.validate_depth` and :func:`dhtorch.validation.faults.diagnose`:
    their tuning constants with meaning and unit, and their origin where it is known."""

    # Evidence

    #: Error, as a log ratio, that evidence must be able to detect to support a pixel: 20 %.
    detectable_log_ratio: float = math.log(1.2)

    #: Sigmas at which an error of ``detectable_log_ratio`` must stand for evidence to support a pixel.
    detection_sigmas: float = 3.0

    #: Radius around a sparse reference within which it is evidence, grid pixels.
    support_radius_px: int = 8

    #: Largest depth difference, as a log ratio, of two pixels on one surface of the map.
    surface_log_ratio: float = 0.06

    #: Factors on the map's inverse depth at which rival depths along the ray are tried.
    rival_factors: tuple[float, ...] = (0.3, 0.42, 0.58, 0.75, 0.88, 1.14, 1.33, 1.75, 2.4, 3.4)

    #: Least correlation of two windows that show the same surface.
    match_correlation: float = 0.75

    #: Least correlation at a rival depth.
    rival_correlation: float = 0.8

    #: Radius of the correlation windows, grid pixels.
    evidence_radius_px: int = 4

    #: Number of independent errors among the pixels of a window.
    independent_evidence_pixels: float = 8.0

    #: Least fraction of a window's pixels with a depth.
    min_filled_ratio: float = 0.6

    # Evidence at outlines, and causes of wrong pixels

    #: Ratio of the depths of neighbouring pixels from which an outline lies between them.
    #: Source: derived, the least error that must be detected, 20 %.
    side_ratio: float = 1.2

    #: Distance from an outline within which pixels may have the depth of its other side, grid pixels.
    #: Source: derived, a bleed of 6 px and one pixel of the grid.
    outline_reach_px: int = 7

    #: Gain of the depth beyond an outline, sigmas² of grey values, that refutes a pixel at a foreground's depth.
    #: Source: chosen on built-in room 0, holo_a, 7s_redkitchen_000 and tum_fr1_desk9: as much gain 0.05, 0.3, 0.7 and
    #: 0.3 % of the sound pixels.
    outline_gain: float = 2.0

    #: The same for a pixel at a background's depth, which the foreground may hide in other views.
    #: Source: chosen on built-in room 0, holo_a, 7s_redkitchen_000 and tum_fr1_desk9: as much gain 0.2, 0.4, 0.7 and
    #: 0.2 % of the sound pixels.
    occluding_outline_gain: float = 3.5

    #: Least amount, sigmas² of grey values, by which pictures must fit a foreground's own depth better than the one
    #: beyond its outline, for wider windows to support it.
    #: Source: chosen on built-in rooms 0 to 2 and holo_a: a thousandth of the sound pixels more becomes unknown than
    #: with 1.
    min_own_gain: float = 2.0

    #: Largest difference of two depths, as a log ratio, of pixels that support each other in a window of 5 × 5.
    #: Source: derived, twice the default tolerance of a map, 0.025.
    flying_log_ratio: float = 0.05

    #: Most pixels of the window of 5 × 5 around a flying pixel at its depth.
    #: Source: derived, one less than a line of one pixel's width has.
    max_flying_neighbours: int = 3

    #: Fewest pixels of that window before a flying pixel, and behind it.
    #: Source: derived, a side of the window, 5, less the flying pixels on it.
    min_side_pixels: int = 3

    #: Depth below which sensors have no true return, m.
    #: Source: derived, a sixth more than 0.3 m, the larger one of usual minimum ranges of depth cameras.
    min_sensor_range_m: float = 0.35

    #: Least ratio of a ghost's depth to the true one.
    #: Source: derived, 1 m over the largest minimum range, 0.35 m.
    ghost_ratio: float = 2.8

    # States and numbers of a frame

    #: Misfit from which on evidence refutes a pixel, sigmas.
    refuting_evidence_sigmas: float = 3.0

    #: Misfit up to which evidence supports a pixel, sigmas.
    supporting_evidence_sigmas: float = 2.0

    #: Most references that count as independent: they share neighbourhoods of tracks, lens and sensor.
    max_independent_references: int = 60

    #: Relative standard deviation of the sensor's metric scale.
    sensor_scale_sigma: float = 0.005

    #: Relative standard deviation of a trajectory's metric scale.
    trajectory_scale_sigma: float = 0.02

    #: Fewest references of a kind for a scale.
    min_scale_references: int = 8

    #: Fewest references for shift and tilt.
    min_shape_references: int = 24

    #: A map counts as clipped only if at least this fraction of its pixels equals its largest depth.
    min_plateau_ratio: float = 0.01

    #: A map counts as clipped only if at least this fraction of the pixels with evidence at its largest depth is wrong
    #: and too near.
    min_clipped_wrong_ratio: float = 0.1

    #: A map counts as clipped only if that fraction exceeds the one of all other pixels by this factor.
    clipped_rate_factor: float = 2.0

    # Diagnosis of faults

    #: Miss at which the loss of a sample is a half, px of a picture 640 wide.
    half_loss_px: float = 2.0

    #: Least mean loss that a fault must save over no fault.
    min_loss_saved: float = 0.04

    #: Least number of its standard errors over the pairs that the saved loss must reach.
    min_standard_errors: float = 3.0

    #: Least margin in mean loss of a fault over the best one of another kind.
    min_margin_over_others: float = 0.015

    #: Least fraction of the loss beyond that of the sensor's near returns that a fault must explain.
    min_explained_ratio: float = 0.75

    #: Without motions: ratio of a map to a near return at which the loss is a half.
    half_loss_ratio: float = 1.1

    #: Without motions: longer side of the grid of near returns.
    return_grid_side: int = 64

    #: Largest translation of a static camera, as a fraction of the median return.
    static_baseline_ratio: float = 0.005

    #: Largest factor between a unit and the median ratio of near returns to the map at which the unit is tried.
    max_unit_misfit: float = 2.0

    #: Most pairs of a window.
    max_window_pairs: int = 8

    #: Fewest pairs (or frames) of a diagnosis.
    min_window_pairs: int = 4

    #: Frames from the first to the second of a pair, tried in this order.
    pair_gaps: tuple[int, ...] = (8, 4, 2, 1)

    #: Least fraction of the textured samples that a pair must track.
    min_tracked_ratio: float = 0.4


#: The default of every function that takes options.
DEFAULT_VALIDATION_OPTIONS: Final = ValidationOptions()
