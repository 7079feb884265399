"""A C++ compiler that compiles equal sources once: ``mutants.py`` plants a fault in one file of many.

    CXX="python benchmarks/cached_compiler.py" python -m dhtorch.ops

Objects are kept in a folder of the temporary directory by the digest of the source, of the headers beside it and in the
build's own folder, and of the options.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

#: Where objects are kept; per user.
KEPT = Path(tempfile.gettempdir()) / f"dhtorch-objects-{os.getuid()}"


def key(words: list[str], source: Path) -> str:
    """Digest of all that decides the object: the source, headers, options; paths themselves do not."""
    work = next(Path(word[2:]) for word in words if word.startswith("-I"))
    digest = hashlib.sha256()
    for path in [source, *sorted(source.parent.glob("*.h")), *sorted(work.glob("*.h"))]:
        digest.update(path.name.encode() + path.read_bytes())
    digest.update(" ".join(word for word in words if "/" not in word).encode())
    return digest.hexdigest()


def main() -> int:
    """Compile or copy."""
    words = sys.argv[1:]
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++") or "c++"
    if "-c" not in words:
        return subprocess.run([compiler, *words], check=False).returncode
    source, target = Path(words[words.index("-c") + 1]), Path(words[words.index("-o") + 1])
    kept = KEPT / f"{key(words, source)}.o"
    if not kept.exists():
        code = subprocess.run([compiler, *words], check=False).returncode
        if code:
            return code
        KEPT.mkdir(mode=0o700, exist_ok=True)
        part = kept.with_suffix(f".{os.getpid()}")
        shutil.copyfile(target, part)
        part.replace(kept)
    shutil.copyfile(kept, target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
