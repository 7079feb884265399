"""What ``dhtorch view`` shows: pictures, depth, what became of every sample, tracks, cameras, recovered points, gates.

``exhibit`` says what there is to see, ``again`` takes an archived result back to its parts, ``points`` a PLY file;
``rrd`` hands an exhibit to Rerun (extra ``[view]``), ``html`` makes it one page that needs nothing but a browser. What
is to be seen of a recording is computed by ``dhtorch.experiments.exhibits``.
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
