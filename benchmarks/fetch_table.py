"""Write the table of ``dhtorch fetch shared_scenes`` from the scenes below DHTORCH_DATA: addresses, licences, digests.

    python benchmarks/fetch_table.py

The files of most scenes are those of a commit of a public repository, which ``meta.json`` names. The two of TUM are in
the archives of the benchmark, whose own digests are unknown here: the digests of their files are checked instead.
"""

import hashlib
import json
from pathlib import Path

from dhtorch.cli.fetch import FETCHED_SETS
from dhtorch.data import scenes_root

RAW = "https://raw.githubusercontent.com"
TUM = "https://cvg.cit.tum.de/rgbd/dataset/freiburg1"

#: Scene → repository and folder in it; the commit stands in the scene's meta.json.
REPOSITORIES = {
    "holo_a": ("ardaduz/deep-video-mvs", "sample-data/hololens-dataset/000/"),
    **{f"7s_redkitchen_{k}": ("andyzeng/tsdf-fusion-python", "data/") for k in ("000", "200", "400", "600")},
    "dgp_drive6cam": ("TRI-ML/dgp", "tests/data/dgp/test_scene/scene_02/"),
    "eth3d_terrace": ("louisfaul/computerVisionChallenge", "images/terrace/"),
    "middlebury_motorcycle": ("aquatiko/scikit-image", "skimage/data/"),
}
ARCHIVES = {"tum_fr1_desk9": "rgbd_dataset_freiburg1_desk", "tum_fr1_rpy_a": "rgbd_dataset_freiburg1_rpy"}

#: Files that are not in the source as they are, because we wrote them or they follow from the names of the others.
OUR_FILES = ("meta.json", "associations.txt")


def describe(root: Path, folder: str) -> dict[str, object]:
    """Entry of one scene."""
    meta = json.loads((root / folder / "meta.json").read_text(encoding="utf-8"))
    files = {p.relative_to(root / folder).as_posix(): p for p in sorted((root / folder).rglob("*")) if p.is_file()}
    texts = {name: files.pop(name).read_text(encoding="utf-8") for name in OUR_FILES if name in files}
    digests = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
    entry: dict[str, object] = {"folder": folder, "licence": meta["licence"], "files": digests, "texts": texts}
    if folder in ARCHIVES:
        name = ARCHIVES[folder]
        rows = files["groundtruth.txt"].read_text(encoding="utf-8").splitlines()
        times = [float(row.split()[0]) for row in rows if not row.startswith("#")]
        entry |= {"source": "https://cvg.cit.tum.de/data/datasets/rgbd-dataset", "archive": f"{TUM}/{name}.tgz"}
        return entry | {"inside": f"{name}/", "cut": {"groundtruth.txt": {"times": [times[0], times[-1]]}}}
    repository, path = REPOSITORIES[folder]
    base = f"{RAW}/{repository}/{meta['commit']}/{path}"
    cut = {"cut": {"poses.txt": {"rows": meta["rows"]}}} if folder == "holo_a" else {}
    return {**entry, "source": f"https://github.com/{repository}", "base": base, **cut}


if __name__ == "__main__":
    root = scenes_root(None)
    scenes = [describe(root, folder) for folder in (*REPOSITORIES, *ARCHIVES)]
    FETCHED_SETS["shared_scenes"].write_text(json.dumps({"scenes": scenes}, indent=0, ensure_ascii=False) + "\n")
