"""Adds to the site what is not in this folder: README, changelog, notebooks and the API."""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).parent.parent
_PAGES = {
    "index.md": "README.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    **{
        f"notebooks/{name}.md": f"notebooks/{name}.ipynb"
        for name in (
            "quickstart",
            "inside_the_method",
            "planning",
            "own_data",
            "poses",
            "thousand_maps",
        )
    },
}
_MODULES = ("planning", "datasets", "exports", "pictures", "scoring", "demo")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)")
_PICTURE = re.compile(r"(!\[[^\]]*\]\()docs/")
_CODE = re.compile(r"(^```.*?^```$)", re.M | re.S)
_EXAMPLE = re.compile(r"^Example:\n((?:    .*(?:\n|\Z)|\n(?=    ))+)", re.M)
_PROMPT = re.compile(r"    (?:>>>|\.\.\.) ?")


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages."""
    for page, source in _PAGES.items():
        text = (_ROOT / source).read_text("utf-8")
        text = _PICTURE.sub(r"\1", text) if source.endswith(".md") else _from_notebook(text)
        files.append(File.generated(config, page, content=text))
    for name in ("hiosdf_jax", *_MODULES):
        module = name if name == "hiosdf_jax" else f"hiosdf_jax.{name}"
        text = f"# {module}\n\n::: {module}\n"
        files.append(File.generated(config, f"api/{name}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Any, files: Files, **_: Any) -> str:
    """Turns links from the repository's tree to the site's; those to code become plain text."""
    here = page.file.src_uri
    source = _PAGES.get(here, f"docs/{here}")
    page_of = {each: name for name, each in _PAGES.items()}

    def turn(match: re.Match[str]) -> str:
        text, link = match.groups()
        if link.startswith(("https://", "#")):
            return match[0]
        path, _, anchor = link.partition("#")
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        target = page_of.get(target, target.removeprefix("docs/"))
        if files.get_file_from_path(target) is None:
            return text
        relative = posixpath.relpath(target, posixpath.dirname(here) or ".")
        return f"[{text}]({relative}{'#' + anchor if anchor else ''})"

    parts = _CODE.split(markdown)
    parts[::2] = [_LINK.sub(turn, part) for part in parts[::2]]
    return "".join(parts)


def _from_notebook(text: str) -> str:
    """Writes a stored notebook with its outputs as Markdown."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if "text" in output:
                parts.append(f"```text\n{''.join(output['text'])}```")
            else:
                picture = "".join(output["data"]["image/png"].split())
                parts.append(f"![](data:image/png;base64,{picture})")
    return "\n\n".join(parts)


class ExamplesAsCode(griffe.Extension):
    """Shows the examples of docstrings as code, without prompts."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrites a docstring before it is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = _EXAMPLE.sub(_as_code, obj.docstring.value)


def _as_code(match: re.Match[str]) -> str:
    lines = match[1].rstrip("\n").split("\n")
    if any(line.startswith("    >>>") for line in lines):  # what has no prompt is printed
        prompts = [_PROMPT.match(line) for line in lines]
        lines = [
            "    " + (line[prompt.end() :] if prompt else f"# {line.strip()}")
            for line, prompt in zip(lines, prompts, strict=True)
        ]
    return "\n".join(["Example:", "    ```python", *lines, "    ```", "", ""])
