"""Build hook: compiled operators go into the wheel where torch can be imported and a C++ compiler is there.

An isolated build has no torch (it would be downloaded with CUDA), so the wheel then holds Python alone, for any
platform. With them: ``pip install --no-build-isolation .``, with torch and hatchling installed. An editable install
uses the user's cache, which ``python -m dhtorch.ops`` fills.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledOperators(BuildHookInterface):  # type: ignore[type-arg]
    """Adds ``dhtorch/ops/lib`` to a wheel."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the libraries of all vector levels of this platform, unless DHTORCH_OPS=0."""
        if self.target_name != "wheel" or os.environ.get("DHTORCH_OPS") == "0":
            return
        if importlib.util.find_spec("torch") is None:
            self.app.display_warning(
                "dhtorch: no torch in this build, so torch computes what operators would "
                "(pip install --no-build-isolation . compiles them)"
            )
            return
        sys.path.insert(0, self.root)
        builder = importlib.import_module("dhtorch.ops.builder")
        try:
            if version == "editable":
                builder.build()
                return
            self._folder = tempfile.TemporaryDirectory()
            self.app.display_info("dhtorch: compiling operators, up to 90 s for each vector level")
            for file in builder.build_for_wheel(Path(self._folder.name)):
                build_data["force_include"][str(file)] = f"dhtorch/ops/lib/{file.name}"
        except OSError as error:
            self.app.display_warning(f"dhtorch: operators are not compiled, torch computes instead: {error}")
            return
        build_data |= {"pure_python": False, "tag": builder.wheel_tag()}
