"""Readers of other projects open the maps, COLMAP workspaces, nerfstudio folders and Rerun recordings that we write.

python benchmarks/clients/readers_3d.py --json benchmarks/results/readers_3d.json

In an environment with dhtorch, pycolmap, open3d, trimesh, pymeshlab, rerun-sdk and nerfstudio (of which only what its
parsers import is needed). Each source is read by four commands of dhtorch with small maps: asked is whether every
reader gets the numbers that the files hold, not how good they are. A reader that is not installed gets a row that says
*not run*.
"""

import argparse
import importlib.metadata
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.runtime import storage

SOURCES = {"built-in room": None, "HoloLens": "holo_a", "TUM": "tum_fr1_desk9", "7-Scenes": "7s_redkitchen_000"}
SMALL = ("method.n=512", "dense={size: 160, planes: 32}")
ROOM = ("data.hw=[240,320]", "data.n_frames=5", "data.supersample=1")

#: Camera models that gsplat's examples read. Source: ``examples/datasets/colmap.py`` of gsplat.
GSPLAT_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")

Numbers = dict[str, float]


def commands(source: str | None, out: Path) -> dict[str, list[str]]:
    """Output → the command that writes it, as words after ``dhtorch``."""
    data = ["data=synthetic", *ROOM] if source is None else ["data=auto", f"data.root={source}"]
    enrich = [f"out={out / 'nerf'}", "format=nerfstudio", "report=false", "max_frames=6", *SMALL]
    made = {
        "integrate": ["integrate", *data, "cutoff=2.0", f"output={out / 'map'}", *SMALL],
        "enrich": ["enrich", *data, *enrich],
        "view": ["view", *data, "max_frames=2", f"save={out / 'view.rrd'}", "method.n=512"],
    }
    if source is not None:
        made["recover"] = [source, f"out={out / 'recover'}", "minutes=0.25", "size=160", "planes=32"]
    return made


def ply_columns(path: Path) -> np.ndarray:
    """Vertices of a PLY file of ours, read by its header alone."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    lines = [line.split() for line in header.decode("ascii").splitlines()]
    layout = [(w[2], kinds[w[1]]) for w in lines if w[0] == "property" and w[1] in kinds]
    count = next(int(w[2]) for w in lines if w[:2] == ["element", "vertex"])
    return np.frombuffer(body, layout, count)


def xyz_of(vertex: np.ndarray) -> np.ndarray:
    """Positions (P, 3)."""
    return np.stack([vertex[axis] for axis in "xyz"], 1)


def farthest(a: Any, b: Any) -> float:
    """Largest difference of two arrays of one shape."""
    assert np.shape(a) == np.shape(b), f"{np.shape(a)} {np.shape(b)}"
    return float(np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)).max())


def by_open3d(folder: Path) -> Numbers:
    """Open3D: the PLY's points and triangles, and all of the GLB, where it keeps triangles alone."""
    import open3d

    ply = ply_columns(folder / "map.ply")
    mesh = open3d.io.read_triangle_mesh(str(folder / "map.ply"))
    cloud = open3d.io.read_point_cloud(str(folder / "map.ply"))
    glb = open3d.io.read_triangle_mesh(str(folder / "map.glb"))
    n_written = sum(shape["triangles"] for shape in glb_shapes(folder / "map.glb"))
    assert len(glb.triangles) == n_written, f"{len(glb.triangles)} of {n_written} triangles"
    assert all(shape["triangles"] for shape in glb_shapes(folder / "map.glb")), "points, which Open3D leaves out"
    corner = np.asarray(glb.vertices)
    numbers = {"points": len(cloud.points), "triangles": len(mesh.triangles), "glb_triangles": len(glb.triangles)}
    numbers["ply"] = farthest(np.asarray(cloud.points), xyz_of(ply))
    return numbers | {"glb_against_ply": bounds_difference(corner[: len(ply)], xyz_of(ply))}


