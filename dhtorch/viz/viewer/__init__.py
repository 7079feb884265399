"""Viewers of ``dhtorch view``: images, depth, outcome of every sample, tracks, cameras, recovered points, gates.

``exhibit`` defines the displayed data, ``again`` rebuilds the components of an archived result, ``points`` reads a PLY
file; ``rrd`` sends an exhibit to Rerun (extra ``[view]``), ``html`` writes it as one self-contained page. Exhibits of
recordings are computed by ``dhtorch.experiments.exhibits``.
"""

from dhtorch.viz.viewer.exhibit import (
    DepthImage,
    Exhibit,
    ExhibitView,
    PageOpening,
    PairExhibit,
    PointCloud,
    SweptPointCloud,
)

__all__ = ["DepthImage", "Exhibit", "ExhibitView", "PageOpening", "PairExhibit", "PointCloud", "SweptPointCloud"]
