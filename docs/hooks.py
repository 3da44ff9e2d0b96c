"""Brings the committed results into the site, and makes links that lead out of the documentation stay in it."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = re.compile(
    r"\]\((?:\.\./)+(README\.md|LICENSE|CHANGELOG\.md|CONTRIBUTING\.md|(?:src|examples|benchmarks|notebooks)/[^)]*)\)"
)


def on_files(files: Files, config: Any) -> Files:
    """Add what lies in ``results/`` as pages and files of the site."""
    for path in sorted((ROOT / "results").iterdir()):
        if path.suffix in (".md", ".txt", ".png", ".json"):
            files.append(File.generated(config, f"results/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point ``../results/`` at the pages added, and name files that the site does not have instead of linking them."""
    depth = page.file.src_uri.count("/")
    markdown = re.sub(r"\]\((?:\.\./)+results/", f"]({'../' * depth}results/", markdown)
    return OUTSIDE.sub(lambda match: f"] (`{match[1]}` in the repository)", markdown)
