"""Points, meshes, views and maps → files that other programs open: PLY, GLB (glTF 2.0), COLMAP's text model, PNG.

Arrays may be torch tensors or numpy arrays, on any device. Every file is written whole or not at all.
"""

from dhtorch.export.colmap import Shot, write_colmap
from dhtorch.export.frames import Steps, faces, in_steps, png, write_numbered, write_stamped
from dhtorch.export.glb import Shape, write_glb
from dhtorch.export.ply import write_ply

__all__ = [
    "Shape",
    "Shot",
    "Steps",
    "faces",
    "in_steps",
    "png",
    "write_colmap",
    "write_glb",
    "write_numbered",
    "write_ply",
    "write_stamped",
]
