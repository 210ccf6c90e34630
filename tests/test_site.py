"""The documentation site is built without a warning, and has every public name."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

for needed in ("mkdocs", "material", "mkdocstrings_handlers.python"):
    pytest.importorskip(needed, reason="needs the extra 'docs'")

ROOT = Path(__file__).parent.parent
MODULES = ["planning", "datasets", "exports", "pictures", "scoring", "demo"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr and "ERROR" not in done.stderr, done.stderr
    return folder


@pytest.mark.parametrize("name", ["hiosdf_jax", *(f"hiosdf_jax.{each}" for each in MODULES)])
def test_every_public_name_has_an_entry(site, name):
    module = importlib.import_module(name)
    page = (site / "api" / f"{name.split('.')[-1]}.html").read_text("utf-8")
    entries = set(re.findall(rf'id="{re.escape(name)}\.(\w+)"', page))
    # Constants have no docstring, and the other modules have pages of their own.
    documented = {each for each in module.__all__ if callable(getattr(module, each))}
    assert documented - entries == set()


def test_links_and_pictures_lead_somewhere(site):
    for page in site.rglob("*.html"):
        text = page.read_text("utf-8")
        for link in re.findall(r'(?:href|src)="([^"]+)"', text):
            if re.match(r"https?:|data:|/", link):
                continue
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path not in ("", ".") else page
            assert target.exists(), (page.name, link)
            if anchor and target.suffix == ".html":
                assert f'id="{anchor}"' in target.read_text("utf-8"), (page.name, link)


def test_examples_are_code(site):
    page = (site / "api" / "hiosdf_jax.html").read_text("utf-8")
    assert "<blockquote>" not in page  # what Markdown makes of a prompt
    blocks = [re.sub(r"<[^>]+>", "", each) for each in re.findall(r"<code>.*?</code>", page, re.S)]
    assert any(each.startswith("with hio.BackgroundMapper(state) as mapper:\n") for each in blocks)
    assert any("hio.Flag.BAD_POSE in flags\n# False\n" in each for each in blocks)


def test_notebooks_have_their_outputs(site):
    page = (site / "notebooks" / "quickstart.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert "mean error on this slice" in page
