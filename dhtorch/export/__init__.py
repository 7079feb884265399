"""Writers: points, meshes, views and depth maps → PLY, GLB (glTF 2.0), COLMAP's text model, PNG.

Arrays may be torch tensors or numpy arrays, on any device. Files are written atomically.
"""

from dhtorch.export.colmap import ColmapImage, write_colmap
from dhtorch.export.frames import (
    QuantisedDepth,
    encode_png,
    mesh_depth_map,
    quantise_depth,
    write_frames_dir_metadata,
    write_tum_metadata,
)
from dhtorch.export.glb import Shape, write_glb
from dhtorch.export.ply import write_ply

__all__ = [
    "ColmapImage",
    "QuantisedDepth",
    "Shape",
    "encode_png",
    "mesh_depth_map",
    "quantise_depth",
    "write_colmap",
    "write_frames_dir_metadata",
    "write_glb",
    "write_ply",
    "write_tum_metadata",
]