def glb_shapes(path: Path) -> list[dict[str, Any]]:
    """Name and number of triangles of each shape of a GLB file, by its JSON."""
    raw = path.read_bytes()
    document = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
    indices = [mesh["primitives"][0].get("indices") for mesh in document["meshes"]]
    counts = [0 if i is None else document["accessors"][i]["count"] // 3 for i in indices]
    return [{"name": mesh["name"], "triangles": n} for mesh, n in zip(document["meshes"], counts, strict=True)]


def bounds_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference of the corners of two boxes around points."""
    return max(farthest(a.min(0), b.min(0)), farthest(a.max(0), b.max(0)))


def by_trimesh(folder: Path) -> Numbers:
    """trimesh: PLY and GLB have the same axes and the same surface."""
    import trimesh

    ply = ply_columns(folder / "map.ply")
    mesh = trimesh.load(folder / "map.ply", process=False)
    scene = trimesh.load(folder / "map.glb", process=False)
    turned, name = scene.graph[next(n for n in scene.graph.nodes_geometry if n in ("surface", "map"))]
    surface = trimesh.transform_points(scene.geometry[name].vertices, turned)
    numbers = {"points": len(mesh.vertices), "shapes": len(scene.geometry)}
    if len(surface) != len(ply):  # squares: four corners a point
        surface = surface.reshape(-1, 4, 3).mean(1)
    return numbers | {"ply": farthest(mesh.vertices, xyz_of(ply)), "glb_against_ply": farthest(surface, xyz_of(ply))}


def by_meshlab(folder: Path) -> Numbers:
    """MeshLab: sigma is the quality that it colours by."""
    import pymeshlab

    ply = ply_columns(folder / "map.ply")
    opened = pymeshlab.MeshSet()
    opened.load_new_mesh(str(folder / "map.ply"))
    mesh = opened.current_mesh()
    numbers = {"points": mesh.vertex_number(), "ply": farthest(mesh.vertex_matrix(), xyz_of(ply))}
    numbers["sigma_as_quality"] = farthest(mesh.vertex_scalar_array(), ply["sigma"])
    opened.clear()
    opened.load_new_mesh(str(folder / "map.glb"))
    surface = max((opened.mesh(k) for k in range(opened.mesh_number())), key=lambda m: m.vertex_number())
    numbers |= {"glb_shapes": opened.mesh_number(), "glb_vertices": surface.vertex_number()}
    return numbers | {"glb_against_ply": bounds_difference(surface.vertex_matrix(), xyz_of(ply))}


def by_pycolmap(folder: Path) -> Numbers:
    """pycolmap: the model, its pictures by their names, and the distances of observations."""
    import pycolmap

    work = folder / "colmap"
    model = pycolmap.Reconstruction(str(work / "sparse" / "0"))
    misses = []
    for image in model.images.values():
        picture = pycolmap.Bitmap.read(str(work / "images" / image.name), True)
        camera = model.cameras[image.camera_id]
        assert (picture.width, picture.height) == (camera.width, camera.height), image.name
        for point in image.points2D:
            if point.has_point3D():
                at = camera.img_from_cam(image.cam_from_world() * model.points3D[point.point3D_id].xyz)
                misses.append(float(np.linalg.norm(at - point.xy)))
    assert max(misses) <= 4.01, f"an observation {max(misses):.1f} px off"
    numbers = {"images": len(model.images), "points": len(model.points3D), "observations": len(misses)}
    return numbers | {"median_px": float(np.median(misses)), "largest_px": max(misses)}


def by_gsplat_layout(folder: Path) -> Numbers:
    """What gsplat's ``simple_trainer --depth_loss`` takes from a folder: names, layout, depths in each picture."""
    import pycolmap

    work = folder / "colmap"
    model = pycolmap.Reconstruction(str(work / "sparse" / "0"))
    files = {p.relative_to(work / "images").as_posix() for p in (work / "images").rglob("*") if p.is_file()}
    assert files == {image.name for image in model.images.values()}, "pictures and names differ"
    assert {camera.model_name for camera in model.cameras.values()} <= {*GSPLAT_MODELS}, "a model that it refuses"
    counts = []
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        seen = [model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        inside = [image.cam_from_world() * xyz for xyz in seen]
        pixels = [camera.img_from_cam(point) for point in inside if point[2] > 0]
        counts.append(sum(bool(0 <= u < camera.width and 0 <= v < camera.height) for u, v in pixels))
    assert max(counts) > 0, "no picture observes a point"
    return {"images": len(counts), "with_depth": sum(n > 0 for n in counts), "depths": sum(counts)}


def by_nerfstudio(folder: Path) -> Numbers:
    """nerfstudio's parser, as depth-nerfacto (depth maps) and splatfacto (points) call it."""
    script = Path(__file__).with_name("nerfstudio_parser.py")
    done = subprocess.run([sys.executable, script, folder], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr.strip().splitlines()[-1][-200:]
    said = json.loads(done.stdout.strip().splitlines()[-1])
    assert max(said["largest_difference"].values()) < 1e-5
    worst = {f"largest_{name}": value for name, value in said.pop("largest_difference").items()}
    return said | worst


def by_rerun(file: Path) -> Numbers:
    """Rerun's reader: entities of the recording."""
    from rerun.chunk import RrdReader

    paths = [str(path) for path in RrdReader(str(file)).store().schema().entity_paths()]
    assert any("world" in path for path in paths), paths
    return {"entities": len(paths)}


#: Reader → its package, its function, and outputs below the folder of a source.
READERS: dict[str, tuple[str, Callable[[Path], Numbers], tuple[str, ...]]] = {
    "Open3D": ("open3d", by_open3d, ("map", "recover")),
    "trimesh": ("trimesh", by_trimesh, ("map", "recover")),
    "MeshLab (pymeshlab)": ("pymeshlab", by_meshlab, ("map", "recover")),
    "pycolmap": ("pycolmap", by_pycolmap, ("map",)),
    "gsplat's layout (by pycolmap)": ("pycolmap", by_gsplat_layout, ("map",)),
    "nerfstudio's parser": ("nerfstudio", by_nerfstudio, ("nerf",)),
    "Rerun": ("rerun", by_rerun, ("view.rrd",)),
}

#: Package by the name that is imported, where they differ.
DISTRIBUTIONS = {"rerun": "rerun-sdk", "open3d": "open3d-cpu"}


def version(package: str) -> str | None:
    """Installed version, None = not installed."""
    if importlib.util.find_spec(package) is None:
        return None
    for name in (DISTRIBUTIONS.get(package, package), package):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return ""


def output(folder: Path, name: str) -> Path:
    """The folder of a map below that of its command: of a scene, where the command writes one a scene."""
    maps = sorted((folder / name).rglob("map.ply"))
    return maps[0].parent if maps else folder / name


def rows(source: str, place: str | None, folder: Path) -> list[dict[str, Any]]:
    """One row for each reader and output of a source."""
    made: dict[str, str] = {}
    for word, options in commands(place, folder).items():
        done = subprocess.run([sys.executable, "-m", "dhtorch", *options], capture_output=True, text=True, check=False)
        made[word] = "" if done.returncode == 0 else done.stderr.strip().splitlines()[-1]
    writers = {"map": "integrate", "recover": "recover", "nerf": "enrich", "view.rrd": "view"}
    table = []
    for reader, (package, read, names) in READERS.items():
        for name in names:
            if writers[name] not in made:
                continue
            row = {"source": source, "written_by": writers[name], "reader": reader, "version": version(package)}
            row |= {"state": "not run", "numbers": None, "why": ""}
            if row["version"] is not None:
                try:
                    row |= {"numbers": read(output(folder, name)), "state": "passed"}
                except Exception as error:  # a reader of others raises what it likes: the table says it
                    row |= {"state": "failed", "why": made[writers[name]] or f"{type(error).__name__}: {error}"[:200]}
            table.append(row)
            print(json.dumps(row), flush=True)
    return table


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", action="append", choices=SOURCES, help="only this one")
    parser.add_argument("--work", type=Path, help="folder of the outputs, which are kept; a temporary one")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    table = []
    with tempfile.TemporaryDirectory() as temporary:
        for source in args.source or SOURCES:
            folder, name = (args.work or Path(temporary)) / source.replace(" ", "-"), SOURCES[source]
            place = None if name is None else str(Path(os.environ["DHTORCH_DATA"]) / name)
            table += rows(source, place, folder)
    if args.json:
        storage.write_json(args.json, table)
    return int(any(row["state"] == "failed" for row in table))


if __name__ == "__main__":
    sys.exit(main())
