"""What the site has: the repository's pages, the files that these link to, and a page of the API for each package.

Every file stands where it stands in the repository, so that a link leads where it leads there. MkDocs reads the
docstrings from the sources, without importing them.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("inspection", "rta", "ppo", "kernels", "interfaces", "study")
FOLDERS = ("guides", "reference", "results")
LOG = "experiments/learning_log.md"
LINK = re.compile(r"\]\(([^)#\s:]+)(?:#[^)\s]*)?\)")  # those with a scheme lead elsewhere


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """All files of the site: in place of those that MkDocs has found in docs, the theme's aside."""
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", LOG)]
    pages += sorted((ROOT / "docs").rglob("*.md"))
    found = dict.fromkeys(pages)  # a set in order
    for page in pages:
        for link in LINK.findall(page.read_text(encoding="utf-8")):
            target = (page.parent / link).resolve()
            if target.is_file() and target.is_relative_to(ROOT):
                found[target] = None
    names = [path.relative_to(ROOT).as_posix() for path in found]
    config.nav = menu([name for name in names if name.endswith(".md")])
    theme = [file for file in files if file.src_dir != config.docs_dir]
    api = [File.generated(config, f"api/{name}.md", content=f"::: {name}\n") for name in PACKAGES]
    ours = [File(name, str(ROOT), config.site_dir, use_directory_urls=False) for name in names]
    return Files([*theme, *ours, *api])


def menu(pages: list[str]) -> list[Any]:
    """What the site's menu lists: the pages by folder, then the API."""
    return [
        {"Front page": "README.md"},
        {"All pages": "docs/README.md"},
        *({name.capitalize(): [page for page in pages if f"docs/{name}/" in page]} for name in FOLDERS),
        {"Log of experiments": LOG},
        {"API": [{name: f"api/{name}.md"} for name in PACKAGES]},
        {"Changes": "CHANGELOG.md"},
        {"Contributing": "CONTRIBUTING.md"},
    ]
