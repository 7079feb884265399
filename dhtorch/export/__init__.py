"""Points, meshes and views → files that other programs open: PLY, GLB (glTF 2.0) and COLMAP's text model.

Arrays may be torch tensors or numpy arrays, on any device. Every file is written whole or not at all.
"""

from dhtorch.export.colmap import Shot, write_colmap
from dhtorch.export.glb import Shape, write_glb
from dhtorch.export.ply import write_ply

__all__ = ["Shape", "Shot", "write_colmap", "write_glb", "write_ply"]
