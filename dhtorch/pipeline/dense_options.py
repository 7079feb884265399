"""Tuning constants of dense completion, one record with a default for each."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class DenseOptions:
    """Options of :func:`dhtorch.pipeline.completion.complete_depth`: its tuning constants with their meaning and
    unit."""

    # Defaults of the keywords of complete_depth

    #: Most source views that are swept, those of largest gain.
    source_views: int = 3

    #: Inverse depths that are tested per pixel, evenly spaced from infinity to within the sensor's reach.
    planes: int = 96

    #: Longer side of the map and of the images that are swept, px; smaller images keep their size.
    size: int = 640

    #: Gauss-Newton steps from the best plane.
    refinements: int = 2

    #: Correlation of a pixel's window in the view that fits best, below which the pixel is unanswered.
    min_correlation: float = 0.75

    #: sigma / depth above which a pixel is unanswered, before the calibration.
    max_sigma_rel: float = 0.2

    # Range of the sweep and source views

    #: Fraction of the sensor's reach at which the sweep ends; depths that both measure are needed to refute the sweep.
    sweep_overlap: float = 0.7

    #: Quantile of the depth of near returns that is the sensor's reach.
    reach_quantile: float = 0.98

    #: Least gain of a source view that is swept, Σ log(1 + (0.1 · depth / sigma)²) over its answers without a return.
    min_view_gain: float = 5.0

    # Near returns against the sweep

    #: Fewest pixels with a near return and a swept depth by which a motion may be refuted.
    min_overlap_pixels: int = 200

    #: Sigmas beyond which a difference of swept depth and near return counts as a contradiction.
    refuting_sigmas: float = 3.0

    #: Difference of swept depth and near return, as a ratio to depth, beyond which it counts as a contradiction.
    refuting_ratio: float = 0.1

    # Best plane

    #: Least cost (of one view) by which the best plane along the ray must beat every plane further away in the images
    #: than ``second_best_radius_px``. The surroundings of a pixel contribute up to the price of a jump (18 from each
    #: side): a second best place within more than one such price may be the true one, as where a texture repeats.
    min_second_best_margin: int = 5

    #: Displacement in the images within which another plane counts as the same place, px.
    second_best_radius_px: float = 3.0

    #: Stride of the pixels from which the displacement between planes is measured; it reaches all rows and columns
    #: alike.
    motion_stride_px: int = 17

    # Fit by grey values

    #: Noise of a pixel's grey value (a step of eight bits is 0.004).
    grey_noise: float = 0.002

    #: Pixels of a window with independent errors: noise is correlated by the lens, the resampling and the texture.
    independent_window_pixels: float = 5.0

    #: Cost of a surface (of one view, as :func:`dhtorch.geometry.plane_sweep.aggregate_best_plane` counts) at which the
    #: variance by grey values is not rescaled. Census codes that fit less well indicate other content in the window,
    #: those that fit better less noise.
    nominal_cost: float = 40.0

    #: Correlation of its windows above which a view contributes to a pixel's depth.
    min_window_correlation: float = 0.5

    #: Largest step of one Gauss-Newton iteration, planes.
    max_step_planes: float = 1.0

    #: Largest distance of the fit from the best plane, planes.
    max_total_planes: float = 1.5

    #: Planes by which a surface must be nearer to hide another.
    occlusion_planes: float = 1.5

    #: Largest difference of neighbours on one surface, planes.
    surface_planes: float = 1.5

    #: Half the distance of the central difference that gives the derivative of a step, planes.
    derivative_planes: float = 0.1

    #: Least value of that derivative.
    min_step_derivative: float = 0.25

    #: Radius of the window around a pixel whose range of inverse depth is an edge of the surface, px.
    edge_radius_px: int = 4

    #: Standard deviation of a pixel's inverse depth beside an edge, as a ratio to the height of the edge: the pixel may
    #: belong to the other side.
    edge_sigma_ratio: float = 0.17

    # Filters of the map

    #: Stride of the pixels from whose returns the sensor's reach is taken, px; it reaches all rows and columns alike.
    #: Source: derived, as ``motion_stride_px``.
    reach_stride_px: int = 17

    #: Fraction of the sensor's reach within which its silence speaks against a foreground.
    #: Source: chosen on built-in rooms and shared scenes.
    halo_reach: float = 0.99

    #: Distance from a return at its own depth within which a swept pixel may be its halo, px.
    #: Source: chosen on built-in rooms and shared scenes.
    halo_radius_px: int = 10

    #: Distance within which something farther makes such a pixel an edge, px.
    #: Source: chosen on built-in rooms and shared scenes.
    background_radius_px: int = 12

    #: Ratio of depths, farther over nearer, above which two pixels lie on two surfaces.
    #: Source: derived, that of the measured depth steps (metrics.map_quality).
    step_ratio: float = 1.15

    #: Difference of inverse depth above which a step beside a pixel is none of its noise, sigmas of the pixel.
    #: Source: chosen on built-in rooms and shared scenes.
    step_sigmas: float = 2.0

    #: Difference of grey values at which two pixels are half as similar as equal ones.
    #: Source: chosen on built-in rooms and shared scenes.
    grey_similarity: float = 0.06

    #: Mean similarity to what is farther, as a ratio to that to its own surface, above which a pixel beside a depth
    #: step belongs to the farther surface.
    #: Source: chosen on built-in rooms and shared scenes.
    fattened_ratio: float = 2.0

    #: Sigmas beyond which a swept depth and a return beside it on one surface are inconsistent.
    #: Source: derived, as ``refuting_sigmas``.
    seam_sigmas: float = 3.0

    #: Ratio of depths, farther over nearer, above which pixels that look alike are two surfaces all the same.
    #: Source: chosen on tum_fr1_desk9, whose seams were 1.34 at most.
    seam_ratio: float = 1.5

    #: Relative difference of inverse depth within which neighbours lie on one surface.
    #: Source: chosen on built-in rooms and shared scenes.
    same_surface_ratio: float = 0.1

    #: Difference of inverse depth within which they do as well, sigmas of the surer one.
    #: Source: chosen on built-in rooms and shared scenes.
    same_surface_sigmas: float = 3.0

    #: Pixels of one surface below which they are a speck, and of silence below which it is a pinhole, px.
    #: Source: derived, that of the measured artefacts (metrics.map_quality).
    speck_px: int = 30

    #: Distance within which an unanswered pixel must meet answers in all four directions to be filled, px.
    #: Source: derived, the side of the window that a single outlier silences (``edge_radius_px``).
    hole_radius_px: int = 9

    #: Width of a gap amid returns within the sensor's reach above which its silence speaks against their surface, px.
    #: Source: derived, that of a square pinhole of fewer than ``speck_px``.
    max_gap_px: int = 5

    #: Fewest rim pixels of that plane.
    #: Source: derived, two more than its parameters.
    min_rim_pixels: int = 5

    #: Largest distance of a rim pixel from that plane, ratio of inverse depth.
    #: Source: chosen on built-in rooms and shared scenes.
    rim_ratio: float = 0.05

    # Planes of weakly textured surfaces

    #: Side of the cells that planes are fitted to, px.
    #: Source: chosen on built-in rooms, the cost; the half a window of the sweep.
    plane_cell_px: int = 8

    #: Fewest answered pixels of a cell that supports planes.
    #: Source: chosen on built-in rooms, a line of one pixel across the cell.
    min_cell_pixels: int = 8

    #: Cells up to which a ray looks for support: the longest extrapolation of a plane.
    #: Source: chosen on built-in rooms and shared scenes: 24 cells are .3 of the longer side of a map.
    plane_reach_cells: int = 24

    #: Support cells that a ray collects.
    #: Source: chosen on built-in rooms, those behind the nearest determine the slant.
    plane_ray_support: int = 4

    #: Largest difference of grey value (in [0, 1]) from that of the cell at which a ray goes on.
    #: Source: chosen on built-in rooms and shared scenes; .03 halves the filled pixels at the same errors.
    plane_grey_difference: float = 0.06

    #: Largest distance of support from its plane, ratio of inverse depth; three standard deviations.
    #: Source: chosen on built-in rooms, three times the median error of swept answers on weak texture.
    plane_inlier_ratio: float = 0.09

    #: Least area spanned by the support cells of a hypothesis, over that of a cell.
    #: Source: chosen on built-in rooms, three cells by three.
    min_triple_area: float = 9.0

    #: Fewest support cells on a plane, of 64.
    #: Source: chosen on built-in rooms, with fewer, one in ten filled pixels is more than 20 % off.
    min_plane_support: int = 20

    #: Least share of the support that lies on the plane.
    #: Source: chosen on built-in rooms and shared scenes.
    min_plane_share: float = 0.6

    #: Largest standard deviation of a plane at the middle of its cell, relative, by independent errors of its support.
    #: Source: chosen on built-in rooms and shared scenes.
    max_plane_sigma_rel: float = 0.012

    #: Cells around whose planes are compared.
    #: Source: chosen on built-in rooms, a plane that fits by chance ends within two cells.
    plane_neighbours: int = 2

    #: Largest mean relative difference of inverse depth between the planes of a cell and of those around.
    #: Source: chosen on built-in rooms and shared scenes.
    max_plane_disagreement: float = 0.04

    #: Relative difference of inverse depth as which a larger one counts in that mean.
    #: Source: chosen on built-in rooms, one in six neighbours on another surface exceeds the limit.
    max_plane_difference: float = 0.3

    #: Fraction of the sensor's reach nearer than which its silence refutes a plane.
    #: Source: chosen on built-in rooms, the reach less the error of a plane.
    plane_reach: float = 0.97

    #: Largest share of the rays that end on a plane along which the sensor's silence refutes it.
    #: Source: chosen on built-in rooms, a few rays end in holes of the sensor.
    max_refuted_rays: float = 0.1

    #: Independent errors per support cell: neighbours share windows and edges.
    #: Source: chosen on built-in rooms, the filled pixels within one sigma.
    independent_support: float = 0.25

    #: Part of the support's sigma that is common to all of it, by motions and scale.
    #: Source: chosen on built-in rooms, the filled pixels within one sigma.
    common_sigma_ratio: float = 0.45


#: The default of every function that takes options.
DEFAULT_DENSE_OPTIONS: Final = DenseOptions()
