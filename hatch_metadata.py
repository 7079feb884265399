"""Metadata hook: project URLs, and README with links that work on a package index.

The address is that of the repository which the build runs for (``GITHUB_SERVER_URL``, ``GITHUB_REPOSITORY``, set by
GitHub Actions). Without it the metadata has no URLs and README keeps its relative links.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


def project_urls(address: str) -> dict[str, str]:
    """Address of the repository → project URLs; empty without one. The documentation is what docs.yml deploys."""
    if not address:
        return {}
    owner, name = address.split("/")[-2:]
    return {
        "Homepage": address,
        "Documentation": f"https://{owner}.github.io/{name}/",
        "Changelog": f"{address}/blob/main/CHANGELOG.md",
        "Issues": f"{address}/issues",
    }


def absolute_links(text: str, address: str) -> str:
    """Markdown whose relative links and pictures begin with the address of the repository."""
    if not address:
        return text
    text = re.sub(r"(!\[[^\]]*\]\()(?!https?:|#)", rf"\g<1>{address}/raw/main/", text)
    return re.sub(r"(\]\()(?!https?:|#)", rf"\g<1>{address}/blob/main/", text)


class ProjectMetadata(MetadataHookInterface):
    """Fills ``urls`` and ``readme``."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Called by hatchling with the table ``project``."""
        repository = os.environ.get("GITHUB_REPOSITORY", "")
        address = f"{os.environ.get('GITHUB_SERVER_URL', 'https://github.com')}/{repository}" if repository else ""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["urls"] = project_urls(address)
        metadata["readme"] = {"content-type": "text/markdown", "text": absolute_links(text, address)}
